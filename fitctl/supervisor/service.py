"""The supervisor's service: commands come in by its doors, are admitted or refused, and telemetry goes out.

One thread, so that nothing here can hold the loop: records are left in bounded buffers and picked up
from there, replies likewise. However much comes in, it takes a bounded part of the interpreter.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from functools import partial
from pathlib import Path
from queue import Empty, SimpleQueue
from typing import NamedTuple

import msgspec
import zmq

from fitctl.clock import Clock
from fitctl.supervisor.admission import Admission, Sender
from fitctl.supervisor.command_table import ROWS, command_record
from fitctl.supervisor.doors import FRAMES, Door, KeyedDoor, Parcel, local_door
from fitctl.supervisor.messages import (
    AnyCommand,
    RecentEvents,
    RecorderReport,
    Reply,
    Status,
    Stop,
    TakeOver,
    decode_command,
)
from fitctl.supervisor.supervisor import Supervisor
from fitctl.supervisor.telemetry import ServiceState, TelemetryBuffer

SOURCE = "service"  # of its events
_ROUND_MS = 5
_FRAMES_A_ROUND = 8 * FRAMES
_HANDSHAKES_A_ROUND = 4
_JOINED_STOPS = 1000
_LOOK_S = 0.25
_TELL_S = 5.0


class Waiting(NamedTuple):
    """Whom an answer is for."""

    door: Door
    parcel: Parcel


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

    Raises
    ------
    ConfigError
        If the rig's TCP address or its keys cannot be used.
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
        self._replies: SimpleQueue[tuple[Waiting, Reply, str | None]] = SimpleQueue()
        self._stops: dict[str, deque[Waiting]] = {}  # by loop: who waits with one that is under way
        self._dropped: Counter[tuple[str, str]] = Counter()
        self._tell_s = 0.0
        self._encode = msgspec.msgpack.Encoder().encode
        self._admission = Admission(settings.lease_s, settings.commands_per_s)
        self._too_many = Reply(
            accepted=False,
            text=f"more than {settings.commands_per_s:g} commands a second; wait, then try again",
        )
        self._keyed: KeyedDoor | None = None
        if settings.tcp_address:
            self._keyed = KeyedDoor(
                supervisor.rig, lambda problem: supervisor.note("warning", SOURCE, problem)
            )
        self._context = zmq.Context()
        self._doors = [local_door(self._context, folder)]
        if self._keyed is not None:
            self._doors.append(self._keyed.door)

    def stop(self) -> None:
        """Publish once more, send what replies there are, and end."""
        self._ending.set()
        self.join(timeout=5.0)

    def run(self) -> None:
        """Serve; this is the thread."""
        poller = zmq.Poller()
        for door in self._doors:
            poller.register(door.router, zmq.POLLIN)
        if self._keyed is not None:
            poller.register(self._keyed.zap, zmq.POLLIN)
        publish_s = look_s = self._clock.now_s()
        try:
            while not self._ending.is_set():
                if poller.poll(_ROUND_MS):
                    self._serve()
                    self._send_replies()
                    self._ending.wait(_ROUND_MS / 1000)  # however much more there is
                self._send_replies()
                now_s = self._clock.now_s()
                if now_s >= publish_s:
                    self._publish(now_s)
                    publish_s = max(publish_s + self._period_s, now_s)
                if now_s >= look_s:
                    self._look_after_keys()
                    self._tell_dropped(now_s)
                    look_s = now_s + _LOOK_S
            self._send_replies()
            self._publish(self._clock.now_s())
        finally:
            self._doors[0].close()
            self._context.term()
            if self._keyed is not None:
                self._keyed.close()

    # ------------------------------------------------------------ commands

    def _serve(self) -> None:
        """Take a bounded number of messages from each door."""
        if self._keyed is not None:
            self._keyed.admit(_HANDSHAKES_A_ROUND)
        for door in self._doors:
            for parcel in door.take(_FRAMES_A_ROUND):
                self._receive(Waiting(door, parcel))

    def _receive(self, waiting: Waiting) -> None:
        sender, now_s = waiting.parcel.sender, self._clock.now_s()
        if sender is None:
            self._answer(waiting, Reply(accepted=False, text="this key has been revoked"))
            return
        command = decode_command(waiting.parcel.payload)
        within_rate = self._admission.within_rate(sender, now_s)
        if not within_rate and not isinstance(command, Stop):
            self._drop(sender, "over the rate limit")
            self._answer(waiting, self._too_many)
        elif isinstance(command, Reply):
            self._drop(sender, "no commands")
            self._answer(waiting, command)
        elif not within_rate and self._joins_a_stop(waiting, command, sender):
            self._drop(sender, "stops besides one under way")
        else:
            self._obey(waiting, command, sender, now_s)

    def _joins_a_stop(self, waiting: Waiting, command: AnyCommand, sender: Sender) -> bool:
        """Whether this stop, of too many, waits for the answer to one that is under way."""
        if sender.role != "commander" or command.loop not in self._stops:
            return False
        self._stops[command.loop].append(waiting)
        return True

    def _obey(self, waiting: Waiting, command: AnyCommand, sender: Sender, now_s: float) -> None:
        commander = self._admission.commander(now_s)
        refusal = self._admission.refusal(sender, command, now_s)
        match command:
            case _ if refusal:
                self._answer_here(waiting, command, Reply(accepted=False, text=refusal))
            case Status():
                text = self._status_text()
                self._answer_here(waiting, command, Reply(accepted=True, text=text))
            case RecentEvents():
                events = self._buffer.recent_events()
                text = f"the last {len(events)} events"
                told = Reply(accepted=True, text=text, events=events)
                self._answer_here(waiting, command, told)
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
        told = f"{now} has the instrument"
        if before not in {"", now}:
            told += f", taken over from {before}"
            self._supervisor.note("warning", SOURCE, told)
        return told

    def _done(self, waiting: Waiting, stopped: str | None, reply: Reply) -> None:
        """Leave the reply for this thread; called from the supervisor's."""
        self._replies.put((waiting, reply, stopped))

    def _answer_here(self, waiting: Waiting, command: AnyCommand, reply: Reply) -> None:
        """Answer what does not reach the supervisor, and keep who asked."""
        sender = waiting.parcel.sender
        if sender is not None and ROWS[type(command)].logged:
            now_s = self._clock.now_s()
            self._supervisor.leave(
                command_record(command, reply, sender.name, sender.address, now_s)
            )
        self._answer(waiting, reply)

    def _status_text(self) -> str:
        return ", ".join(
            f"{name} {loop.mode.name}" for name, loop in self._supervisor.loops.items()
        )

    def _send_replies(self) -> None:
        while True:
            try:
                waiting, reply, stopped = self._replies.get_nowait()
            except Empty:
                return
            self._answer(waiting, reply)
            for joined in self._stops.pop(stopped, ()) if stopped is not None else ():
                self._answer(joined, reply)

    def _answer(self, waiting: Waiting, reply: Reply) -> None:
        timed = msgspec.structs.replace(reply, time_s=self._clock.now_s())
        parcel = waiting.parcel
        if not waiting.door.answer(parcel.identity, parcel.tag, self._encode(timed)):
            self._state.replies_unsent += 1

    # ------------------------------------------------------------ telemetry and housekeeping

    def _publish(self, now_s: float) -> None:
        self._state.sequence += 1
        self._state.commander = self._admission.commander(now_s)
        payload = self._encode(self._buffer.telemetry(self._supervisor, self._state, now_s))
        for door in self._doors:
            door.publish(payload)

    def _look_after_keys(self) -> None:
        for name in self._keyed.refresh() if self._keyed is not None else ():
            self._admission.release(name)
            self._supervisor.note("warning", SOURCE, f"the key {name} was revoked or changed")

    def _drop(self, sender: Sender, why: str) -> None:
        self._dropped[sender.name, why] += 1

    def _tell_dropped(self, now_s: float) -> None:
        """Say how many messages were not taken, now and then."""
        if self._dropped and now_s >= self._tell_s:
            for (name, why), count in self._dropped.items():
                self._supervisor.note("warning", SOURCE, f"{name}: {count} messages, {why}")
            self._dropped.clear()
            self._tell_s = now_s + _TELL_S
