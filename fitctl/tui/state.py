"""What the console remembers of the telemetry: the newest of everything, and a short past of each loop."""

from __future__ import annotations

import math
import operator
from collections import deque
from dataclasses import dataclass, field
from typing import NamedTuple, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

from fitctl.logging.records import (
    Event,
    LoopTiming,
    MetrologyTick,
    ModeChange,
    Overlap,
    PiezoReading,
    Tick,
)
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.tui.history import Past

STALE_S = 1.0
EVENTS_KEPT = 500
RATE_MESSAGES = 60
TRAIL_STEP_SKY_ARCSEC = 3.0
READING_STEP_S = 1.0
READINGS_KEPT = 600
TICK_FIELDS = (
    "time_s",
    "error_az_px",
    "error_el_px",
    "fsm_az_rad",
    "fsm_el_rad",
    "frame_age_s",
    "compute_s",
    "sense_s",
    "decide_s",
    # For the error budget, from here on.
    "mid_exposure_s",
    "star_flux_dn",
    "mirror_az_rad",
    "mirror_el_rad",
    "siderostat_az_rad",
    "siderostat_el_rad",
    "link_az_rad",
    "link_el_rad",
    "sky_az_rad",
    "sky_el_rad",
)
FRINGE_FIELDS = ("time_s", "tilt_az_arcsec", "tilt_el_arcsec", "visibility")
_NO_BUDGET = (math.nan,) * (len(TICK_FIELDS) - TICK_FIELDS.index("star_flux_dn"))
_tick_row = operator.attrgetter(*TICK_FIELDS)
_fringe_row = operator.attrgetter(*FRINGE_FIELDS)


class Window(NamedTuple):
    """Over how much the RMS is taken, and how much of the past the traces show."""

    rms_s: float
    trace_s: float


WINDOWS = (Window(10.0, 20.0), Window(60.0, 60.0), Window(1.0, 5.0))


class _OfLoop(Protocol):
    @property
    def loop(self) -> str: ...


RecordT = TypeVar("RecordT", bound=_OfLoop)


def _last_of(loop: str, records: list[RecordT]) -> RecordT | None:
    return next((record for record in reversed(records) if record.loop == loop), None)


def _beam_row(tick: MetrologyTick, sky_arcsec_per_px: float) -> tuple[float, ...]:
    """A metrology tick in the columns of `TICK_FIELDS`: the beam's error in the camera's pixels, no mirror."""
    return (
        tick.time_s,
        tick.beam_az_arcsec / sky_arcsec_per_px,
        tick.beam_el_arcsec / sky_arcsec_per_px,
        math.nan,
        math.nan,
        tick.frame_age_s,
        tick.compute_s,
        tick.sense_s,
        tick.decide_s,
        tick.time_s,  # for mid-exposure
        *_NO_BUDGET,
    )


@dataclass
class LoopView:
    """One loop: its newest state and tick, its past, and the path of its search.

    Attributes
    ----------
    tick : Tick or None
        The newest of a stellar loop.
    beam : MetrologyTick or None
        The newest of a metrology loop.
    past : Past
        `TICK_FIELDS` of each tick, also of a metrology loop, whose error is the beam's in the camera's pixels.
    readings : dict of deque
        Time and value of each row of the table of interlocks, once in `READING_STEP_S`, the oldest first.
    """

    state: LoopState
    tick: Tick | None = None
    beam: MetrologyTick | None = None
    past: Past = field(default_factory=lambda: Past(TICK_FIELDS))
    change: ModeChange | None = None
    timing: LoopTiming | None = None
    piezo: PiezoReading | None = None
    search_trail_sky_arcsec: list[tuple[float, float]] = field(default_factory=list)
    readings: dict[str, deque[tuple[float, float]]] = field(default_factory=dict)

    def accept(self, state: LoopState, message: Telemetry) -> None:
        """Remember what a message has of this loop."""
        name = state.name
        if state.mode == "ACQUISITION" and state.since_s != self.state.since_s:
            self.search_trail_sky_arcsec.clear()
        self.state = state
        ticks = [tick for tick in message.ticks if tick.loop == name]
        beams = [tick for tick in message.metrology_ticks if tick.loop == name]
        scale = state.sky_arcsec_per_px
        rows = [*map(_tick_row, ticks), *(_beam_row(tick, scale) for tick in beams)]
        self.past.add(rows, message.time_s)
        self.tick = ticks[-1] if ticks else self.tick
        self.beam = beams[-1] if beams else self.beam
        self.remember_readings(state, message.time_s)
        self.change = state.last_change
        self.timing = _last_of(name, message.timing) or self.timing
        self.piezo = _last_of(name, message.piezo) or self.piezo
        if state.mode == "ACQUISITION":
            walked: list[Tick | MetrologyTick] = [*ticks, *beams]
            for tick in walked:
                if tick.time_s >= state.since_s:
                    self._extend_trail(tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec)

    def remember_readings(self, state: LoopState, time_s: float) -> None:
        """Keep what the interlocks read."""
        for row in state.watched:
            kept = self.readings.setdefault(row.name, deque(maxlen=READINGS_KEPT))
            if not kept or time_s - kept[-1][0] >= READING_STEP_S:
                kept.append((time_s, row.value))

    def _extend_trail(self, az_sky_arcsec: float, el_sky_arcsec: float) -> None:
        trail = self.search_trail_sky_arcsec
        here = (az_sky_arcsec, el_sky_arcsec)
        if not trail or math.dist(trail[-1], here) >= TRAIL_STEP_SKY_ARCSEC:
            trail.append(here)

    def errors(self, span_s: float) -> NDArray[np.float64]:
        """Time in s and errors az, el in px, one row a tick; shape (ticks, 3), oldest first."""
        return self.past.since(self.past.newest_s - span_s, "time_s", "error_az_px", "error_el_px")


@dataclass
class Rms:
    """Root mean square of the pointing error about the target, both axes, over `span_s` of data."""

    az_px: float
    el_px: float
    span_s: float


def error_rms(errors: NDArray[np.float64], since_s: float) -> Rms:
    """RMS of errors as :meth:`LoopView.errors` has them, but not from before `since_s`.

    Ticks without a star do not count, and none at all gives not-a-number.
    """
    recent = errors[(errors[:, 0] >= since_s) & np.isfinite(errors[:, 1:]).all(axis=1)]
    if len(recent) < 2:
        return Rms(math.nan, math.nan, 0.0)
    az_px, el_px = np.sqrt(np.mean(recent[:, 1:] ** 2, axis=0))
    return Rms(float(az_px), float(el_px), float(recent[-1, 0] - recent[0, 0]))


class ConsoleState:
    """Everything that the panels draw from. It belongs to the console's own thread.

    Attributes
    ----------
    newest : Telemetry or None
        The last message.
    received_s : float
        When it came, by the console's clock; before the first one, when the console started.
    loops : dict of LoopView
        By name, in the supervisor's order.
    events : deque of Event
        Newest first.
    events_missing : bool
        There may be events of this supervisor that this console has not heard.
    shown : str
        Name of the loop on the screen.
    window : Window
        One of `WINDOWS`, as the operator chose.
    missed : int
        Messages of this supervisor that did not come, because this console or its link was too slow.
    overlap : Overlap or None
        The newest tilt between the two stars, and the visibility that it leaves.
    fringes : Past
        `FRINGE_FIELDS` of each overlap.
    live : bool
        Whether it follows the supervisor; otherwise it is of the past.
    waits_for_supervisor : bool
        Whether silence is an alarm: it is not where most steps of a commissioning have no supervisor.
    """

    def __init__(self, started_s: float, *, waits_for_supervisor: bool = True) -> None:
        self.waits_for_supervisor = waits_for_supervisor
        self.newest: Telemetry | None = None
        self.received_s = started_s
        self.now_s = started_s
        self.loops: dict[str, LoopView] = {}
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self.events_missing = False
        self.shown = ""
        self.window = WINDOWS[0]
        self.missed = 0
        self.live = True
        self.overlap: Overlap | None = None
        self.fringes = Past(FRINGE_FIELDS)
        self._arrivals_s: deque[float] = deque(maxlen=RATE_MESSAGES)

    @property
    def rate_hz(self) -> float:
        """Messages a second, over the last few."""
        arrivals_s = self._arrivals_s
        span_s = arrivals_s[-1] - arrivals_s[0] if arrivals_s else 0.0
        return (len(arrivals_s) - 1) / span_s if span_s > 0 else 0.0

    def accept(self, message: Telemetry, now_s: float) -> None:
        """Take in one message that came at `now_s`."""
        if self.newest is not None and self.newest.pid != message.pid:
            self.loops.clear()  # another supervisor: its past is not this one's
            self.overlap, self.fringes = None, Past(FRINGE_FIELDS)
            if message.time_s < self.newest.time_s:
                self.events.clear()  # of a clock that has begun anew: their times mean nothing now
            self.newest = None
            self.missed = 0
            self._arrivals_s.clear()
        if self.newest is None:
            self.events_missing = True
        else:
            gap = max(0, message.sequence - self.newest.sequence - 1)
            self.missed += gap
            self.events_missing |= gap > 0
        self._arrivals_s.append(now_s)
        self.newest, self.received_s = message, now_s
        self.events.extendleft(message.events)
        self.fringes.add(map(_fringe_row, message.overlaps), message.time_s)
        self.overlap = message.overlaps[-1] if message.overlaps else self.overlap
        views = self.loops
        self.loops = {loop.name: views.get(loop.name, LoopView(loop)) for loop in message.loops}
        for loop in message.loops:
            self.loops[loop.name].accept(loop, message)
        if self.shown not in self.loops:
            self.shown = next(iter(self.loops), "")

    def recall(self, events: list[Event]) -> None:
        """Put events that the supervisor remembers where they belong, each once."""
        once = dict.fromkeys([*self.events, *reversed(events)])
        newest_first = sorted(once, key=lambda event: event.time_s, reverse=True)
        self.events = deque(newest_first[:EVENTS_KEPT], maxlen=EVENTS_KEPT)

    @property
    def loop(self) -> LoopView | None:
        """The loop on the screen."""
        return self.loops.get(self.shown)

    @property
    def mode(self) -> str:
        """The mode of the loop on the screen; empty before anything came."""
        return self.loop.state.mode if self.loop else ""

    @property
    def usable_commands(self) -> set[str]:
        """Commands that are possible now; none while nothing is known, or in the past."""
        known = self.live and self.loop and not self.stale
        return set(self.loop.state.usable_commands) if self.loop and known else set()

    def become(self, other: ConsoleState) -> None:
        """Hold what another state holds, for the panels that draw from this one; loop and window stay."""
        shown, window = self.shown, self.window
        vars(self).update(vars(other))
        self.window = window
        if shown in self.loops:
            self.shown = shown

    @property
    def silent_s(self) -> float:
        """How long nothing has come, at `now_s`."""
        return max(0.0, self.now_s - self.received_s)

    @property
    def stale(self) -> bool:
        """What is on the screen is old, or there is nothing yet."""
        return self.newest is None or self.silent_s > STALE_S

    def show_next_loop(self) -> None:
        """Cycle through the loops."""
        names = list(self.loops)
        if names:
            self.shown = names[(names.index(self.shown) + 1) % len(names)]

    def next_window(self) -> None:
        """Cycle through the windows of RMS and traces."""
        self.window = WINDOWS[(WINDOWS.index(self.window) + 1) % len(WINDOWS)]

    def wall_s(self, time_s: float) -> float:
        """Unix time of a monotonic time; not-a-number before anything came."""
        return time_s + self.newest.wall_minus_monotonic_s if self.newest else math.nan
