"""The serial line of the mock: bytes at the pace of a baud rate, and commands out of bytes."""

from __future__ import annotations

import asyncio
import re
from collections.abc import Callable

from fitctl.drivers.mdt693.protocol import BITS_PER_BYTE, TERMINATOR
from fitctl.mocks.mdt693.controller import COMMAND_BYTES_MAX

_PIECE_BYTES = 16  # as much as a serial port's FIFO takes at once
_UNREAD_BYTES_MAX = 65536
_ARROW = re.compile(rb"\x1b\[[A-Da-d]")


class CommandSplitter:
    """Bytes in, whole commands out; half a command waits for the rest.

    A command ends in CR. An arrow key is a command at once; a CR that follows it belongs to it.
    """

    def __init__(self) -> None:
        self._pending = bytearray()
        self._after_arrow = False

    def feed(self, data: bytes) -> list[bytes]:
        """Commands that are now complete, without CR and still with their LFs.

        What is longer than any command is cut one byte beyond that length, so that a flood without
        CR needs no memory and is still too long.
        """
        commands = []
        for byte in data:
            if byte == TERMINATOR[0]:
                if not self._after_arrow or self._pending.strip(b"\n"):
                    commands.append(bytes(self._pending))
                self._pending.clear()
                self._after_arrow = False
            elif len(self._pending) <= COMMAND_BYTES_MAX:
                self._pending.append(byte)
                if _ARROW.fullmatch(self._pending.strip(b"\n")):
                    commands.append(bytes(self._pending))
                    self._pending.clear()
                    self._after_arrow = True
        return commands

    def clear(self) -> None:
        """Forget half a command."""
        self._pending.clear()


class Sender:
    """Sends bytes no faster than the baud rate lets them pass, a few at a time.

    Parameters
    ----------
    baud_rate : int
    write : callable
        Takes what has passed; must not wait.
    """

    def __init__(self, baud_rate: int, write: Callable[[bytes], None]) -> None:
        self._byte_s = BITS_PER_BYTE / baud_rate
        self._write = write
        self._free_s = 0.0
        self._timers: set[asyncio.TimerHandle] = set()

    def send(self, data: bytes) -> None:
        """Let each piece go when its last byte has passed; never waits."""
        loop = asyncio.get_running_loop()
        self._free_s = max(self._free_s, loop.time())
        for start in range(0, len(data), _PIECE_BYTES):
            piece = data[start : start + _PIECE_BYTES]
            self._free_s += len(piece) * self._byte_s
            self._at(loop, self._free_s, piece)

    def close(self) -> None:
        """Forget what is still to be sent."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()

    def _at(self, loop: asyncio.AbstractEventLoop, time_s: float, piece: bytes) -> None:
        def passed() -> None:
            self._timers.discard(timer)
            self._write(piece)

        timer = loop.call_at(time_s, passed)
        self._timers.add(timer)


def write_to(writer: asyncio.StreamWriter, data: bytes) -> None:
    """Send to a TCP client; without flow control, bytes that it does not read are lost."""
    if not writer.is_closing() and writer.transport.get_write_buffer_size() < _UNREAD_BYTES_MAX:
        writer.write(data)
