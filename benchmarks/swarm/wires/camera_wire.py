"""A bad network to the camera on virtual time: datagrams of GVCP and GVSP between the host and the mock.

Datagrams arrive late, out of order, twice or not at all. The host's interface goes down, the host hears that
nothing listens, and the camera restarts.

Known limitations: GVCP cannot tell a late request from a new one. A second copy of a request therefore arrives
together with the first, and no request arrives after the driver has given up that attempt. A new socket never
gets the port of an earlier one.
"""

from __future__ import annotations

import asyncio
import errno
import math
import select
import socket
from collections import Counter, deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from itertools import count
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from benchmarks.swarm.threads import (
    VirtualEvent,
    VirtualThreading,
    VirtualTime,
    standing_for,
)
from benchmarks.swarm.wires.wire import Timer, Trouble
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Command

Address = tuple[str, int]

KINDS = ("late", "lost", "twice")
"""A datagram arrives late (and others overtake it), never, or twice."""
RARE_KINDS = ("down", "refused", "reboot")
"""The host's interface goes down for a time; the host hears that nothing listens; the camera restarts, and is
away for a time."""
CAMERA = ("127.0.0.1", 3956)
_HOST = "127.0.0.1"
_QUICK_S = 0.0002  # a datagram on its way


class Network:
    """UDP between the host and the camera.

    Parameters
    ----------
    time : VirtualTime
    control, stream : iterator of Trouble or None
        What becomes of each datagram of the control channel (both ways) and of the stream, None of one that
        arrives; when one ends, all arrive.
    most_late_s : float
        No request is later than this.

    Attributes
    ----------
    hear : callable
        Takes what the camera's control port receives, and from where.
    reboot : callable
        Restarts the camera.
    sockets : dict of int to Udp
        The host's, by port.
    arrival : VirtualEvent
        Set whenever something has arrived at the host.
    down_until_s, away_until_s : float
        Until when the host's interface is down, and the camera away.
    rebooted_s : float
        When the camera restarted first, since this was set to infinity.
    lost, troubled : Counter of (int, int)
        By port and block id: first copies of leader and pixels that never arrived, and those that never
        arrived or arrived late.
    """

    hear: Callable[[bytes, Address], None]
    reboot: Callable[[], None]

    def __init__(
        self,
        time: VirtualTime,
        control: Iterator[Trouble | None],
        stream: Iterator[Trouble | None],
        most_late_s: float,
    ) -> None:
        self.time = time
        self.sockets: dict[int, Udp] = {}
        self.arrival = VirtualEvent(time)
        self.down_until_s = self.away_until_s = 0.0
        self.rebooted_s = math.inf
        self.lost: Counter[tuple[int, int]] = Counter()
        self.troubled: Counter[tuple[int, int]] = Counter()
        self._control = control
        self._stream = stream
        self._most_late_s = most_late_s
        self._ports = count(40000)

    def next_port(self) -> int:
        """A port that no socket has had."""
        return next(self._ports)

    @property
    def is_down(self) -> bool:
        """Whether the host's interface is down."""
        return self.time.now_s() < self.down_until_s

    def to_camera(self, sender: Udp, packet: bytes) -> None:
        """Carry a request."""
        if self.is_down:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")
        kind, for_s = self._trouble(self._control)
        if kind == "refused":
            self._later(0.0, partial(sender.refuse))
            return
        if packet[2:4] != Command.PACKETRESEND.to_bytes(2, "big"):
            for_s = 0.0 if kind == "twice" else min(for_s, self._most_late_s)
        arrive = partial(self._arrive_at_camera, packet, (_HOST, sender.port))
        self._carry(kind, for_s, arrive)

    def to_host(self, packet: bytes, port: int, *, streamed: bool) -> None:
        """Carry an answer or a packet of the stream."""
        if self.time.now_s() < self.away_until_s:
            return
        kind, for_s = self._trouble(self._stream if streamed else self._control)
        first = (port, _block_of(packet)) if streamed else (port, 0)
        if kind in {"late", "lost", "refused", "reboot"}:
            self.troubled[first] += 1
        if not self._carry(kind, for_s, partial(self._arrive_at_host, packet, first)):
            self.lost[first] += 1

    def _trouble(self, coming: Iterator[Trouble | None]) -> tuple[str, float]:
        trouble = next(coming, None)
        if trouble is None:
            return "", 0.0
        now_s = self.time.now_s()
        if trouble.kind == "down":
            self.down_until_s = now_s + trouble.for_s
        elif trouble.kind == "reboot":
            self.away_until_s = now_s + trouble.for_s
            self.rebooted_s = min(self.rebooted_s, now_s)
            self.reboot()
        return trouble

    def _carry(self, kind: str, for_s: float, arrive: Callable[[], None]) -> bool:
        """Let a datagram arrive once, twice or never; whether it does."""
        if kind in {"lost", "refused", "reboot"}:
            return False
        self._later(for_s if kind == "late" else 0.0, arrive)
        if kind == "twice":
            self._later(for_s, arrive)
        return True

    def _later(self, for_s: float, run: Callable[[], None]) -> None:
        self.time.call_at(self.time.now_s() + _QUICK_S + for_s, run)

    def _arrive_at_camera(self, packet: bytes, sender: Address) -> None:
        if self.time.now_s() >= self.away_until_s:
            self.hear(packet, sender)

    def _arrive_at_host(self, packet: bytes, first: tuple[int, int]) -> None:
        to = self.sockets.get(first[0])
        if to is None or self.is_down:
            self.lost[first] += 1
            self.troubled[first] += 1
            return
        to.arrived.append(packet)
        self.arrival.set()


def _block_of(packet: bytes) -> int:
    """The frame whose leader or pixels a packet of the stream has; 0 of a repeated one and of others."""
    status, block, word = protocol.GVSP_HEADER.unpack_from(packet)
    is_first = status == protocol.Status.SUCCESS and word >> 24 != protocol.FORMAT_TRAILER
    return int(block) if is_first else 0


class Udp:
    """As a UDP ``socket.socket`` of the host that does not wait."""

    def __init__(self, network: Network) -> None:
        self.arrived: deque[bytes] = deque()
        self.port = 0
        self._network = network
        self._is_refused = False

    def setblocking(self, _blocking: bool) -> None:
        """It never waits."""

    def setsockopt(self, *_option: Any) -> None:
        """It has room for everything."""

    def bind(self, _address: Address) -> None:
        """Get a port."""
        self.port = self._network.next_port()
        self._network.sockets[self.port] = self

    def connect(self, address: Address) -> None:
        """Get a port, if the interface is up."""
        if self._network.is_down:
            raise OSError(errno.ENETUNREACH, "Network is unreachable")
        self.bind(address)

    def getsockname(self) -> Address:
        """Its own address."""
        return _HOST, self.port

    @property
    def is_readable(self) -> bool:
        """Whether :meth:`recv` would return or raise something."""
        return bool(self.arrived) or self._is_refused

    def refuse(self) -> None:
        """The host hears that nothing listens."""
        self._is_refused = True
        self._network.arrival.set()

    def send(self, packet: bytes) -> int:
        """Send to the camera."""
        self._check()
        self._network.to_camera(self, bytes(packet))
        return len(packet)

    def recv(self, _size: int) -> bytes:
        """The next datagram."""
        self._check()
        if not self.arrived:
            raise BlockingIOError(errno.EAGAIN, "nothing has arrived")
        return self.arrived.popleft()

    def recv_into(self, buffer: bytearray) -> int:
        """The same, into a buffer."""
        packet = self.recv(len(buffer))
        buffer[: len(packet)] = packet
        return len(packet)

    def close(self) -> None:
        """Close it."""
        self._network.sockets.pop(self.port, None)

    def __enter__(self) -> Udp:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _check(self) -> None:
        if self._is_refused:
            self._is_refused = False
            raise ConnectionRefusedError(errno.ECONNREFUSED, "Connection refused")
        if self._network.sockets.get(self.port) is not self:
            raise OSError(errno.EBADF, "Bad file descriptor")


class StreamSource:
    """As the camera's own socket, from which it streams."""

    def __init__(self, network: Network) -> None:
        self._network = network

    def setblocking(self, _blocking: bool) -> None:
        """It never waits."""

    def bind(self, _address: Address) -> None:
        """Its port is of no interest."""

    def getsockname(self) -> Address:
        """Its own address."""
        return CAMERA[0], 1

    def sendto(self, packet: bytes, destination: Address) -> None:
        """Send a packet of the stream."""
        self._network.to_host(packet, destination[1], streamed=True)

    def close(self) -> None:
        """The camera keeps it."""


class EventFd:
    """As the descriptor of an ``eventfd``."""

    def __init__(self) -> None:
        self.is_readable = False


class Poll:
    """As ``select.poll()``, in whole milliseconds."""

    def __init__(self, network: Network) -> None:
        self._network = network
        self._watched: list[Udp | EventFd] = []

    def register(self, watched: Udp | EventFd, _events: int) -> None:
        """Watch a socket or an event."""
        self._watched.append(watched)

    def poll(self, timeout_ms: float) -> list[Udp | EventFd]:
        """What is readable, once something is."""
        time, arrival = self._network.time, self._network.arrival
        deadline_s = time.now_s() + math.ceil(timeout_ms) / 1000
        while not (ready := [one for one in self._watched if one.is_readable]):
            if time.now_s() >= deadline_s:
                break
            arrival.clear()
            arrival.wait(deadline_s - time.now_s())
        return ready


class EventLoop:
    """As asyncio's loop, as far as the mock needs one."""

    def __init__(self, time: VirtualTime) -> None:
        self._time = time

    def time(self) -> float:
        """The virtual time."""
        return self._time.now_s()

    def call_at(self, when_s: float, function: Callable[..., object], *arguments: Any) -> Timer:
        """Call a function at a time."""
        timer = Timer(partial(function, *arguments))

        def run() -> None:
            if timer.run is not None:
                timer.run()

        self._time.call_at(when_s, run)
        return timer

    def call_later(self, delay_s: float, function: Callable[..., object], *arguments: Any) -> Timer:
        """Call a function after a while."""
        return self.call_at(self._time.now_s() + delay_s, function, *arguments)


@contextmanager
def on(network: Network) -> Iterator[None]:
    """Cameras that are opened here, and their mock, use this network and its time."""
    time = network.time
    clock = SimpleNamespace(monotonic=time.now_s, sleep=time.sleep)
    events = SimpleNamespace(
        eventfd=lambda *_: EventFd(),
        eventfd_write=lambda event, _value: _wake(network, event),
        close=lambda _event: None,
        EFD_CLOEXEC=0,
        EFD_NONBLOCK=0,
    )
    host = standing_for(socket, socket=lambda *_: Udp(network), inet_aton=socket.inet_aton)
    stand_ins = {
        "time": clock,
        "threading": VirtualThreading(time),
        "select": SimpleNamespace(poll=lambda: Poll(network), POLLIN=select.POLLIN),
        "socket": host,
        "os": events,
    }
    uses = {
        "drivers.gige.driver": ("time", "select"),
        "drivers.gige.gvcp": ("time", "select", "socket", "threading"),
        "drivers.gige.heartbeat": ("time", "threading", "os"),
        "drivers.gige.stream": ("time",),
        "drivers.gige.ticks": ("time",),
        "drivers.gige.transport": ("time", "select", "socket"),
        "mocks.gige.acquisition": ("time",),
        "mocks.gige.camera": ("time",),
        "mocks.gige.picture": ("time",),
        "mocks.gige.registers": ("time",),
        "mocks.gige.stream": ("time",),
    }

    async def listen(*_arguments: Any) -> SimpleNamespace:
        return SimpleNamespace(port=CAMERA[1])

    with ExitStack() as stack:
        for module, names in uses.items():
            for name in names:
                stack.enter_context(patch(f"fitctl.{module}.{name}", stand_ins[name]))
        own = standing_for(socket, socket=lambda *_: StreamSource(network))
        stack.enter_context(patch("fitctl.mocks.gige.stream.socket", own))
        stack.enter_context(patch("fitctl.mocks.gige.camera.listen", listen))
        before = asyncio._get_running_loop()
        asyncio._set_running_loop(EventLoop(time))  # pyrefly: ignore[bad-argument-type]
        try:
            yield
        finally:
            asyncio._set_running_loop(before)


def _wake(network: Network, event: EventFd) -> None:
    event.is_readable = True
    network.arrival.set()
