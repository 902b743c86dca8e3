"""The service's clients on virtual time: a console and running sequences."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Sequence
from random import Random
from typing import Any

from benchmarks.swarm.invariants import ANSWERED_ONCE, Invariants
from benchmarks.swarm.service import SwarmService
from benchmarks.swarm.threads import VirtualEvent, VirtualTime
from fitctl.config import Rig
from fitctl.logging.records import (
    AnyRecord,
    Event,
    LoopTiming,
    MetrologyTick,
    ModeChange,
    PiezoReading,
    Tick,
)
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.telemetry import Telemetry
from fitctl.sequences import steps
from fitctl.sequences.contact import Contact
from fitctl.sequences.runner import Runner, run_steps
from fitctl.sequences.view import SequenceError
from fitctl.service.admission import Sender
from fitctl.supervisor.supervisor import Supervisor
from fitctl.tui.history import KEPT_S
from fitctl.tui.state import ConsoleState, LoopView

_VISIT: dict[str, Any] = {"dwell_s": 8.0, "steady_after_s": 5.0}
_STARS = [
    steps.Star(name="expected", az_sky_arcsec=0.0, el_sky_arcsec=0.0, duration_s=2.0),
    steps.Star(name="elsewhere", az_sky_arcsec=60.0, el_sky_arcsec=-40.0, duration_s=2.0),
]
STEPS: dict[str, Callable[[str], steps.Step]] = {
    "standby": lambda loop: steps.Standby(loop=loop),
    "acquire": lambda loop: steps.Acquire(loop=loop),
    "hold": lambda loop: steps.Hold(loop=loop, duration_s=5.0, settle_s=1.0, attempts=2),
    "stars": lambda loop: steps.Stars(loop=loop, stars=_STARS, settle_s=1.0),
    "wait": lambda _: steps.Wait(duration_s=30.0),
    "dither": lambda loop: steps.Dither(loop=loop, **_VISIT),
    "raster": lambda loop: steps.Raster(loop=loop, columns=2, rows=2, **_VISIT),
    "offset": lambda loop: steps.Offset(loop=loop, offset_az_px=0.5, offset_el_px=-0.5, **_VISIT),
    "controller": lambda loop: steps.Controller(loop=loop, name="minimum-variance"),
    "experiment": lambda loop: steps.Experiment(loop=loop, what="delay"),
    "chirp": lambda loop: steps.Chirp(loop=loop, channel="fsm_az", duration_s=4.0),
    "plate_scale": lambda loop: steps.PlateScale(loop=loop, duration_s=8.0),
    "dark": lambda _: steps.Dark(frames=20),
    "reference": lambda _: steps.Collector(action="reference"),
    "collector": lambda _: steps.Collector(action="start"),
    "collector_scan": lambda _: steps.CollectorScan(loop="left", amplitude_mm=1.0, cycles=1),
    "beam_scan": lambda _: steps.BeamScan(
        loop="metrology", span_sky_arcsec=100.0, slow_sky_arcsec_s=100.0, cycles=1
    ),
    "beam_standby": lambda _: steps.Standby(loop="metrology"),
    "ambient": lambda _: steps.Ambient(loop="metrology", duration_s=4.0),
    "visibility": lambda loop: steps.Visibility(loop=loop, duration_s=3.0, settle_s=1.0),
    "overlap": lambda loop: steps.Overlap(loop=loop, **_VISIT),
    "off": lambda loop: steps.Off(loop=loop),
}
"""The steps of which operators make their sequences, for a loop."""
_REPLY_S = 5.0
_HAS_WAITED_S = 0.5  # what is older has waited until the sequence received it


class Console:
    """A console that misses messages and must count them.

    Parameters
    ----------
    loss : float
        Fraction of the messages that do not arrive.
    """

    def __init__(
        self, invariants: Invariants, time: VirtualTime, random: Random, loss: float
    ) -> None:
        self._state = ConsoleState(0.0)
        self._invariants = invariants
        self._time = time
        self._random = random
        self._loss = loss
        self._missed = self._heard = 0
        self._service: SwarmService | None = None
        self._supervisor: Supervisor | None = None

    def connect(self, service: SwarmService, supervisor: Supervisor) -> None:
        """Receive telemetry from this service from now on."""
        self._service, self._supervisor = service, supervisor
        self._missed = self._heard = 0
        self._first = True
        service.subscribers.append(self._take)

    def _take(self, message: Telemetry) -> None:
        if self._random.random() < self._loss:
            self._missed += not self._first  # messages before the first cannot be counted
            return
        self._first = False
        self._heard += len(message.events)
        state, supervisor, service = self._state, self._supervisor, self._service
        state.accept(message, self._time.now_s())
        if supervisor is None or service is None:
            return
        for name, loop in supervisor.loops.items():
            view = state.loops[name]
            shown = view.state
            if shown.mode != loop.mode.name or shown.since_s != loop.mode_since_s:
                self._wrong(f"{name}: shows {shown.mode}, is {loop.mode.name}")
            self._shows_newest(name, view, service.newest, lossless=not self._loss)
        newest_event = next(iter(state.events), None)
        if message.events and newest_event is not service.newest.get((Event, "")):
            self._wrong(f"its newest event is {newest_event}")
        collector = None if supervisor.collector is None else supervisor.collector.state
        if message.collector != collector:
            self._wrong(f"the collector: shows {message.collector}, is {collector}")
        sequence = supervisor.sequences.status()
        if message.running_sequence != sequence:
            self._wrong(f"a sequence: shows {message.running_sequence}, is {sequence}")
        if state.missed != self._missed:
            self._wrong(f"{self._missed} messages missed, {state.missed} counted")
        losses = message.losses
        if not (
            self._missed or self._loss or losses.events_unsent or self._heard == service.events
        ):
            self._wrong(f"{service.events} events, {self._heard} heard, none missed")

    def _shows_newest(
        self,
        name: str,
        view: LoopView,
        newest: dict[tuple[type, str], AnyRecord],
        *,
        lossless: bool,
    ) -> None:
        """What it shows of a loop is what the supervisor recorded last; ticks are sent only once."""
        shown: dict[type, Any] = {
            ModeChange: view.change,
            LoopTiming: view.timing,
            PiezoReading: view.piezo,
        }
        if lossless:
            shown |= {Tick: view.tick, MetrologyTick: view.beam}
        for kind, record in shown.items():
            recorded = newest.get((kind, name))
            if recorded is not None and record is not recorded and record != recorded:
                self._wrong(f"{name}: shows {record}, recorded is {recorded}")
        recorded = newest.get((Tick, name)) or newest.get((MetrologyTick, name))
        if recorded is None or recorded.time_s < self._time.now_s() - KEPT_S:
            return
        if lossless and view.past.newest_s != recorded.time_s:
            self._wrong(
                f"{name}: its traces end at {view.past.newest_s} s, not {recorded.time_s} s"
            )

    def _wrong(self, detail: str) -> None:
        self._invariants.violated("the console shows what is", detail)


class Link:
    """A sequence's connection; stands for :class:`fitctl.messages.client.Client`.

    Parameters
    ----------
    service : callable
        Returns the present service, or None.
    sender : Sender
    violated : callable
        Takes what must not be, and its detail.

    Attributes
    ----------
    loops : collection of str
        Those that have had a step. Once the sequence has heard that one of them is SAFE, it must end.
    """

    def __init__(
        self,
        time: VirtualTime,
        service: Callable[[], SwarmService | None],
        sender: Sender,
        violated: Callable[[str, str], None],
    ) -> None:
        self._time = time
        self._violated = violated
        self._service = service
        self._sender = sender
        self._telemetry: list[Telemetry] = []
        self._some = VirtualEvent(time)
        self._heard: SwarmService | None = None
        self.loops: Collection[str] = ()
        self._safe_since_s = math.inf
        self._must_end = False

    def now_s(self) -> float:
        """The virtual time."""
        return self._time.now_s()

    def send(self, command: AnyCommand) -> Reply:
        """Send a command, and wait for its reply.

        Raises
        ------
        ConnectionError
            If no reply arrives in time.
        """
        service, answered, replies = self._service(), VirtualEvent(self._time), []
        name, awake_s = type(command).__name__, self._time.awake_s()

        def answer(reply: Reply) -> None:
            replies.append(reply)
            answered.set()
            if len(replies) > 1:
                self._violated(ANSWERED_ONCE, f"{name} of a sequence: twice")

        if service is not None:
            service.send(self._sender, command, answer)
        if not answered.wait(_REPLY_S):
            awaited_s = self._time.awake_s() - awake_s
            if service is not None and service is self._service() and awaited_s >= _REPLY_S:
                self._violated(ANSWERED_ONCE, f"{name} of a sequence: not within {_REPLY_S:g} s")
            msg = f"no reply within {_REPLY_S:g} s"
            raise ConnectionError(msg)
        return replies[0]

    def receive(self, timeout_s: float) -> Telemetry | None:
        """The next telemetry, or None if none arrives in time."""
        service = self._service()
        if service is not None and service is not self._heard:
            self._heard = service
            service.subscribers.append(self._take)
        if not self._telemetry:
            self._some.clear()
            self._some.wait(timeout_s)
        message = self._telemetry.pop(0) if self._telemetry else None
        if message is not None:
            self._end_if_safe(message)
        return message

    def _end_if_safe(self, message: Telemetry) -> None:
        """Between two steps a sequence skips messages that have waited for it; of them nothing is required."""
        if self._must_end:
            self._violated(
                "a sequence ends if a loop that has had a step is SAFE",
                f"it goes on at {message.time_s:.2f} s",
            )
        is_safe = any(loop.name in self.loops and loop.mode == "SAFE" for loop in message.loops)
        if not is_safe:
            self._safe_since_s = math.inf
        elif self._time.now_s() - message.time_s < _HAS_WAITED_S:
            self._safe_since_s = min(self._safe_since_s, message.time_s)
        self._must_end = message.time_s - self._safe_since_s > 2 * _HAS_WAITED_S

    def close(self) -> None:
        """Stop receiving telemetry."""
        if self._heard is not None:
            self._heard.subscribers.remove(self._take)

    def _take(self, message: Telemetry) -> None:
        self._telemetry.append(message)
        self._some.set()


class RunningSequence:
    """A sequence of `STEPS` in its own process. It may end in any way, but must end.

    Attributes
    ----------
    ended : bool
    """

    def __init__(self, link: Link, rig: Rig, loop: str, words: Sequence[str]) -> None:
        self.ended = False
        self._link = link
        self._steps = [STEPS[word](loop) for word in words]
        self._contact = Contact(link, rig, "swarm", len(words))  # pyrefly: ignore[bad-argument-type]
        link.loops = self._contact.loops

    def run(self) -> None:
        """Run the sequence; called in its own thread."""
        try:
            run_steps(Runner(self._contact), self._steps)
        except (SequenceError, ConnectionError):
            pass  # refused, failed or stopped
        finally:
            self.ended = True
            self._link.close()

    def stop(self) -> None:
        """Request the end of the sequence."""
        self._contact.stop_wanted.set()
