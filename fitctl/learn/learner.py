"""What a loop's ticks show of its night, again and again while it holds its star: the learner.

It runs beside a supervisor, in a process of its own (:mod:`fitctl.learn.process`), and in a simulation, on the
virtual clock. It decides nothing: what becomes of its reports, the loop does (:mod:`fitctl.loop.learning`).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import solving
from fitctl.controllers.design.document import parameters_json
from fitctl.controllers.design.theory import loop_theory
from fitctl.controllers.pair import Design
from fitctl.error_budget import pieces_of
from fitctl.learn.advice import Advice, advise
from fitctl.learn.frame_rates import SAME_LINE_HZ, AtOtherRate, Classified, by_rate, joined
from fitctl.learn.opened import LEAST_S, rebuild
from fitctl.logging.records import Tick
from fitctl.loop.learning import has_moved
from fitctl.messages.commands import LearnerReport
from fitctl.messages.modes import Mode

Floats = NDArray[np.float64]
FIRST_S = 60.0
"""A first report after so many seconds of frames,"""
EVERY_S = 30.0
"""and another after each of so many more."""
WINDOW_S = 240.0
"""A night is estimated from the last frames, and after a gap as long, only from those that follow it."""
SETTLE_S = 5.0
"""After the star was caught, or the target was moved, frames say more of that than of the night."""


class Shown(NamedTuple):
    """What the learner takes of a :class:`fitctl.logging.records.Tick`; fields from `time_s` on are kept."""

    number: int
    mode: str
    fsm_saturated: bool
    held: bool
    star_visible: bool
    target_az_px: float
    target_el_px: float
    time_s: float
    mid_exposure_s: float
    error_az_px: float
    error_el_px: float
    mirror_az_rad: float
    mirror_el_rad: float
    fsm_az_rad: float
    fsm_el_rad: float
    siderostat_az_rad: float
    siderostat_el_rad: float
    link_az_rad: float
    link_el_rad: float
    sky_az_rad: float
    sky_el_rad: float


_KEPT = Shown._fields[Shown._fields.index("time_s") :]


class Learner:
    """One loop's.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        self._rig = rig
        self._loop_name = loop_name
        period_s = rig.camera.period_s
        self._period_s = period_s
        self._ring = np.empty((round(WINDOW_S / period_s), len(_KEPT)))
        self._added = 0
        self._new = 0
        self._last_s = math.inf
        self._first = self._due_after = round(FIRST_S / period_s)
        self._unsettled_s = -math.inf
        self._target_px = (math.nan, math.nan)
        self._design = ""
        self._since_s = 0.0
        self._learnt: Design | None = None  # last
        self._classified: list[Classified] = []

    def watch(self, design: str, now_s: float) -> None:
        """The design in force now, by its key."""
        if design != self._design:
            self._design, self._since_s = design, now_s

    def add(self, tick: Tick | Shown) -> None:
        """One tick, in their order; kept if it shows the loop undisturbed."""
        target_px = tick.target_az_px, tick.target_el_px
        moved = has_moved(target_px, self._target_px, self._period_s)
        self._target_px = target_px
        has_frame = tick.number >= 0  # else the stages are held for want of one, until the next
        held = tick.held and has_frame
        if tick.mode != Mode.VERNIER.name or tick.fsm_saturated or held or moved:
            self._unsettled_s = tick.time_s
        elif has_frame and tick.star_visible and tick.time_s - self._unsettled_s >= SETTLE_S:
            if tick.time_s - self._last_s > WINDOW_S:
                self.forget()
                self._classified = []
            self._last_s = tick.time_s
            row = self._added % len(self._ring)
            self._ring[row] = [getattr(tick, name) for name in _KEPT]
            self._added += 1
            self._new += 1

    def forget(self) -> None:
        """Begin again: the frames that were added are of another night, or of a star of another light."""
        self._added = self._new = 0
        self._due_after = self._first

    @property
    def frames(self) -> int:
        """How many are kept: at most those of `WINDOW_S`."""
        return min(self._added, len(self._ring))

    @property
    def due(self) -> bool:
        """There are enough new frames for a report."""
        return self._new >= self._due_after

    def begin_report(self) -> Floats:
        """Count the time to the next report from now.

        Returns
        -------
        array, shape (frames, fields)
            A copy of the frames that are kept, the oldest first, for :meth:`report` on another thread.
        """
        self._new, self._due_after = 0, round(EVERY_S / self._period_s)
        oldest = self._added % len(self._ring) if self._added > len(self._ring) else 0
        return np.roll(self._ring[: self.frames], -oldest, axis=0)

    def report(self, present: Design, frames: Floats) -> LearnerReport:
        """Estimate and design, with `present` in force; a report without a result has the reason.

        `frames` are those with which :meth:`begin_report` began it.
        """
        try:
            with solving("learn", self._loop_name, "the next report may have one"):
                return self._report(self._advice(present, frames))
        except ConfigError as error:
            return self.failed(str(error), frames)
        except MemoryError:
            reason = "learn: the learner's process has too little memory for a report"
            return self.failed(reason, frames)

    def failed(self, reason: str, frames: Floats) -> LearnerReport:
        """Instead of :meth:`report`, where the design in force is not known."""
        return LearnerReport(
            loop=self._loop_name,
            design_json="",
            text=reason,
            evaluated_s=len(frames) * self._period_s,
        )

    def _advice(self, present: Design, table: Floats) -> Advice:
        ticks = dict(zip(_KEPT, table.T, strict=True))
        pieces = pieces_of(ticks["mid_exposure_s"], np.ones(len(table), bool))
        pieces, others = by_rate(ticks["mid_exposure_s"], pieces, self._period_s)
        theory = loop_theory(self._rig, self._loop_name, present)
        error_px = np.stack([ticks["error_az_px"], ticks["error_el_px"]], axis=-1)
        usual = joined(pieces)
        own = error_px[usual][ticks["time_s"][usual] >= self._since_s + SETTLE_S]
        enough = len(own) * self._period_s >= LEAST_S
        advice = advise(
            rebuild(theory, ticks, pieces),
            tuple(np.sqrt(np.mean(own**2, axis=0)).tolist()) if enough else None,
            basis(self._rig, self._loop_name),
            present,
            like=self._learnt,
            known=self._classified,
            others=[AtOtherRate(s, rebuild(theory, ticks, [rows])) for s, rows in others],
        )
        self._learnt = advice.design
        found = [one.frequency_hz for one in advice.classified]
        # A line that is weak for a while is not found, and is the same when it comes back.
        self._classified = advice.classified + [
            one
            for one in self._classified
            if all(abs(one.frequency_hz - hz) > SAME_LINE_HZ for hz in found)
        ]
        return advice

    def _report(self, advice: Advice) -> LearnerReport:
        return LearnerReport(
            loop=self._loop_name,
            design_json=parameters_json(advice.design),
            text=_text(advice),
            evaluated_s=advice.night.duration_s,
            present_px=advice.present.residual_px,
            learnt_px=advice.learnt.residual_px,
            bound_px=advice.bound_px,
            learnt_camera_px=advice.learnt.camera_px,
            measured_px=max(advice.measured_px or (0.0,)),
            noise_px=advice.night.noise_px.value,
            worth_it=advice.worth_it,
            fits=advice.night.test.fits,
            classifying_rate_hz=advice.classifying_rate_hz,
        )


def _text(advice: Advice) -> str:
    """The night in one line."""
    night = advice.night
    lines = ", ".join(
        f"{line.found.frequency_hz.value:.2f} Hz {max(rms.value for rms in line.found.rms_px):.3f} px"
        f"{f' ({line.how_far})' if line.how_far else ''}"
        for line in advice.lines
    )
    return (
        f"air k/b1 {night.strength.value:.2f} px/s², b2/b1 {night.fast_pole.value:.1f} 1/s; "
        f"noise {night.noise_px.value:.4f} px; lines {lines or 'none'}; "
        f"{night.test.text}"
    )
