"""The service as it is, on virtual time: commands come to its doors encoded, after a while; answers go back.

:func:`installed` puts sockets in memory in place of ZeroMQ's in :mod:`fitctl.service`. An operator elsewhere
sends through the gateway's door, in an envelope. Now and then somebody sends what is no command.

Known limitations: a connection holds any number of messages, and loses none; no message is longer than a
socket allows. A round of the service begins when there is something to do, not every 5 ms.
Invented: how long messages take, and how often what comes is no command.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from random import Random
from typing import Any, NamedTuple
from unittest.mock import patch

import msgspec
import zmq

from benchmarks.swarm.invariants import Invariants
from benchmarks.swarm.telemetry_wire import Publisher
from benchmarks.swarm.threads import VirtualEvent, VirtualTime, standing_for
from fitctl.logging.records import (
    AnyRecord,
    Event,
    LoopTiming,
    MetrologyTick,
    ModeChange,
    PiezoReading,
    Tick,
)
from fitctl.messages.client import REPLY_TIMEOUT_S
from fitctl.messages.command_table import may_be_too_late
from fitctl.messages.commands import (
    AnyCommand,
    RecentEvents,
    RecorderReport,
    Reply,
    Status,
    TakeOver,
)
from fitctl.messages.telemetry import Telemetry
from fitctl.service.admission import Admission, Sender
from fitctl.service.envelope import Passed
from fitctl.service.service import Service, Waiting
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.supervisor.supervisor import Supervisor

SENDERS = {
    "ada": Sender("ada", "here", "commander", is_local=True),
    "ben": Sender("ben", "elsewhere", "commander", is_local=False),
    "cleo": Sender("cleo", "here", "commander", is_local=True),
    "dora": Sender("dora", "elsewhere", "viewer", is_local=False),
}
"""By name. The first three can send commands."""
_ANSWERED_HERE = (Status, RecentEvents, RecorderReport, TakeOver)
_SHOWN = frozenset({Event, LoopTiming, MetrologyTick, ModeChange, PiezoReading, Tick})
_ROUND_S = 0.005
_ENDS_S = 5.0
_LOCAL_S = (1e-5, 1e-3)
_REMOTE_S = (1e-3, 0.3)
_HELD_BACK = 0.02  # of the messages from and to elsewhere
HELD_BACK_S = (0.3, 2.5)
"""For so long the network holds these."""
_GARBAGE = 0.02  # of the messages
_MOST_GARBAGE_BYTES = 200
# So many refusals within that time may be followed by some without an answer.
_FLOOD, _FLOOD_S = 20, 2.0


class _Sent(NamedTuple):
    """A message, when it was sent, and who takes the answer; garbage is no command."""

    sender: Sender
    command: AnyCommand | None
    at_s: float
    reply: Callable[[Reply], None]


class _Frame(NamedTuple):
    """A part of a message, as ZeroMQ gives it; `sender` is whom the kernel names."""

    buffer: bytes
    more: bool
    sender: Sender | None = None


class _Wire:
    """What a service's sockets have in common, in place of a ZeroMQ context.

    Attributes
    ----------
    some : VirtualEvent
        Set when there is something to do.
    due_s : float
        When the next telemetry is.
    answered : callable
        Takes the tag and the payload of each answer.
    """

    def __init__(self, time: VirtualTime, random: Random) -> None:
        self.time = time
        self.random = random
        self.some = VirtualEvent(time)
        self.due_s = 0.0
        self.answered: Callable[[bytes, bytes], None] = lambda _tag, _payload: None

    def socket(self, _kind: int) -> _Router:
        return _Router(self)

    def term(self) -> None:
        """Nothing is left behind."""


class _Router:
    """A ROUTER socket; of the PUB that the service makes, only this much is used."""

    def __init__(self, wire: _Wire) -> None:
        self.wire = wire
        self._frames: deque[_Frame] = deque()

    def setsockopt(self, _option: int, _value: int) -> None:
        """It has no limits."""

    def bind(self, _endpoint: str) -> None:
        """There is one service."""

    def close(self) -> None:
        """It is closed with its process."""

    @property
    def has_some(self) -> bool:
        return bool(self._frames)

    def arrive(self, sender: Sender, tag: bytes, payload: bytes) -> None:
        """A message is here."""
        self._frames.append(_Frame(sender.name.encode(), more=True))
        self._frames.append(_Frame(tag, more=True))
        self._frames.append(_Frame(payload, more=False, sender=sender))
        self.wire.some.set()

    def recv(self, _flags: int, *, copy: bool) -> _Frame:
        if not self._frames:
            raise zmq.Again
        return self._frames.popleft()

    def send_multipart(self, parts: list[bytes], _flags: int) -> None:
        _, tag, payload = parts
        self.wire.answered(tag, payload)


class _Poller:
    """Returns once a message is here, an answer is to be sent, or telemetry is due."""

    def __init__(self) -> None:
        self._routers: list[_Router] = []

    def register(self, router: _Router, _flags: int) -> None:
        self._routers.append(router)

    def poll(self, _timeout_ms: int) -> list[_Router]:
        wire = self._routers[0].wire
        wait_s = wire.due_s - wire.time.now_s()
        if wait_s > 0 and not wire.some.is_set() and wire.some.wait(wait_s):
            wire.time.sleep(wire.random.uniform(0.0, _ROUND_S))  # a round is under way
        wire.some.clear()
        return [router for router in self._routers if router.has_some]


class _WatchedAdmission(Admission):
    """It tells what it has decided."""

    def __init__(self, lease_s: float, invariants: Invariants) -> None:
        super().__init__(lease_s)
        self._invariants = invariants

    def refusal(self, sender: Sender, command: AnyCommand, now_s: float) -> str:
        refusal = super().refusal(sender, command, now_s)
        self._invariants.admitted(sender, command, refusal)
        if not refusal and not isinstance(command, _ANSWERED_HERE):
            self._invariants.posted(command, sender.name)
        return refusal


class _Buffer(TelemetryBuffer):
    """Also keeps the newest message as it was before it was encoded."""

    newest: Telemetry

    def telemetry(self, supervisor: Supervisor, state: ServiceState, now_s: float) -> Telemetry:
        self.newest = super().telemetry(supervisor, state, now_s)
        return self.newest


class SwarmService(Service):
    """The service of one supervisor, and the ways to it; within :func:`installed`.

    Parameters
    ----------
    supervisor : Supervisor
    time : VirtualTime
    invariants : Invariants
    pid : int
        Process number of the supervisor.
    publisher : Publisher
        The PUB socket; it also sends to consoles that are far away.
    lost, offered : callable
        Return the counts of the record queue.

    Attributes
    ----------
    events : int
        Reported until now.
    newest : dict
        Of the records that consoles show, the newest by kind and loop.
    subscribers : list of callable
        Each takes every telemetry message.
    """

    def __init__(
        self,
        supervisor: Supervisor,
        time: VirtualTime,
        invariants: Invariants,
        pid: int,
        publisher: Publisher,
        lost: Callable[[], int],
        offered: Callable[[], int],
    ) -> None:
        state = ServiceState(
            pid=pid,
            wall_minus_monotonic_s=0.0,
            scheduling="virtual",
            records_lost=lost,
            records_offered=offered,
        )
        self.buffer = _Buffer()
        self.events = 0
        self.newest: dict[tuple[type, str], AnyRecord] = {}
        self.subscribers: list[Callable[[Telemetry], None]] = []
        super().__init__(supervisor, self.buffer, Path(), state, time)
        post = supervisor.post

        def watched_post(
            command: AnyCommand, reply: Callable[[Reply], None], sender: str, address: str
        ) -> None:
            invariants.obeyed(command, sender)
            post(command, reply, sender, address)

        supervisor.post = watched_post  # pyrefly: ignore[bad-assignment]
        self._admission = _WatchedAdmission(supervisor.rig.service.lease_s, invariants)
        publisher.supervisor = supervisor
        self._publisher = publisher  # pyrefly: ignore[bad-assignment]
        self._time = time
        self._invariants = invariants
        self._wire: _Wire = self._context  # pyrefly: ignore[bad-assignment]
        self._wire.due_s = time.now_s()
        self._wire.answered = self._take_answer
        self._random = self._wire.random
        self._decode = msgspec.msgpack.Decoder(Reply).decode
        self._sent: dict[bytes, _Sent] = {}
        self._arrives_s: dict[str, float] = {}  # by sender: no message overtakes another
        self._refused_s: dict[str, deque[float]] = {}  # by sender: when, of the newest
        self._ended = VirtualEvent(time)
        time.spawn(self.run, "service")

    def take(self, record: AnyRecord) -> None:
        """Add a record to the next telemetry."""
        kind = type(record)
        if kind in _SHOWN:
            # A change into the same mode leaves the reason of the one before.
            if kind is not ModeChange or record.source != record.target:  # pyrefly: ignore[missing-attribute]
                self.newest[kind, getattr(record, "loop", "")] = record
            self.events += kind is Event
        self.buffer.add(record)

    def stop(self) -> None:
        """Send what answers there are, publish once more, and end."""
        self._ending.set()
        self._wire.some.set()
        awake_s = self._time.awake_s()
        if not self._ended.wait(_ENDS_S) and self._time.awake_s() - awake_s >= _ENDS_S:
            self._invariants.violated("a service that is stopped ends", f"not in {_ENDS_S:g} s")
        self._supervisor.record_left()

    def run(self) -> None:
        """Serve; this is the thread."""
        super().run()
        self._ended.set()

    # ------------------------------------------------------------ the clients' side

    def send(self, sender: Sender, command: AnyCommand, reply: Callable[[Reply], None]) -> None:
        """Send a command; `reply` takes the answer once it is back."""
        if self._random.random() < _GARBAGE:
            size = self._random.randint(0, _MOST_GARBAGE_BYTES)
            self._pass(sender, None, self._random.randbytes(size), self._refused)
        if may_be_too_late(command):
            command = msgspec.structs.replace(command, sent_s=self._time.now_s())
        self._pass(sender, command, self._encode(command), reply)

    def _refused(self, reply: Reply) -> None:
        if reply.accepted:
            self._invariants.violated("what is no command is refused", "it was accepted")

    def _pass(
        self,
        sender: Sender,
        command: AnyCommand | None,
        payload: bytes,
        reply: Callable[[Reply], None],
    ) -> None:
        tag = len(self._sent).to_bytes(8, "big")
        self._sent[tag] = _Sent(sender, command, self._time.now_s(), reply)
        door = self._local if sender.is_local else self._gateway
        if not sender.is_local:
            payload = self._encode(
                Passed(name=sender.name, role=sender.role, address=sender.address, payload=payload)
            )
        at_s = self._time.now_s() + self._delay_s(sender)
        at_s = self._arrives_s[sender.name] = max(at_s, self._arrives_s.get(sender.name, 0.0))
        router: Any = door.router
        self._time.call_at(at_s, partial(router.arrive, sender, tag, payload))

    def _delay_s(self, sender: Sender) -> float:
        if sender.is_local:
            return self._random.uniform(*_LOCAL_S)
        is_held_back = self._random.random() < _HELD_BACK
        return self._random.uniform(*(HELD_BACK_S if is_held_back else _REMOTE_S))

    def _take_answer(self, tag: bytes, payload: bytes) -> None:
        sent = self._sent[tag]
        at_s = self._time.now_s() + self._delay_s(sent.sender)
        self._time.call_at(at_s, lambda: sent.reply(self._decode(payload)))

    # ------------------------------------------------------------ the service's side

    def _receive(self, waiting: Waiting, payload: bytes) -> None:
        sender = self._sent[waiting.tag].sender
        if waiting.sender != sender:
            detail = f"{sender} sent it, and it counts as sent by {waiting.sender}"
            self._invariants.violated("a command is its sender's", detail)
        super()._receive(waiting, payload)

    def _refuse(self, waiting: Waiting, reply: Reply, now_s: float) -> None:
        """A sender elsewhere that is refused too often is not answered each time; the others are counted."""
        sender, answered = waiting.sender, self._sent[waiting.tag].reply
        refused_s = self._refused_s.setdefault(sender.name, deque(maxlen=_FLOOD))
        refused_s.append(now_s)
        before = self._withheld(sender)
        super()._refuse(waiting, reply, now_s)
        is_flood = len(refused_s) == _FLOOD and now_s - refused_s[0] < _FLOOD_S
        if self._withheld(sender) > before and is_flood:
            answered(reply)

    def _withheld(self, sender: Sender) -> int:
        """How many of its refusals are counted, and not yet reported."""
        return self._intake._dropped[sender.name, "refused without an answer"]

    def _done(self, waiting: Waiting, stopped: str | None, reply: Reply) -> None:
        command = self._sent[waiting.tag].command
        if command is not None:
            self._invariants.answered(command, reply)
            self._in_time(waiting, command, reply)
        super()._done(waiting, stopped, reply)
        self._wire.some.set()

    def _answer_here(self, waiting: Waiting, command: AnyCommand, reply: Reply) -> None:
        self._in_time(waiting, command, reply)
        super()._answer_here(waiting, command, reply)

    def _in_time(self, waiting: Waiting, command: AnyCommand, reply: Reply) -> None:
        """The supervisor carries out no command whose sender has given up, except a stop."""
        waited_s = self._time.now_s() - self._sent[waiting.tag].at_s
        most_s = REPLY_TIMEOUT_S + (0.0 if waiting.sender.is_local else _REMOTE_S[1])
        if reply.accepted and may_be_too_late(command) and waited_s > most_s:
            self._invariants.violated(
                "a command whose sender has given up is not carried out",
                f"{type(command).__name__} after {waited_s:.2f} s",
            )

    def _publish(self, now_s: float) -> None:
        self._wire.due_s = now_s + self._period_s
        super()._publish(now_s)
        for take in list(self.subscribers):
            take(self.buffer.newest)


@contextmanager
def installed(time: VirtualTime, random: Random) -> Iterator[None]:
    """Services have sockets in memory meanwhile."""
    stand_in = standing_for(
        zmq,
        Context=lambda: _Wire(time, random),
        Poller=_Poller,
        Again=zmq.Again,
        ZMQError=zmq.ZMQError,
    )
    with ExitStack() as stack:
        for module in ("service", "doors"):
            stack.enter_context(patch(f"fitctl.service.{module}.zmq", stand_in))
        of_kernel = patch("fitctl.service.service.local_sender", lambda frame: frame.sender)
        stack.enter_context(of_kernel)
        no_file = patch("fitctl.service.service.file_identity", lambda _path: None)
        stack.enter_context(no_file)
        yield
