"""What one attempt at a step sees of the instrument, and how it speaks to it."""

from __future__ import annotations

from collections import defaultdict
from dataclasses import dataclass, field
from operator import attrgetter
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop, Rig
from fitctl.logging.records import FrameRecord, SequenceAttempt, Tick
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.modes import HOLDING, TRACKING, Mode
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.sequences.links import Link

Floats = NDArray[np.float64]
Figures = dict[str, float]


class SequenceError(Exception):
    """A sequence, or a step given from Python, did not end well; ``attempt`` is its last one, if any."""

    def __init__(self, message: str, attempt: SequenceAttempt | None = None) -> None:
        super().__init__(message)
        self.attempt = attempt


@dataclass
class Squares:
    """Errors of frames, added up: a long step need not remember them.

    Attributes
    ----------
    frames, with_star : int
        All, and those with a star.
    sum_px2 : array, shape (2,)
        Of the squares of these errors az, el.
    """

    frames: int = 0
    with_star: int = 0
    sum_px2: Floats = field(default_factory=lambda: np.zeros(2))

    def add(self, errors_px: Floats) -> None:
        """Add errors, shape (n, 2), NaN without a star."""
        with_star = errors_px[np.isfinite(errors_px).all(axis=1)]
        self.frames += len(errors_px)
        self.with_star += len(with_star)
        self.sum_px2 += np.sum(with_star**2, axis=0)

    @property
    def rms_px(self) -> Floats:
        """Root of their mean, shape (2,); of one frame at the least."""
        return np.asarray(np.sqrt(self.sum_px2 / self.with_star))


class StepFailed(Exception):
    """The attempt has failed; another may succeed."""


class Measurement(NamedTuple):
    """What a frame's tick showed of the star, and where the stages were then; NaN without a star."""

    mid_exposure_s: float
    star_az_px: float
    star_el_px: float
    error_az_px: float
    error_el_px: float
    siderostat_az_rad: float
    siderostat_el_rad: float
    fsm_az_rad: float
    fsm_el_rad: float
    star_flux_dn: float


_fields_of = attrgetter(*Measurement._fields)  # of a tick


@dataclass
class View:
    """One attempt, as its step sees it.

    Attributes
    ----------
    began_s : float
        When the loop was ready for it, by the supervisor's time.
    paused_s : float
        Spent in pauses since.
    measurements : list of Measurement
        Of every frame since, but not of those in a pause.
    marks : list of float
        For the step's own use: times of what it did.
    frames : list of FrameRecord
        For the step's own use too: those that it keeps.
    squares : Squares
        And this: what it adds up.
    rows : dict of str to list
        And these: rows of numbers that it measures, by names of its own.
    attempt : int
        Which one it is, from 1.
    fresh_s : float
        Telemetry from before shows nothing of the last command.
    """

    link: Link
    rig: Rig
    loop_name: str
    telemetry: Telemetry
    began_s: float
    attempt: int = 1
    paused_s: float = 0.0
    fresh_s: float = 0.0
    measurements: list[Measurement] = field(default_factory=list)
    marks: list[float] = field(default_factory=list)
    frames: list[FrameRecord] = field(default_factory=list)
    squares: Squares = field(default_factory=Squares)
    rows: dict[str, list[tuple[float, ...]]] = field(default_factory=lambda: defaultdict(list))

    @property
    def settings(self) -> Loop:
        """The loop's part of the rig file."""
        return self.rig.stellar_loops[self.loop_name]

    @property
    def loop(self) -> LoopState:
        """The loop's newest state."""
        for loop in self.telemetry.loops:
            if loop.name == self.loop_name:
                return loop
        msg = f"the supervisor has no loop {self.loop_name}; start it again with this rig file"
        raise SequenceError(msg)

    @property
    def mode(self) -> Mode:
        """The loop's mode."""
        return Mode[self.loop.mode]

    @property
    def now_s(self) -> float:
        """The time of the newest telemetry."""
        return self.telemetry.time_s

    @property
    def elapsed_s(self) -> float:
        """Since the attempt began, without pauses."""
        return self.now_s - self.began_s - self.paused_s

    def ask(self, command: AnyCommand) -> Reply:
        """Give a command that may be refused."""
        reply = self.link.send(command)
        self.fresh_s = self.link.now_s()
        return reply

    def command(self, command: AnyCommand) -> None:
        """Give a command.

        Raises
        ------
        StepFailed
            If it is refused.
        """
        reply = self.ask(command)
        if not reply.accepted:
            msg = f"{type(command).__name__.lower()} was refused: {reply.text}"
            raise StepFailed(msg)

    def require_mode(self, *modes: Mode) -> None:
        """Refuse to go on in another mode.

        Raises
        ------
        StepFailed
            If the loop is in none of these.
        """
        if self.mode not in modes:
            msg = f"loop {self.loop_name} went to {self.mode.name}: {self.loop.why}"
            raise StepFailed(msg)

    def require_no_failure(self) -> None:
        """Refuse to go on if a command of this attempt has failed.

        Raises
        ------
        StepFailed
            If so.
        """
        failure = self.loop.last_failure
        if failure is not None and failure.time_s >= self.began_s:
            msg = f"{failure.what} failed: {failure.text}"
            raise StepFailed(msg)

    def require_motion(self, begun_s: float) -> None:
        """Refuse to go on with a collector that stands still, though a step had it move from `begun_s` on.

        Raises
        ------
        StepFailed
            If it does; the text says why.
        """
        collector = self.telemetry.collector
        if collector is not None and collector.motion:
            return
        error = "" if collector is None else collector.error
        safe = [
            f"loop {loop.name} is SAFE: {loop.why}, and that stops the collector"
            for loop in self.telemetry.loops
            if loop.mode == Mode.SAFE.name and loop.since_s >= begun_s
        ]
        why = error or next(iter(safe), "another person stopped it")
        msg = f"the collector no longer moves: {why}"
        raise StepFailed(msg)

    def update(self, telemetry: Telemetry, *, paused: bool) -> None:
        """Go on to the next message."""
        if paused:
            self.paused_s += telemetry.time_s - self.telemetry.time_s
        else:
            ticks = filter(self._is_mine, telemetry.ticks)
            self.measurements += [Measurement(*_fields_of(tick)) for tick in ticks]
        self.telemetry = telemetry

    def _is_mine(self, tick: Tick) -> bool:
        return tick.loop == self.loop_name and tick.mid_exposure_s >= self.began_s

    @property
    def tracking(self) -> bool:
        """The stages follow a star or a beam, or search for one."""
        return self.mode in TRACKING | HOLDING


def columns(measurements: list[Measurement]) -> Floats:
    """Looks as an array, shape (n, 10)."""
    return np.array(measurements, dtype=np.float64).reshape(-1, len(Measurement._fields))
