"""The supervisor's service: commands come in by its doors, are admitted or refused, and telemetry goes out.

One thread, so that nothing here can hold the loop: records are left in bounded buffers and picked up
from there, replies likewise. However much comes in, it takes a bounded part of the interpreter. Everything
here is a Unix socket: what comes by TCP is brought by the gateway (:mod:`fitctl.service.gateway`), in
envelopes that are taken from its socket alone.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterable
from contextlib import suppress
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple

import msgspec
import zmq

from fitctl.clock import Clock
from fitctl.config import ConfigError
from fitctl.logging.records import Snapshot
from fitctl.messages.command_table import ROWS, command_record, why_too_late
from fitctl.messages.commands import (
    AnyCommand,
    RecentEvents,
    RecorderReport,
    Reply,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.endpoints import (
    COMMAND_SOCKET,
    GATEWAY_SOCKET,
    TELEMETRY_SOCKET,
    file_identity,
    make_service_folder,
)
from fitctl.messages.keys import AllowedKey
from fitctl.service.admission import Admission, Sender
from fitctl.service.doors import (
    MESSAGES_A_ROUND,
    ROUND_MS,
    Door,
    local_sender,
    publisher_socket,
    router_socket,
)
from fitctl.service.envelope import MAX_ENVELOPE_BYTES, Passed, Report, decode_envelope
from fitctl.service.intake import Intake
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.supervisor.supervisor import Supervisor

SOURCE = "service"  # of its events
GATEWAY = "gateway"  # of what that tells
_JOINED_STOPS = 1000
_REPORT_PERIOD_S = 0.25
_SNAPSHOT_PERIOD_S = 1.0  # of what a console shows of a log


class Waiting(NamedTuple):
    """Whom an answer is for."""

    door: Door
    identity: bytes
    tag: bytes
    sender: Sender


class Service(threading.Thread):
    """Answers commands and publishes telemetry until :meth:`stop`.

    Parameters
    ----------
    supervisor : Supervisor
    buffer : TelemetryBuffer
    folder : Path
        Where the Unix sockets are made.
    state : ServiceState
    clock : Clock
    """

    def __init__(
        self,
        supervisor: Supervisor,
        buffer: TelemetryBuffer,
        folder: Path,
        state: ServiceState,
        clock: Clock,
    ) -> None:
        super().__init__(name="service", daemon=True)
        settings = supervisor.rig.service
        self._supervisor = supervisor
        self._buffer = buffer
        self._state = state
        self._clock = clock
        self._period_s = 1.0 / supervisor.rig.supervisor.telemetry_hz
        self._ending = threading.Event()
        self._replies: SimpleQueue[tuple[Waiting, Reply, Iterable[Waiting]]] = SimpleQueue()
        self._stops: dict[str, deque[Waiting]] = {}  # by loop: who waits with one that is under way
        self._encode = msgspec.msgpack.Encoder().encode
        self._intake = Intake(settings.commands_per_s, supervisor.loops)
        self._admission = Admission(settings.lease_s)
        self._keys: dict[str, AllowedKey] = {}  # by name, as the gateway last reported
        self._context = zmq.Context()
        self._local = Door(router_socket(self._context))
        self._gateway = Door(router_socket(self._context, MAX_ENVELOPE_BYTES))
        self._publisher = publisher_socket(self._context)
        self._bound = {folder / COMMAND_SOCKET: self._local.router}
        if settings.tcp_address:
            self._bound[folder / GATEWAY_SOCKET] = self._gateway.router
        self._bound[folder / TELEMETRY_SOCKET] = self._publisher
        for path, bare in self._bound.items():
            bare.bind(f"ipc://{path}")
        self._files = {path: file_identity(path) for path in self._bound}
        self._snapshot_s = clock.now_s()
        self._unmade = ""  # why the folder cannot be made anew, as last reported

    def stop(self) -> None:
        """Publish once more, send what replies there are, and end."""
        self._ending.set()
        self.join(timeout=5.0)
        self._supervisor.record_left()  # no step follows

    def run(self) -> None:
        """Serve; this is the thread."""
        poller = zmq.Poller()
        for door in (self._local, self._gateway):
            poller.register(door.router, zmq.POLLIN)
        publish_s = report_s = self._clock.now_s()
        try:
            while not self._ending.is_set():
                if poller.poll(ROUND_MS):
                    self._serve()
                    self._send_replies()
                    self._ending.wait(ROUND_MS / 1000)  # however much more there is
                self._send_replies()
                now_s = self._clock.now_s()
                if now_s >= publish_s:
                    self._publish(now_s)
                    publish_s = max(publish_s + self._period_s, now_s)
                if now_s >= report_s:
                    for line in self._intake.dropped(now_s):
                        self._supervisor.report_event("warning", SOURCE, line)
                    self._bind_again()
                    report_s = now_s + _REPORT_PERIOD_S
            self._send_replies()
            self._publish(self._clock.now_s())
        finally:
            for socket in (self._local.router, self._gateway.router, self._publisher):
                socket.close()
            self._context.term()

    def _bind_again(self) -> None:
        """Make those sockets anew whose files have vanished: a tidied folder must not make us deaf.

        Connections that there are stay; clients find the new sockets by themselves.
        """
        gone = [path for path, file in self._files.items() if file_identity(path) != file]
        if not gone:
            return
        try:
            folder = make_service_folder(self._supervisor.rig)
            for path in gone:
                with suppress(zmq.ZMQError):  # it was unbound before, and could not be bound
                    self._bound[path].unbind(f"ipc://{path}")
                self._bound[path].bind(f"ipc://{path}")
                self._files[path] = file_identity(path)
        except (ConfigError, zmq.ZMQError) as error:
            if str(error) != self._unmade:
                self._unmade = str(error)
                text = f"no command from this machine can arrive: the sockets have vanished, and {error}"
                self._supervisor.report_event("error", SOURCE, text)
            return
        self._unmade = ""
        names = ", ".join(path.name for path in gone)
        text = f"sockets were removed from {folder} and have been restored: {names}"
        self._supervisor.report_event("warning", SOURCE, text)

    # ------------------------------------------------------------ commands

    def _serve(self) -> None:
        """Take a bounded number of messages from each door."""
        for parcel in self._local.receive(MESSAGES_A_ROUND):
            waiting = Waiting(
                self._local, parcel.identity, parcel.tag, local_sender(parcel.payload)
            )
            self._receive(waiting, bytes(parcel.payload.buffer))
        for parcel in self._gateway.receive(MESSAGES_A_ROUND):
            self._open(parcel.identity, parcel.tag, bytes(parcel.payload.buffer))

    def _open(self, identity: bytes, tag: bytes, payload: bytes) -> None:
        """Take an envelope of the gateway."""
        match decode_envelope(payload):
            case Passed() as passed:
                sender = Sender(passed.name, passed.address, passed.role, is_local=False)
                self._receive(Waiting(self._gateway, identity, tag, sender), passed.payload)
            case Report() as report:
                self._apply_report(report)
            case None:
                self._intake.drop(GATEWAY, "no envelopes")

    def _apply_report(self, report: Report) -> None:
        """Take the lease from a person whose key was revoked, and report the gateway's messages."""
        before, self._keys = self._keys, {key.name: key for key in report.keys}
        for name, key in before.items():
            if self._keys.get(name) != key:
                self._admission.release(name)
                self._supervisor.report_event(
                    "warning", SOURCE, f"the key {name} was revoked or changed"
                )
        for severity, text in report.events:
            self._supervisor.report_event(severity, GATEWAY, text)

    def _receive(self, waiting: Waiting, payload: bytes) -> None:
        sender, now_s = waiting.sender, self._clock.now_s()
        accepted = self._intake.accept(sender.name, sender.role, payload, now_s)
        if isinstance(accepted, Reply):
            self._refuse(waiting, accepted, now_s)
        elif accepted.over_rate and self._joins_a_stop(waiting, accepted.command):
            self._intake.drop(sender.name, "stops besides one under way")
        else:
            self._obey(waiting, accepted.command, now_s)

    def _joins_a_stop(self, waiting: Waiting, command: AnyCommand) -> bool:
        """Whether this stop, of too many, waits for the answer to one that is under way."""
        joined = self._stops.get(command.loop)
        if joined is None:
            return False
        joined.append(waiting)
        return True

    def _obey(self, waiting: Waiting, command: AnyCommand, now_s: float) -> None:
        sender = waiting.sender
        commander = self._admission.commander(now_s)
        refusal = why_too_late(command, now_s)
        refusal = refusal or self._admission.refusal(sender, command, now_s)
        match command:
            case _ if refusal:
                reply = Reply(accepted=False, text=refusal)
                if ROWS[type(command)].logged and self._intake.logs_refusal(sender.name, now_s):
                    self._record(waiting, command, reply, now_s)
                self._refuse(waiting, reply, now_s)
            case Status():
                text = self._supervisor.modes_of(self._supervisor.loops)
                self._answer_here(waiting, command, Reply(accepted=True, text=text))
            case RecentEvents():
                events = self._buffer.recent_events()
                text = f"the last {len(events)} events" if events else "no events yet"
                reply = Reply(accepted=True, text=text, events=events)
                self._answer_here(waiting, command, reply)
            case RecorderReport():
                self._buffer.recorder = command.status
                self._answer_here(waiting, command, Reply(accepted=True))
            case TakeOver():
                text = self._taken_over(commander, sender.name)
                self._answer_here(waiting, command, Reply(accepted=True, text=text))
            case _:
                stops = isinstance(command, Stop)
                if stops:
                    self._stops.setdefault(command.loop, deque(maxlen=_JOINED_STOPS))
                done = partial(self._done, waiting, command.loop if stops else None)
                self._supervisor.post(command, done, sender.name, sender.address)

    def _taken_over(self, before: str, now: str) -> str:
        text = f"{now} has the instrument"
        if before not in {"", now}:
            text += f", taken over from {before}"
            self._supervisor.report_event("warning", SOURCE, text)
        return text

    def _done(self, waiting: Waiting, stopped: str | None, reply: Reply) -> None:
        """Leave the reply for this thread; called from the supervisor's, before it obeys the next command."""
        # No stop joins this one from now on: a `recover` may come between the two.
        joined = () if stopped is None else self._stops.pop(stopped, ())
        self._replies.put((waiting, reply, joined))

    def _answer_here(self, waiting: Waiting, command: AnyCommand, reply: Reply) -> None:
        """Answer what does not reach the supervisor, and keep who asked."""
        if ROWS[type(command)].logged:
            self._record(waiting, command, reply, self._clock.now_s())
        self._answer(waiting, reply)

    def _refuse(self, waiting: Waiting, reply: Reply, now_s: float) -> None:
        """Answer with a refusal, unless a sender elsewhere has had too many."""
        sender = waiting.sender
        if sender.is_local or self._intake.answers_refusal(sender.name, now_s):
            self._answer(waiting, reply)

    def _record(self, waiting: Waiting, command: AnyCommand, reply: Reply, now_s: float) -> None:
        sender = waiting.sender
        self._supervisor.leave(command_record(command, reply, sender.name, sender.address, now_s))

    def _send_replies(self) -> None:
        while True:
            try:
                waiting, reply, joined = self._replies.get_nowait()
            except Empty:
                return
            for each in (waiting, *joined):
                self._answer(each, reply)

    def _answer(self, waiting: Waiting, reply: Reply) -> None:
        timed = msgspec.structs.replace(reply, time_s=self._clock.now_s())
        if not waiting.door.answer(waiting.identity, waiting.tag, self._encode(timed)):
            self._state.replies_unsent += 1

    # ------------------------------------------------------------ telemetry

    def _publish(self, now_s: float) -> None:
        self._state.sequence += 1
        self._state.commander = self._admission.commander(now_s)
        telemetry = self._buffer.telemetry(self._supervisor, self._state, now_s)
        payload = self._encode(telemetry)
        if now_s >= self._snapshot_s:
            self._snapshot_s = now_s + _SNAPSHOT_PERIOD_S
            state = self._encode(telemetry.unlogged)
            self._supervisor.leave(Snapshot(time_s=now_s, state_msgpack=state))
        with suppress(zmq.Again):
            self._publisher.send(payload, zmq.NOBLOCK)
