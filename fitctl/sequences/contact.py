"""A sequence's contact with the supervisor: telemetry in, reports out, and who wants it to end."""

from __future__ import annotations

import math
import threading
import uuid
from collections.abc import Callable
from contextlib import suppress
from typing import Literal

import msgspec

from fitctl.config import Rig
from fitctl.messages.commands import Reply, SequenceReport, SequenceStatus
from fitctl.messages.modes import Mode
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.waiting import RECEIVE_S, SILENCE_S
from fitctl.sequences.links import Link
from fitctl.sequences.view import SequenceError, View
from fitctl.supervisor.sequence_board import SILENCE_S as FORGOTTEN_S

MESSAGE_CHARS = 300
_REPORT_S = 1.0


class Stopped(Exception):
    """Somebody wants the whole sequence to end; `release` says whether its loops then release their stars."""

    def __init__(self, message: str, *, release: bool) -> None:
        super().__init__(message)
        self.release = release


class Forgotten(ConnectionError):
    """The supervisor no longer knows this sequence; another one may be under way."""


class Contact:
    """Telemetry in, reports out.

    Parameters
    ----------
    link : Link
    rig : Rig
    name : str
    steps : int
        How many there will be.
    on_status : callable
        Called at every change: a new attempt, a pause, an end.
    """

    def __init__(
        self,
        link: Link,
        rig: Rig,
        name: str,
        steps: int,
        on_status: Callable[[SequenceStatus], None] = lambda _status: None,
    ) -> None:
        self.stop_wanted = threading.Event()  # from another thread, such as a cancelled task's
        self.status = SequenceStatus(run=uuid.uuid4().hex, name=name, state="running", steps=steps)
        self.link = link
        self.rig = rig
        # Those that have had a step, in their order; also the one of the present step.
        self.loops: dict[str, None] = {}
        self._on_status = on_status
        self._wanted = "run"
        self._reported_s = 0.0
        self._accepted_s = -math.inf  # when the last report that was accepted was sent

    def begin(self) -> None:
        """Report to the supervisor that a sequence begins.

        Raises
        ------
        SequenceError
            If it refuses, because another is under way.
        ConnectionError
            If there is no supervisor.
        """
        reply = self._send_report()
        if not reply.accepted:
            raise SequenceError(reply.text)
        self._on_status(self.status)

    def end(self, state: Literal["done", "failed", "stopped"], message: str = "") -> None:
        """Report to the supervisor how it ended, if it still answers."""
        with suppress(ConnectionError):
            self.report(state=state, message=message[:MESSAGE_CHARS])

    @property
    def pause_wanted(self) -> bool:
        """The operator wants a pause."""
        return self._wanted == "pause"

    # ------------------------------------------------------------ telemetry

    def view_of(self, loop_name: str) -> View:
        """A view that begins with telemetry from now on: older may have queued up between two steps."""
        since_s = self.link.now_s()
        telemetry = self._receive()
        while telemetry.time_s < since_s:
            telemetry = self._receive()
        view = View(
            self.link, self.rig, loop_name, telemetry, telemetry.time_s, self.status.attempt
        )
        self._obey(view)
        return view

    def next(self, view: View, *, paused: bool = False) -> None:
        """Wait for the next message.

        Raises
        ------
        Stopped
            If a loop that has had a step is SAFE, or somebody stops the sequence.
        """
        view.update(self._receive(), paused=paused)
        self._obey(view)
        if paused:
            self.show_pause(paused=True)
        if self.link.now_s() - self._reported_s >= _REPORT_S:
            self.report()

    def _receive(self) -> Telemetry:
        begun_s = self.link.now_s()
        while True:
            telemetry = self.link.receive(RECEIVE_S)
            if telemetry is not None:
                return telemetry
            if self.stop_wanted.is_set():
                msg = "stopped by its program"
                raise Stopped(msg, release=True)
            if self.link.now_s() - begun_s > SILENCE_S:
                msg = f"the supervisor has been silent for {SILENCE_S:g} s; check it, then start again"
                raise ConnectionError(msg)

    def _obey(self, view: View) -> None:
        for loop in view.telemetry.loops:
            if loop.name in self.loops and loop.mode == Mode.SAFE.name:
                # No loop is commanded any more: SAFE has the last word.
                msg = f"loop {loop.name} is SAFE: {loop.why}; remove the cause, then: fitctl send recover"
                raise Stopped(msg, release=False)
        if self.stop_wanted.is_set():
            msg = "stopped by its program"
            raise Stopped(msg, release=True)
        running = view.telemetry.running_sequence
        if running is not None and running.run == self.status.run:
            self._wanted = running.wanted
        if self._wanted == "end":
            msg = "stopped by the operator"
            raise Stopped(msg, release=True)

    # ------------------------------------------------------------ reports

    def show_pause(self, *, paused: bool) -> bool:
        """Report when a pause begins or ends; True if one has just ended."""
        state: Literal["paused", "running"] = "paused" if paused else "running"
        if self.status.state == state:
            return False
        self.report(state=state)
        return not paused

    def report(self, **changes: object) -> None:
        """Report to the supervisor where the sequence is, with what has changed of it.

        A refused report is repeated with the next one: commands may exceed their rate for a moment. While the
        supervisor knows this sequence, no other can begin.

        Raises
        ------
        Forgotten
            If it has accepted none for so long that it no longer knows this sequence.
        ConnectionError
            If there is no supervisor.
        """
        self.status = msgspec.structs.replace(self.status, **changes)
        reply = self._send_report()
        if not reply.accepted and self._reported_s - self._accepted_s > FORGOTTEN_S:
            msg = f"the supervisor no longer knows this sequence: {reply.text}"
            raise Forgotten(msg)
        if changes:
            self._on_status(self.status)

    def _send_report(self) -> Reply:
        self._reported_s = self.link.now_s()
        reply = self.link.send(SequenceReport(status=self.status))
        if reply.accepted:
            self._accepted_s = self._reported_s
        return reply
