"""Where a mock can be spoken to, and the pty that stands for its serial port."""

from __future__ import annotations

import asyncio
import os
import termios
import tty
from collections.abc import Callable
from contextlib import suppress
from typing import NamedTuple

_INPUT_SPEED, _OUTPUT_SPEED = 4, 5  # their places in what tcgetattr gives
_READ_BYTES = 1024


class Endpoints(NamedTuple):
    """Where a mock on TCP and on a pty can be spoken to."""

    tcp_port: int
    pty_path: str


class Pty(asyncio.ReadTransport):
    """A raw pty whose far end is given to clients by its path; made inside an event loop.

    Parameters
    ----------
    baud_rate : int or None
        At which the far end is set, until a client sets another. None, or one that a pty does not know:
        every client is at ours.

    Attributes
    ----------
    path : str
    """

    _received: Callable[[bytes], None]

    def __init__(self, baud_rate: int | None = None) -> None:
        super().__init__()
        # The clients' end stays open here too, so that ours sees no error when a client leaves.
        self._ours, self._theirs = os.openpty()
        self._outgoing = bytearray()
        os.set_blocking(self._ours, False)
        tty.setraw(self._theirs)
        self._speed = getattr(termios, f"B{baud_rate}", None)
        if self._speed is not None:
            mode = termios.tcgetattr(self._theirs)
            mode[_INPUT_SPEED] = mode[_OUTPUT_SPEED] = self._speed
            termios.tcsetattr(self._theirs, termios.TCSANOW, mode)
        self.path = os.ttyname(self._theirs)

    def read_into(self, received: Callable[[bytes], None]) -> None:
        """Begin to read: `received` gets what clients write."""
        self._received = received
        self.resume_reading()

    def is_at_our_baud_rate(self) -> bool:
        """Whether the client's baud rate is the device's."""
        return self._speed in {None, termios.tcgetattr(self._theirs)[_OUTPUT_SPEED]}

    def write(self, data: bytes) -> None:
        """Send to the pty's reader; without flow control, bytes that are not read are lost.

        On a line, what is sent at one moment comes without a gap, such as an answer and its second copy. So it
        goes out in one piece: between two, the machine could stall for longer than the reader waits before it
        asks again.
        """
        if not self._outgoing:
            asyncio.get_running_loop().call_soon(self._send)
        self._outgoing += data

    def pause_reading(self) -> None:
        """Leave what clients write where it is; they wait when it is much."""
        asyncio.get_running_loop().remove_reader(self._ours)

    def resume_reading(self) -> None:
        """Read again."""
        asyncio.get_running_loop().add_reader(self._ours, self._read)

    def close(self) -> None:
        """Close both ends; what was not sent is forgotten."""
        self._outgoing.clear()
        self.pause_reading()
        os.close(self._ours)
        os.close(self._theirs)

    def _send(self) -> None:
        data = bytes(self._outgoing)
        self._outgoing.clear()
        if data:
            with suppress(BlockingIOError):
                os.write(self._ours, data)

    def _read(self) -> None:
        with suppress(BlockingIOError):
            self._received(os.read(self._ours, _READ_BYTES))
