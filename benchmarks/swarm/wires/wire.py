"""The wires on virtual time: a driver and its mock in one process, and what goes wrong on the way between them.

The driver is the only thread. Where it waits, the time goes on, and what is due happens: the mock's timers, and
answers that come late, twice, in pieces, or not at all. The stand-ins are for a serial port, a TCP socket and a
CAN bus; drivers, links, protocols and mocks are the real ones.
"""

from __future__ import annotations

import asyncio
import heapq
import math
import socket as real_socket
import struct
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from types import SimpleNamespace
from typing import Any, NamedTuple
from unittest.mock import MagicMock, patch

import can

from benchmarks.swarm.threads import standing_for

KINDS = ("late", "lost", "deaf", "twice", "torn", "broken", "reboot")
"""An answer comes late, or never; a request is not heard; an answer comes twice, or in two pieces; the line
breaks; the device restarts, and the line breaks with it."""
_TIMED = (
    "fitctl.drivers.modbus_tcp",
    "fitctl.drivers.modbus_dac.link",
    "fitctl.drivers.mdt693.driver",
    "fitctl.drivers.ensemble.driver",
    "fitctl.drivers.ensemble.link",
    "fitctl.drivers.bal_analog.driver",
    "fitctl.drivers.labjack_t7.driver",
    "fitctl.drivers.c887.driver",
    "fitctl.drivers.c887.link",
    "fitctl.mocks.labjack_t7.server",
    "fitctl.drivers.cia402.bus",
    "fitctl.drivers.cia402.driver",
    "fitctl.drivers.cia402.link",
    "fitctl.drivers.cia402.node",
    "fitctl.drivers.cia402.positions",
)
_START_S = 1000.0  # a machine that has run for a while
_QUICK_S = 0.0004


class Trouble(NamedTuple):
    """What becomes of one exchange: its kind, and how long where it takes long."""

    kind: str
    for_s: float = 0.0


class Timer:
    """As ``asyncio.TimerHandle``."""

    def __init__(self, run: Callable[[], object]) -> None:
        self.run: Callable[[], object] | None = run

    def cancel(self) -> None:
        """Do not call it."""
        self.run = None


class WireTime:
    """The clock, and the event loop of the mocks."""

    def __init__(self) -> None:
        self.now_s = _START_S
        self._due: list[tuple[float, int, Timer]] = []
        self._number = 0

    # ------------------------------------------------------------ as asyncio's loop
    def time(self) -> float:
        """The virtual time."""
        return self.now_s

    def call_at(self, when_s: float, function: Callable[..., object], *arguments: Any) -> Timer:
        """Call a function at a time."""
        timer = Timer(lambda: function(*arguments))
        self._number += 1
        heapq.heappush(self._due, (max(when_s, self.now_s), self._number, timer))
        return timer

    def call_later(self, delay_s: float, function: Callable[..., object], *arguments: Any) -> Timer:
        """Call a function after a while."""
        return self.call_at(self.now_s + delay_s, function, *arguments)

    def call_soon(self, function: Callable[..., object], *arguments: Any) -> Timer:
        """Call a function before time goes on."""
        return self.call_at(self.now_s, function, *arguments)

    # ------------------------------------------------------------ as the module time
    def monotonic(self) -> float:
        """The virtual time; asking takes a little of it, so that no loop that asks goes on for ever."""
        self.now_s += 1e-7
        return self.now_s

    def time_ns(self) -> int:
        """The virtual time."""
        return round(1e9 * self.now_s)

    def sleep(self, duration_s: float) -> None:
        """Let time go on."""
        self.wait_until(self.now_s + duration_s, lambda: False)

    def wait_until(self, deadline_s: float, is_over: Callable[[], bool]) -> bool:
        """Let time go on until then, or until something is over; whether it is."""
        while not is_over():
            if not self._due or self._due[0][0] > deadline_s:
                self.now_s = max(self.now_s, deadline_s)
                return is_over()
            due_s, _, timer = heapq.heappop(self._due)
            self.now_s = max(self.now_s, due_s)
            if timer.run is not None:
                timer.run()
        return True


class Wire:
    """One line to a device.

    Parameters
    ----------
    time : WireTime
    troubles : iterator of Trouble or None
        What becomes of each exchange, None of one that goes well; when it ends, all go well.
    hear : callable
        Gets what the device hears; what it answers it gives to :meth:`answer`.
    reboot : callable
        The device restarts.
    has_numbers : bool
        Answers tell which request they are to; where they do not, a second copy comes with the first.
    is_serial : bool
        What is late comes, whoever has opened the port meanwhile.
    most_late_s : float
        No answer is later than this.
    """

    def __init__(
        self,
        time: WireTime,
        troubles: Iterator[Trouble | None],
        hear: Callable[[bytes], None],
        reboot: Callable[[], None],
        *,
        has_numbers: bool = True,
        is_serial: bool = False,
        most_late_s: float = math.inf,
    ) -> None:
        self.time = time
        self.is_broken = False
        self.arrived: list[Any] = []
        self._troubles = troubles
        self._hear = hear
        self._reboot = reboot
        self._has_numbers = has_numbers
        self._is_serial = is_serial
        self._most_late_s = most_late_s
        self._trouble: Trouble | None = None
        self._newest_s = 0.0
        self._connection = 0

    def connect(self) -> None:
        """A new connection."""
        self._connection += not self._is_serial
        self.arrived.clear()
        self.is_broken = False

    def send(self, data: Any) -> None:
        """The driver sends something."""
        if self.is_broken:
            raise BrokenPipeError(32, "broken pipe")
        self._trouble = trouble = next(self._troubles, None)
        kind = "" if trouble is None else trouble.kind
        if kind in {"broken", "reboot"}:
            self.is_broken = True
            if kind == "reboot":
                self._reboot()
        elif kind != "deaf":
            self.time.call_later(_QUICK_S / 2, self._heard, self._connection, data, trouble)

    def _heard(self, connection: int, data: Any, trouble: Trouble | None) -> None:
        if connection == self._connection and not self.is_broken:
            self._trouble = trouble
            self._hear(data)

    def answer(self, data: Any) -> None:
        """The device says something."""
        trouble, self._trouble = self._trouble, None
        kind, for_s = ("", 0.0) if trouble is None else trouble
        for_s = min(for_s, self._most_late_s)
        pieces = [(0.0, data)]
        match kind:
            case "lost":
                return
            case "late":
                pieces = [(for_s, data)]
            case "twice":
                pieces = [(0.0, data), (for_s, data)] if self._has_numbers else [(0.0, 2 * data)]
            case "torn" if isinstance(data, bytes) and len(data) > 1:
                middle = len(data) // 2
                pieces = [(0.0, data[:middle]), (for_s, data[middle:])]
        for late_s, piece in pieces:
            at_s = self.time.now_s + _QUICK_S / 2 + late_s
            at_s = self._newest_s = max(at_s, self._newest_s)  # nothing overtakes
            self.time.call_at(at_s, self._arrive, self._connection, piece)

    def _arrive(self, connection: int, piece: Any) -> None:
        if connection == self._connection and not self.is_broken:
            self.arrived += [piece] if not isinstance(piece, bytes) else list(piece)

    def take(self, most: int) -> bytes:
        """What has arrived, so many bytes at most."""
        data = bytes(self.arrived[:most])
        del self.arrived[:most]
        return data

    def wait(self, timeout_s: float) -> bool:
        """Wait for something to arrive, or for the line to break."""
        return self.time.wait_until(
            self.time.now_s + timeout_s, lambda: bool(self.arrived) or self.is_broken
        )


class Port:
    """As ``serial.Serial``."""

    def __init__(self, wire: Wire, timeout_s: float) -> None:
        self.timeout = timeout_s
        self.write_timeout = timeout_s
        self.is_open = True
        self._wire = wire
        wire.connect()

    @property
    def in_waiting(self) -> int:
        """Bytes that are there."""
        self._check()
        return len(self._wire.arrived)

    def read(self, size: int) -> bytes:
        """So many bytes, or fewer when the time is over."""
        self._check()
        deadline_s = self._wire.time.now_s + self.timeout
        self._wire.time.wait_until(
            deadline_s, lambda: len(self._wire.arrived) >= size or self._wire.is_broken
        )
        if not self._wire.arrived:
            self._check()
        return self._wire.take(size)

    def write(self, data: bytes) -> int:
        """Send."""
        self._check()
        self._wire.send(bytes(data))
        return len(data)

    def reset_input_buffer(self) -> None:
        """Forget what has arrived."""
        self._wire.arrived.clear()

    def flush(self) -> None:
        """What is written is sent."""

    def fileno(self) -> int:
        """No descriptor of this process."""
        return -1

    def close(self) -> None:
        """Let go."""
        self.is_open = False

    def _check(self) -> None:
        if not self.is_open or self._wire.is_broken:
            raise OSError(5, "the port is gone")


class Socket:
    """As ``socket.socket``, connected."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        self._limit_s = 0.0
        self._is_open = True
        wire.connect()

    def setsockopt(self, _level: int, option: int, value: Any) -> None:
        """The kernel's time limit of receiving."""
        if option == real_socket.SO_RCVTIMEO:
            seconds, microseconds = struct.unpack("@ll", value)
            self._limit_s = seconds + 1e-6 * microseconds

    def settimeout(self, _timeout_s: float | None) -> None:
        """The kernel's limit counts."""

    def setblocking(self, _blocking: bool) -> None:
        """The kernel's limit counts: none."""

    def sendall(self, data: bytes) -> None:
        """Send."""
        self._check()
        self._wire.send(bytes(data))

    def recv(self, size: int) -> bytes:
        """What is there, once something is."""
        self._check()
        if not self._wire.arrived and not self._wire.wait(self._limit_s):
            raise BlockingIOError(11, "nothing in time")
        return self._wire.take(size)  # nothing: closed by the station

    def recvmsg(self, size: int, _ancillary: int) -> tuple[bytes, list[Any], int, None]:
        """The same, without a stamp of the kernel's."""
        return self.recv(size), [], 0, None

    def close(self) -> None:
        """Let go."""
        self._is_open = False

    def wait(self, timeout_s: float) -> bool:
        """For ``select``."""
        return self._wire.wait(timeout_s)

    def _check(self) -> None:
        if not self._is_open:
            raise OSError(9, "bad file descriptor")


class Bus:
    """As ``can.Bus``."""

    def __init__(self, wire: Wire) -> None:
        self._wire = wire
        wire.connect()

    def send(self, message: can.Message, _timeout_s: float) -> None:
        """Send."""
        try:
            self._wire.send(message)
        except OSError as error:
            raise can.CanOperationError(str(error)) from error

    def recv(self, timeout_s: float) -> can.Message | None:
        """The next frame."""
        if self._wire.is_broken:
            raise can.CanOperationError("the adapter is gone")
        if not self._wire.arrived and not self._wire.wait(max(0.0, timeout_s)):
            return None
        if not self._wire.arrived:
            raise can.CanOperationError("the adapter is gone")
        message: can.Message = self._wire.arrived.pop(0)
        return message

    def shutdown(self) -> None:
        """Leave."""


@contextmanager
def virtual(time: WireTime, wire: Wire) -> Iterator[None]:
    """Drivers that are opened here go by the wire, and drivers and mocks by its time."""

    def select(readers: list[Socket], _writers: object, _errors: object, left_s: float) -> Any:
        return ([one for one in readers if one.wait(left_s)], [], [])

    def create_connection(_address: object, _timeout_s: float) -> Socket:
        return Socket(wire)

    def serial_for_url(_url: str, **options: Any) -> Port:
        return Port(wire, options["timeout"])

    sockets = standing_for(real_socket, create_connection=create_connection, socket=Socket)
    adapter = {  # what an SLCAN bus reads its port by
        "select": SimpleNamespace(
            select=lambda ports, writers, _errors, left_s: (
                [one for one in ports if wire.wait(left_s)],
                writers,
            )
        ),
        "os": SimpleNamespace(read=lambda _descriptor, most: wire.take(most)),
        "socket": MagicMock(),
    }
    with ExitStack() as stack:
        for module in _TIMED:
            stack.enter_context(patch(f"{module}.time", time))
        for module in ("modbus_tcp", "modbus_dac.link"):
            stack.enter_context(patch(f"fitctl.drivers.{module}.socket", sockets))
        stack.enter_context(
            patch("fitctl.drivers.modbus_tcp.select", SimpleNamespace(select=select))
        )
        stack.enter_context(patch("serial.serial_for_url", serial_for_url))
        stack.enter_context(
            patch("fitctl.drivers.cia402.link.can.Bus", lambda **_options: Bus(wire))
        )
        for name, stand_in in adapter.items():
            stack.enter_context(patch(f"fitctl.drivers.cia402.link.{name}", stand_in))
        before = asyncio._get_running_loop()
        asyncio._set_running_loop(time)  # pyrefly: ignore[bad-argument-type]
        try:
            yield
        finally:
            asyncio._set_running_loop(before)
