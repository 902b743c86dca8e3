"""The gateway: a process of its own between the network and the supervisor.

It holds the TCP ports, lets the allowed keys in, and passes on what they say, in envelopes that name them. So
encryption, strangers who knock, slow clients and whatever libzmq does when a client misbehaves are its own, and
the supervisor has no socket on the network. Who may command is decided there; here only what is no command, and
what is too much, is turned back.
"""

from __future__ import annotations

import resource
import signal
import threading
from collections import deque
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import zmq

from fitctl.clock import Clock
from fitctl.config import ConfigError, Rig
from fitctl.logging.records import Severity
from fitctl.messages.commands import Reply
from fitctl.messages.endpoints import GATEWAY_SOCKET, TELEMETRY_SOCKET, SocketFolder
from fitctl.messages.keys import AllowedKey
from fitctl.processes import give_way, limit_memory
from fitctl.service.doors import MESSAGES_A_ROUND, QUEUED, ROUND_MS, Parcel, frame_property
from fitctl.service.envelope import Passed, Report
from fitctl.service.intake import Intake, Limit
from fitctl.service.keyed_door import KeyedDoor

_NICENESS = 10
_MOST_BYTES = 512 * 2**20
_HANDSHAKES_A_ROUND = 4
_DROPPED_A_ROUND = 200  # messages that are neither passed on nor answered
_LOOK_S = 0.1
# Of one key, before it is refused for a while; low, so that a gateway short of processor time notices too.
_MOST_DROPPED_PER_S = 100.0
_MOST_DROPPED_AT_ONCE = 1000.0
_HUNG_S = 10
_NO_KEY = "revoked keys"  # all of them together, where messages are counted
_REVOKED = Reply(accepted=False, text="this key has been revoked")
_NO_SUPERVISOR = Reply(
    accepted=False, text="the supervisor accepts no commands at the moment; try again"
)
_MOST_EVENTS = 100  # lines that wait for a supervisor that takes none

Route = tuple[bytes, bytes]
"""Identity and tag of the sender; the supervisor returns them with its reply."""


def be_modest() -> None:
    """Give way to every other process of the instrument, limit its memory, and allow many open files.

    Of threads that exist already it speaks to this one alone, so it is for the beginning of a process.
    """
    give_way(_NICENESS)
    limit_memory(_MOST_BYTES)
    _, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (hard, hard))  # each stranger is one for a while


def show_life() -> None:
    """Have SIGALRM end the process if this is not called again in time: then it hangs, whatever it hangs in."""
    signal.alarm(_HUNG_S)


def admit(
    key: AllowedKey | None, address: str, payload: bytes, intake: Intake, now_s: float
) -> Passed | Reply:
    """What becomes of a message: it is passed on for its key (None if that was revoked), or turned back."""
    if key is None:
        return _REVOKED
    accepted = intake.accept(key.name, key.role, payload, now_s)
    if isinstance(accepted, Reply):
        return accepted
    return Passed(name=key.name, role=key.role, address=address, payload=payload)


class Gateway:
    """Passes commands, replies and telemetry on.

    Parameters
    ----------
    rig : Rig
    folder : Path
        Where the supervisor's Unix sockets are.
    clock : Clock
    alive : callable
        Called a few times a second, while it works.

    Raises
    ------
    ConfigError
        If the rig's TCP address or its keys cannot be used.
    """

    def __init__(
        self, rig: Rig, folder: Path, clock: Clock, alive: Callable[[], None] = lambda: None
    ) -> None:
        service = rig.service
        self._clock = clock
        self._alive = alive
        self._intake = Intake(service.commands_per_s, rig.loops)
        self._unanswered = Limit(_MOST_DROPPED_PER_S, _MOST_DROPPED_AT_ONCE)
        self._events: deque[tuple[Severity, str]] = deque(maxlen=_MOST_EVENTS)
        self._reported: dict[str, AllowedKey] | None = None
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode_route = msgspec.msgpack.Decoder(Route).decode
        self._context = zmq.Context()
        try:
            self._keyed = KeyedDoor(
                rig, self._context, partial(self._report_event, "warning"), clock
            )
        except BaseException:
            self._context.destroy(linger=0)
            raise
        self._supervisor = self._context.socket(zmq.DEALER)
        self._supervisor.setsockopt(zmq.SNDHWM, QUEUED)
        # Nothing waits for a supervisor that is not there.
        self._supervisor.setsockopt(zmq.IMMEDIATE, 1)
        self._supervisor.setsockopt(zmq.LINGER, 0)
        self._telemetry = self._context.socket(zmq.SUB)
        self._telemetry.setsockopt(zmq.RCVHWM, QUEUED)
        self._telemetry.subscribe(b"")
        self._folder = SocketFolder(folder)
        self._connected: dict[str, str] = {}  # endpoints, by the names of the supervisor's sockets
        self._unsafe = ""
        self._connect()
        ports = f"ports {service.command_port} and {service.telemetry_port}"
        self._report_event("info", f"listening at {service.tcp_address}, {ports}")

    def run(self, ending: threading.Event) -> None:
        """Serve until `ending`; however much comes in, a bounded part of it is taken in each round."""
        poller = zmq.Poller()
        for one in (self._keyed.zap, self._keyed.door.router, self._supervisor, self._telemetry):
            poller.register(one, zmq.POLLIN)
        look_s = self._clock.now_s()
        try:
            while not ending.is_set():
                busy = poller.poll(int(_LOOK_S * 1000))
                now_s = self._clock.now_s()
                if now_s >= look_s:
                    self._alive()
                    self._connect()
                    self._keyed.refresh()
                    for whose in self._keyed.end_excessive():
                        self._intake.drop(
                            whose, "far more than fitctl reads: its connection was closed"
                        )
                    for line in self._intake.dropped(now_s):
                        self._report_event("warning", line)
                    look_s = now_s + _LOOK_S
                self._keyed.admit(_HANDSHAKES_A_ROUND)
                self._report()  # of a key first, then what it says
                self._pass_commands()
                self._pass_replies()
                self._pass_telemetry()
                if busy:
                    ending.wait(ROUND_MS / 1000)
        finally:
            self._supervisor.close()
            self._telemetry.close()
            self._keyed.close()
            self._context.term()
            self._folder.close()

    def _connect(self) -> None:
        """Connect to the supervisor's sockets where they are now, in a folder that only its user can change."""
        for name, one in ((GATEWAY_SOCKET, self._supervisor), (TELEMETRY_SOCKET, self._telemetry)):
            try:
                endpoint = self._folder.endpoint(name)
            except ConfigError as error:
                if str(error) != self._unsafe:
                    self._unsafe = str(error)
                    self._report_event("error", self._unsafe)
                return
            before = self._connected.get(name)
            if endpoint and endpoint != before:
                if before is not None:
                    one.disconnect(before)
                one.connect(endpoint)
                self._connected[name] = endpoint
        self._unsafe = ""

    def _pass_commands(self) -> None:
        """Take some; the rest waits with its sender."""
        served = 0
        for _ in range(_DROPPED_A_ROUND):
            if served == MESSAGES_A_ROUND:
                return
            for parcel in self._keyed.door.receive(1):
                served += self._receive(parcel)

    def _receive(self, parcel: Parcel) -> bool:
        """Pass one message on, or answer it; false if it was only counted."""
        key = self._keyed.key_of(parcel.payload)
        address = frame_property(parcel.payload, "Peer-Address")
        payload, now_s = bytes(parcel.payload.buffer), self._clock.now_s()
        admitted = admit(key, address, payload, self._intake, now_s)
        if isinstance(admitted, Reply):
            name = _NO_KEY if key is None else key.name
            if not self._intake.answers_refusal(name, now_s):
                if key is not None and not self._unanswered.within(name, now_s):
                    self._keyed.ban(key)
                return False
            self._answer(parcel, admitted)
        elif not self._send(self._encode((parcel.identity, parcel.tag)), admitted):
            self._answer(parcel, _NO_SUPERVISOR)
        return True

    def _pass_replies(self) -> None:
        for _ in range(QUEUED):
            try:
                route, payload = self._supervisor.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            identity, tag = self._decode_route(route)
            self._reply(identity, tag, payload)

    def _answer(self, parcel: Parcel, reply: Reply) -> None:
        timed = msgspec.structs.replace(reply, time_s=self._clock.now_s())
        self._reply(parcel.identity, parcel.tag, self._encode(timed))

    def _reply(self, identity: bytes, tag: bytes, payload: bytes) -> None:
        if not self._keyed.door.answer(identity, tag, payload):
            self._intake.drop("replies", "the client has gone, or does not read its replies")

    def _pass_telemetry(self) -> None:
        for _ in range(QUEUED):
            try:
                telemetry = self._telemetry.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                return
            self._keyed.publish(telemetry)

    def _report(self) -> None:
        """Tell the supervisor what is new; what it does not take now waits."""
        keys = self._keyed.allowed
        if self._events or keys is not self._reported:
            report = Report(keys=list(keys.values()), events=list(self._events))
            if self._send(b"", report):
                self._events.clear()
                self._reported = keys

    def _report_event(self, severity: Severity, text: str) -> None:
        self._events.append((severity, text))

    def _send(self, route: bytes, envelope: Passed | Report) -> bool:
        try:
            self._supervisor.send_multipart([route, self._encode(envelope)], zmq.NOBLOCK)
        except zmq.Again:
            return False
        return True
