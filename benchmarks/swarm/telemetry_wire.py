"""Telemetry by its real way on virtual time: encoded, sent by a PUB that drops, decoded by a console's client.

:func:`installed` replaces ZeroMQ in :mod:`fitctl.messages.client`. A PUB keeps a few messages for each
subscriber and drops what a slow one has no room for, as ZeroMQ does.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from random import Random
from types import SimpleNamespace
from typing import NamedTuple
from unittest.mock import patch

import msgspec
import zmq

from benchmarks.swarm.invariants import Invariants
from benchmarks.swarm.threads import VirtualEvent, VirtualTime, standing_for
from fitctl.messages.client import Client
from fitctl.messages.keys import RemoteKey
from fitctl.messages.telemetry import Telemetry
from fitctl.supervisor.supervisor import Supervisor
from fitctl.tui.state import ConsoleState

_KEY = RemoteKey(
    rig="swarm",
    name="ada",
    role="viewer",
    host="127.0.0.1",
    command_port=1,
    telemetry_port=2,
    server_public="",
    public="",
    secret="",
)
_MOST_QUEUED = 50
_RECEIVE_S = 1.0
_BUSY = 0.02  # fraction of messages after which a console is busy for a time


class _Sent(NamedTuple):
    """A message, and what the supervisor was when it was sent.

    Attributes
    ----------
    payload : bytes
    modes : dict
        Mode of each loop, and since when.
    dropped : int
        Messages of this supervisor that this subscriber has missed until now.
    """

    payload: bytes
    modes: dict[str, tuple[str, float]]
    dropped: int


class Publisher:
    """The PUB socket of one supervisor, and the way to its subscribers.

    Attributes
    ----------
    subscribers : list of Subscriber
        They find the PUB of the next supervisor by themselves.
    """

    def __init__(self, subscribers: list[Subscriber]) -> None:
        self.subscribers = subscribers
        self.supervisor: Supervisor | None = None
        for one in subscribers:
            one.dropped = 0

    def send(self, payload: bytes, _flags: int) -> None:
        """Send a message, which each subscriber receives or misses."""
        supervisor = self.supervisor
        if supervisor is None or not self.subscribers:
            return
        modes = {
            name: (loop.mode.name, loop.mode_since_s) for name, loop in supervisor.loops.items()
        }
        for one in self.subscribers:
            one.arrive(payload, modes)

    def close(self) -> None:
        """It is closed with its process."""


class Subscriber:
    """A client's SUB socket."""

    def __init__(self, time: VirtualTime, size: int) -> None:
        self.dropped = 0
        self.newest: _Sent | None = None
        self._size = size
        self._sent: deque[_Sent] = deque()
        self._some = VirtualEvent(time)

    def arrive(self, payload: bytes, modes: dict[str, tuple[str, float]]) -> None:
        """Queue a message, or drop it."""
        if len(self._sent) >= self._size:
            self.dropped += 1
            return
        self._sent.append(_Sent(payload, modes, self.dropped))
        self._some.set()

    def setsockopt(self, _option: int, _value: int) -> None:
        """Only the number of messages matters here."""

    def subscribe(self, _topic: bytes) -> None:
        """It gets everything."""

    def connect(self, _endpoint: str) -> None:
        """There is one supervisor."""

    def poll(self, timeout_ms: int) -> bool:
        """Wait for a message."""
        if not self._sent:
            self._some.clear()
            self._some.wait(timeout_ms / 1000)
        return bool(self._sent)

    def recv(self) -> bytes:
        """The next message."""
        self.newest = self._sent.popleft()
        return self.newest.payload

    def close(self) -> None:
        """It is closed with the run."""


class RemoteConsole:
    """A console that receives telemetry by the real client, is busy at times, and must count what it misses.

    Parameters
    ----------
    subscriber : Subscriber
        What its client receives with; :func:`installed`, and the next to be used.
    """

    def __init__(
        self, invariants: Invariants, time: VirtualTime, random: Random, subscriber: Subscriber
    ) -> None:
        self._invariants = invariants
        self._time = time
        self._random = random
        self._subscriber = subscriber
        self._state = ConsoleState(0.0)
        self._encode = msgspec.msgpack.Encoder().encode
        self._before = 0  # messages that were dropped before this supervisor's first one came
        self._client = Client(_KEY)

    def run(self) -> None:
        """Receive until the run ends; called in its own thread."""
        while True:
            message = self._client.receive(_RECEIVE_S)
            if message is not None:
                self._take(message)
            if self._random.random() < _BUSY:
                self._time.sleep(10 ** self._random.uniform(-1.0, 1.3))

    def _take(self, message: Telemetry) -> None:
        state, sent = self._state, self._subscriber.newest
        if sent is None:
            return
        is_first = state.newest is None or state.newest.pid != message.pid
        state.accept(message, self._time.now_s())
        if self._encode(message) != sent.payload:
            self._wrong(f"message {message.sequence} is not what was sent")
        shown = {name: (loop.state.mode, loop.state.since_s) for name, loop in state.loops.items()}
        if shown != sent.modes:
            self._wrong(f"shows {shown}, was {sent.modes}")
        if is_first:
            self._before = sent.dropped
        if state.missed != sent.dropped - self._before:
            self._wrong(f"{sent.dropped - self._before} messages missed, {state.missed} counted")

    def _wrong(self, detail: str) -> None:
        self._invariants.violated("a console far away shows what was", detail)


def drawn_subscribers(time: VirtualTime, random: Random, number: int) -> list[Subscriber]:
    """Sockets of so many consoles, whose links have room for a few messages or many."""
    return [Subscriber(time, random.randint(1, _MOST_QUEUED)) for _ in range(number)]


@contextmanager
def installed(time: VirtualTime, subscribers: list[Subscriber]) -> Iterator[None]:
    """Clients use virtual time meanwhile, and each new one the next of these sockets."""
    coming = iter(subscribers)
    stand_in = standing_for(zmq, Context=lambda: SimpleNamespace(socket=lambda _kind: next(coming)))
    clock = SimpleNamespace(monotonic=time.now_s, sleep=time.sleep)
    with (
        patch("fitctl.messages.client.zmq", stand_in),
        patch("fitctl.messages.client.time", clock),
    ):
        yield
