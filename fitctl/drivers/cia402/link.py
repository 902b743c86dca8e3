"""The CAN bus as the driver uses it: frames by identifier, and every failure a ``DeviceUnreachable``.

Any python-can interface serves. For ``slcan``, python-can 4.6 reads its port one byte at a time, three
system calls each; :class:`BulkSlcanBus` reads what is there in one call, and is otherwise python-can's.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import select
import socket
import time
from collections.abc import Iterator, Sequence
from typing import NoReturn

import can
from can.interfaces.slcan import slcanBus

from fitctl.config import Cia402Device
from fitctl.drivers.amplifiers import DEVICE
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceProtocolError, DeviceUnreachable

_SEND_TIMEOUT_S = 0.1
_AT_ONCE = 0.0  # with this time limit, pyserial's write returns at once how many bytes the port has accepted
_END_OF_LINE = re.compile(rb"[\r\a]")
_LONGEST_LINE = 64  # a frame with a timestamp takes 31 bytes
_FRAME = re.compile(
    rb"(?:[tr][0-7][0-9A-Fa-f]{2}|[TR][01][0-9A-Fa-f]{7})([0-8])((?:[0-9A-Fa-f]{2})*)\r"
)
_STAMP_DIGITS = 4


class BulkSlcanBus(slcanBus):
    """python-can's SLCAN bus, with reads in chunks, writes with their own time limit, and no Nagle delay.

    Its shutdown always closes the port.

    A serial port is locked before the adapter on it gets a byte: python-can shares its port, and sets the
    adapter up anew under whoever uses it.

    Raises
    ------
    OSError
        If another process has the port.
    """

    # LAWICEL's S7 is 800 kbit/s; python-can lists 750.
    _BITRATES = {**slcanBus._BITRATES, 800000: "S7"}  # noqa: RUF012 (overrides python-can's)

    def __init__(self, channel: str, bitrate: int) -> None:
        self._batch: bytearray | None = None
        socket_url = channel.startswith("socket://")
        with contextlib.ExitStack() as stack:
            if not socket_url:
                stack.enter_context(_locked(channel.partition("@")[0]))
            super().__init__(channel, bitrate=bitrate, sleep_after_open=0)
            self._lock = stack.pop_all()
        self._descriptor = self.fileno()
        if socket_url:
            link = socket.socket(fileno=self._descriptor)
            link.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            link.detach()

    def send_together(self, messages: Sequence[can.Message]) -> None:
        """Send frames that belong together by one write: a write costs more than all the rest."""
        self._batch = bytearray()
        try:
            for message in messages:
                self.send(message, _AT_ONCE)
        finally:
            batch, self._batch = self._batch, None
        self._write_all(batch)

    def _write(self, string: str) -> None:
        line = string.encode("ascii") + self.LINE_TERMINATOR
        if self._batch is None:
            self._write_all(line)
        else:
            self._batch += line

    def _write_all(self, line: bytes | bytearray) -> None:
        """Write as soon as the port accepts it.

        pyserial's own time limit also counts a stall of the computer after the port has accepted all bytes.
        """
        port, left = self.serialPortOrig, memoryview(line)
        if port.write_timeout != _AT_ONCE:
            port.write_timeout = _AT_ONCE
        deadline_s = time.monotonic() + _SEND_TIMEOUT_S
        with can.exceptions.error_check("Could not write to the adapter"):
            while left:
                left_s = max(0.0, deadline_s - time.monotonic())
                if not select.select([], [port.fileno()], [], left_s)[1]:
                    msg = f"{len(left)} bytes not taken within {_SEND_TIMEOUT_S:g} s"
                    raise TimeoutError(msg)
                left = left[port.write(left) :]

    def recv(self, timeout: float | None = None) -> can.Message | None:
        """The next frame; python-can's own waits by the wall clock, which may be set back."""
        return self._recv_internal(timeout)[0]

    def _read(self, timeout: float | None) -> str | None:
        """The next line that is a frame, or None when none came in time.

        Waiting bytes are read once even if `timeout` is 0. Everything else that an adapter sends is
        ignored: a frame that it refuses (BEL) shows as an answer of the drive that does not come.

        Raises
        ------
        ValueError
            If bytes keep coming without a line end, or a frame is broken: python-can would take some.
        """
        deadline_s = None if timeout is None else time.monotonic() + timeout
        left_s = timeout
        has_read = False
        while True:
            while end := _END_OF_LINE.search(self._buffer):
                line = bytes(self._buffer[: end.end()])
                del self._buffer[: end.end()]
                if line[:1] in b"tTrR":
                    return _checked(line)
            if (length := len(self._buffer)) > _LONGEST_LINE:
                self._buffer.clear()
                msg = f"{length} bytes without a line end"
                raise ValueError(msg)
            if deadline_s is not None:
                left_s = max(0.0, deadline_s - time.monotonic())
                # Bytes that are ready again at once must not outlast the time limit.
                if has_read and not left_s:
                    return None
            try:
                if not select.select([self._descriptor], [], [], left_s)[0]:
                    return None
                chunk = os.read(self._descriptor, 4096)
            except (OSError, ValueError) as error:
                raise can.CanOperationError(str(error)) from error
            if not chunk:
                msg = "a connection that the adapter closed"
                raise can.CanOperationError(msg)
            self._buffer += chunk
            has_read = True

    def shutdown(self) -> None:
        """Leave the bus; the port is closed even if the adapter is gone."""
        try:
            super().shutdown()
        finally:
            self.serialPortOrig.close()
            self._lock.close()


@contextlib.contextmanager
def _locked(path: str) -> Iterator[None]:
    """The lock that pyserial puts on a port which it opens with ``exclusive=True``."""
    descriptor = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError as error:
            msg = f"{path} is in use by another process"
            raise OSError(msg) from error
        yield
    finally:
        os.close(descriptor)


def _checked(line: bytes) -> str:
    """A frame's line that is exactly as long as it says, with or without a time stamp."""
    match = _FRAME.fullmatch(line)
    if match:
        remote = line[:1] in b"rR"
        surplus = len(match[2]) - (0 if remote else 2 * int(match[1]))
        if surplus in {0, _STAMP_DIGITS}:
            return line.decode("ascii")
    msg = f"a broken SLCAN frame {line!r}"
    raise ValueError(msg)


class CanLink:
    """An open bus.

    Parameters
    ----------
    device : Cia402Device
        Interface, channel and bit rate.

    Raises
    ------
    DeviceUnreachable
        If the bus cannot be opened.
    """

    def __init__(self, device: Cia402Device) -> None:
        address = f"{device.interface} {device.channel}, node {device.node_id}"
        self.endpoint = Endpoint(DEVICE, address)
        try:
            self._bus: can.BusABC = (
                BulkSlcanBus(device.channel, device.bitrate)
                if device.interface == "slcan"
                else can.Bus(
                    channel=device.channel,
                    interface=device.interface,
                    bitrate=device.bitrate,
                    ignore_config=True,
                )
            )
        except Exception as error:  # TypeError, NameError: each interface of python-can has its own
            raise self.endpoint.error(
                DeviceUnreachable,
                "an open CAN bus",
                f"{type(error).__name__}: {error}",
                "check that the adapter is on, and siderostat.device in the rig file",
            ) from error

    def send(self, *frames: tuple[int, bytes]) -> None:
        """Put frames, each an 11-bit identifier and data, on the bus in this order."""
        messages = [
            can.Message(arbitration_id=can_id, data=data, is_extended_id=False)
            for can_id, data in frames
        ]
        try:
            if isinstance(self._bus, BulkSlcanBus):
                self._bus.send_together(messages)
            else:
                for message in messages:
                    self._bus.send(message, _SEND_TIMEOUT_S)
        except (can.CanError, OSError) as error:
            self._broken("frames to be sent", error)

    def receive(self, timeout_s: float) -> tuple[int, bytes] | None:
        """The next frame's identifier and data; None when none came in time."""
        deadline_s = time.monotonic() + timeout_s
        while True:
            try:
                message = self._bus.recv(timeout_s)
            except (can.CanError, OSError) as error:
                self._broken("frames", error)
            except (ValueError, IndexError) as error:
                raise self.endpoint.error(
                    DeviceProtocolError, "CAN frames", str(error), "check the adapter"
                ) from error
            if message is None:
                return None
            if not (message.is_extended_id or message.is_remote_frame or message.is_error_frame):
                return message.arbitration_id, bytes(message.data)
            timeout_s = deadline_s - time.monotonic()
            if timeout_s <= 0:
                return None

    def close(self) -> None:
        """Leave the bus; never raises."""
        try:
            self._bus.shutdown()
        except (can.CanError, OSError):
            return  # the far end is gone already

    def _broken(self, expected: str, error: Exception) -> NoReturn:
        hint = "check the adapter and its cable, then recover"
        got = str(error) or type(error).__name__
        raise self.endpoint.error(DeviceUnreachable, expected, got, hint) from error
