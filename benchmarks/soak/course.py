"""What telemetry told of a soak: what the ticks took, and whether the loop came back after each strike."""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from fitctl.logging.records import Event, LoopTiming, Losses, Tick
from fitctl.messages.telemetry import Telemetry

_EVENTS_KEPT = 60


class Struck(NamedTuple):
    """One strike and what became of it; `back_s` counts from its end, NaN if the loop did not come back."""

    at_s: float
    name: str
    held_s: float
    back_s: float
    told: tuple[str, ...]


@dataclass
class Span:
    """Ticks and servo seconds of one kind of time: quiet, or from a strike until the loop is back."""

    compute_s: array = field(default_factory=lambda: array("d"))
    servo_worst_s: array = field(default_factory=lambda: array("d"))
    servo_median_s: array = field(default_factory=lambda: array("d"))
    late_ticks: int = 0
    stalls: int = 0
    worst_stall_s: float = 0.0
    servo_skipped: int = 0
    servo_missed: int = 0

    def add_tick(self, tick: Tick) -> None:
        """One tick that had a frame."""
        self.compute_s.append(tick.compute_s)
        self.late_ticks += tick.late

    def add_timing(self, timing: LoopTiming) -> None:
        """One second of the servo."""
        if not math.isnan(timing.servo_late_worst_s):
            self.servo_worst_s.append(timing.servo_late_worst_s)
            self.servo_median_s.append(timing.servo_late_median_s)
        self.stalls += timing.stalls
        self.worst_stall_s = max(self.worst_stall_s, timing.worst_stall_s)
        self.servo_skipped += timing.servo_skipped
        self.servo_missed += timing.servo_missed

    def figures(self) -> dict[str, float]:
        """Counts, and times in ms; NaN where there was nothing."""
        return {
            "ticks": len(self.compute_s),
            "tick_median_ms": _percentile_ms(self.compute_s, 50),
            "tick_99_ms": _percentile_ms(self.compute_s, 99),
            "tick_worst_ms": _percentile_ms(self.compute_s, 100),
            "late_ticks": self.late_ticks,
            "servo_median_ms": _percentile_ms(self.servo_median_s, 50),
            "servo_99_ms": _percentile_ms(self.servo_worst_s, 99),
            "servo_worst_ms": _percentile_ms(self.servo_worst_s, 100),
            "servo_skipped": self.servo_skipped,
            "servo_missed": self.servo_missed,
            "machine_stalls": self.stalls,
            "worst_stall_ms": 1e3 * self.worst_stall_s,
        }


def _percentile_ms(values_s: array, percent: float) -> float:
    return 1e3 * float(np.percentile(values_s, percent)) if values_s else math.nan


class Course:
    """Everything that is kept of the telemetry.

    Attributes
    ----------
    quiet : bool
        The loop is in VERNIER, and nothing has struck: set by whoever strikes.
    spans : dict of Span
        By `quiet`.
    departures : list of str
        Why the loop left VERNIER in quiet time.
    messages_missed : int
        Telemetry that this client did not get.
    losses : Losses or None
        Of the supervisor's queues, by the last message.
    """

    def __init__(self) -> None:
        self.quiet = False
        self.spans = {True: Span(), False: Span()}
        self.departures: list[str] = []
        self.messages_missed = 0
        self.losses: Losses | None = None
        self.struck: list[Struck] = []
        self.newest: Telemetry | None = None
        self.events: deque[Event] = deque(maxlen=_EVENTS_KEPT)
        self._timed_s = 0.0

    @property
    def mode(self) -> str:
        """Of the loop, by the last message."""
        return self.newest.loops[0].mode if self.newest else ""

    def add(self, telemetry: Telemetry) -> None:
        """Take one message."""
        if self.newest is not None:
            self.messages_missed += telemetry.sequence - self.newest.sequence - 1
        self.newest = telemetry
        self.events.extend(telemetry.events)
        self.losses = telemetry.losses
        span = self.spans[self.quiet]
        for tick in telemetry.ticks:
            if tick.number >= 0:
                span.add_tick(tick)
        for timing in telemetry.timing:
            if timing.time_s > self._timed_s:
                self._timed_s = timing.time_s
                span.add_timing(timing)
        if self.quiet and self.mode != "VERNIER":
            change = telemetry.loops[0].last_change
            self.departures.append(f"{self.mode}: {change.reason if change else ''}")
            self.quiet = False

    def told_since(self, time_s: float) -> tuple[str, ...]:
        """Messages of the events since then."""
        return tuple(event.message for event in self.events if event.time_s >= time_s)
