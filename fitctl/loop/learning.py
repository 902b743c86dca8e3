"""What a loop does with a design that was learnt from its own frames: advise it, use it, and go back.

The learner (:mod:`fitctl.learn.learner`) estimates and designs elsewhere; here is only what must be decided at
a tick. All of it follows from the ticks and the learner's reports, so that a replay decides alike.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.pair import Design, Measurement
from fitctl.loop.comparison import Comparison, comparison
from fitctl.loop.frame_rate import RateWatch
from fitctl.messages.commands import LearnerReport
from fitctl.messages.telemetry import LearningState
from fitctl.model.optics import AzEl

Floats = NDArray[np.float64]
CALM_S = 2.0
"""A design is changed only after so long in VERNIER without saturation, and with star and target at rest."""
PAUSE_S, MOST_PAUSE_S = 60.0, 960.0
"""After a way back, no change of design by itself for so long; twice as long after each further one."""
# The mean square of the error, over a time constant, may pass that of the design before by a factor in RMS. The
# comparison finds later what is worse by less.
_RMS_LIMITS = ((0.3, 2.0), (10.0, 1.25))
# A louder night is louder for the design before, too. An error of more than so many times these limits is a
# fault: if the loop is not as designs have it, the disturbance is rebuilt wrongly.
_LOUDER = 2.0
# For that, a frame counts as at most so many times what the design before left: a gust of a few frames is no
# fault.
_MOST_OF_A_FRAME = 5.0
MOST_NOISE_RATIO = 1.1
"""Another light of the star is another noise of the sensor. One that differs by less is not worth another
design: minimum-variance leaves 0.3 % more at most."""
STILL_PX_PER_S = 0.05
"""A target that moves slower is at rest."""
_LONGEST_GAP = 5.5  # in frame periods: the comparison of designs bears so few missing frames
_MOST_PX = 1e6  # of a residual in a report: no frame is so wide
_NEWS = 0.1  # by which part a gain must differ from the one last reported to be reported again


class Learning:
    """One loop's.

    Attributes
    ----------
    report : LearnerReport or None
        The learner's last.
    in_force : LearnerReport or None
        That of the learnt design at work.
    before : Design or None
        At work before it, and again after a way back.
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        self.setting = rig.stellar_loops[loop_name].learn
        self.report: LearnerReport | None = None
        self.in_force: LearnerReport | None = None
        self.before: Design | None = None
        self._rig = rig
        self._loop_name = loop_name
        self._comparison: Comparison | None = None
        self._period_s = rig.camera.period_s
        self._frame_rate = RateWatch(rig.camera.period_s)
        self._longest_gap_s = _LONGEST_GAP * rig.camera.period_s
        self._last_s = math.inf
        self._keep = [math.exp(-rig.camera.period_s / over_s) for over_s, _ in _RMS_LIMITS]
        self._means_px2 = [[0.0, 0.0] for _ in _RMS_LIMITS]
        self._before_px2 = [[0.0, 0.0] for _ in _RMS_LIMITS]
        self._cut_px2 = [[0.0, 0.0] for _ in _RMS_LIMITS]
        self._limit_px = math.inf
        self._limited_from_s = self._compared_from_s = -math.inf
        self._by_hand = False
        self._calm_since_s: float | None = None
        self._paused_until_s = -math.inf
        self._pause_s = PAUSE_S
        self._last_target_px: AzEl = (math.nan, math.nan)
        self._announced = 0.0  # the part gained that was announced last
        self._fell_back = ""
        self._failed = False

    # ------------------------------------------------------------ reports

    def accept(self, report: LearnerReport) -> str:
        """Keep a report; an event's text where there is news for an operator, else empty."""
        self.report = report
        if not report.design_json:
            news, self._failed = not self._failed, True
            return report.text if news else ""
        self._failed = False
        if report.worth_it and (self.setting != "on" or self._by_hand):
            self._fell_back = ""  # newer advice
        gained = _gained(report) if report.worth_it else 0.0
        if abs(gained - self._announced) < _NEWS or (self.setting == "on" and not self._by_hand):
            return ""
        self._announced = gained
        if not gained:
            return (
                "the design in force leaves as little as a learnt one would"
                if report.fits
                else "the learner's model no longer explains the frames; the design in force is kept"
            )
        return f"{self.what_is_gained(report)}; to apply it: {self.command}"

    def wants_change(self, now_s: float) -> bool:
        """Whether the design that was learnt last is to be made and used, without being asked."""
        report = self.report
        return (
            self.may_act(now_s)
            and report is not None
            and report.worth_it
            and now_s >= self._paused_until_s
        )

    def may_act(self, now_s: float) -> bool:
        """Whether anything is to be done for the learner now, without being asked."""
        return self.setting == "on" and not self._by_hand and self.is_calm(now_s)

    def is_calm(self, now_s: float) -> bool:
        """Nothing hinders a change of design: see `CALM_S`. Without frames, nothing is known."""
        return (
            self._calm_since_s is not None
            and now_s - self._calm_since_s >= CALM_S
            and now_s - self._last_s <= self._longest_gap_s
        )

    @property
    def design_json(self) -> str:
        """Of the learnt design in force; empty without."""
        return "" if self.in_force is None else self.in_force.design_json

    @property
    def command(self) -> str:
        """What an operator types to use the learnt design."""
        return f"fitctl send controller learnt --loop {self._loop_name}"

    def what_is_gained(self, report: LearnerReport) -> str:
        """By a report's design; the reason for a change, for event and log."""
        return (
            f"a design learnt from {report.evaluated_s:.0f} s of frames would leave {report.learnt_px:.4f} px "
            f"instead of {report.present_px:.4f} ({_gained(report):.0%} less; bound {report.bound_px:.4f})"
            f"{'' if report.fits else ', though its model does not explain the frames in full'}"
        )

    # ------------------------------------------------------------ changes

    def forget_advice(self) -> None:
        """The next star is of another light: nothing was learnt for it."""
        self.report, self._announced = None, 0.0

    def changed(
        self,
        before: Design,
        now: Design,
        report: LearnerReport | None,
        recent: Iterable[Measurement],
        *,
        by_itself: bool,
    ) -> None:
        """Another design is in force: a learnt one with its report, or another without.

        Recent frames, in their order and without gaps, tell the comparison where star and vibrations are.
        """
        self._announced = 0.0
        self._comparison = None
        if report is None:
            if not by_itself:
                self._by_hand, self._fell_back = True, ""
            self.in_force = self.before = None
            return
        self._by_hand, self._fell_back = False, ""
        self.in_force = report
        if not before.learnt:
            self.before = before
        if self.before is not None:
            self._comparison = comparison(
                self._rig, self._loop_name, now, self.before, report.noise_px
            )
        if self._comparison is not None:
            for seen in recent:
                self._comparison.observe(seen.error_px, seen.mirror_rad, seen.motor_rad)
        self._limit_px = max(report.measured_px, report.learnt_camera_px)
        self._limit_from(-math.inf)

    def fell_back(self, reason: str, now_s: float) -> None:
        """The previous design is in force again."""
        self._fell_back = reason
        self._paused_until_s = now_s + self._pause_s
        self._pause_s = min(2 * self._pause_s, MOST_PAUSE_S)

    def observe(
        self,
        now_s: float,
        exposed_s: float,
        error_px: AzEl | None,
        target_px: AzEl,
        stages_rad: tuple[Floats, Floats],
        *,
        saturated: bool,
        hindered: bool,
    ) -> str:
        """One frame: why to go back to the design before, or empty.

        Parameters
        ----------
        exposed_s : float
            Of mid-exposure. Nothing is compared or changed while the camera runs at another rate.
        error_px : tuple of float or None
            None without a star; a few such frames count as missing.
        target_px : tuple of float
            As the prefilter has it.
        stages_rad : tuple of array, shape (2,)
            At mid-exposure: where the mirror was by the control law alone, and motor angles that turn the star
            as far as all siderostats and the sky did.
        saturated : bool
            The mirror is at the end of its range.
        hindered : bool
            The loop is not in VERNIER, waits, or an interlock keeps the stages from following the star.
        """
        is_other_rate = self._frame_rate.is_other(exposed_s)
        moved = has_moved(target_px, self._last_target_px, self._period_s)
        self._last_target_px = target_px
        if error_px is None and not hindered:  # as if the frame were missing
            self._calm_since_s = None
            return ""
        is_gap = now_s - self._last_s > self._longest_gap_s
        self._last_s = now_s
        if is_gap or hindered:
            # The star is caught again first: that says nothing of the design.
            self._limit_from(now_s + CALM_S)
        if is_gap:
            self._calm_since_s = None
            self._restart_comparison()
        if hindered or is_other_rate or error_px is None or moved:
            self._calm_since_s = None
            self._restart_comparison()
            return ""
        if saturated:
            self._calm_since_s = None
            self._restart_comparison()
            self._compared_from_s = now_s + CALM_S
            # A mirror that is not as designs have it can be driven from end to end.
            return "" if self.in_force is None else self._why_back(error_px, now_s, saturated=True)
        if self._calm_since_s is None:
            self._calm_since_s = now_s
        if self.in_force is None:
            return ""
        if self._comparison is not None:
            self._comparison.observe(error_px, *stages_rad)
            error_px = self._comparison.error_px
        return self._why_back(error_px, now_s)

    def _limit_from(self, time_s: float) -> None:
        """Limit the design's residual from a time on, as if it had left what it promised."""
        self._limited_from_s = time_s
        if self.in_force is not None:
            for means in itertools.chain(self._means_px2, self._before_px2, self._cut_px2):
                means[:] = [self.in_force.learnt_camera_px**2] * 2

    def _restart_comparison(self) -> None:
        if self._comparison is not None:
            self._comparison.restart()

    def _why_back(self, error_px: AzEl, now_s: float, *, saturated: bool = False) -> str:
        comparison = self._comparison
        worse = "" if comparison is None else comparison.why_back
        if now_s < self._limited_from_s:
            return worse
        compares = now_s >= self._compared_from_s
        before_px = (0.0, 0.0) if comparison is None else comparison.before_error_px
        most_px2 = (_MOST_OF_A_FRAME * self._limit_px) ** 2
        for (over_s, factor), keep, means, before, cut in zip(
            _RMS_LIMITS, self._keep, self._means_px2, self._before_px2, self._cut_px2, strict=True
        ):
            if saturated and over_s < CALM_S:
                continue
            for axis in (0, 1):
                px2 = error_px[axis] ** 2
                cut[axis] = keep * cut[axis] + (1.0 - keep) * min(px2, most_px2)
                if compares:
                    means[axis] = keep * means[axis] + (1.0 - keep) * px2
                    before[axis] = keep * before[axis] + (1.0 - keep) * before_px[axis] ** 2
            limit_px = max(self._limit_px, math.sqrt(max(before)))
            if max(means) > (factor * limit_px) ** 2:
                worse = (
                    f"the learnt design leaves {math.sqrt(max(means)):.4f} px on frames over {over_s:g} s; the "
                    f"design before left {limit_px:.4f}"
                )
            elif max(cut) > (factor * _LOUDER * self._limit_px) ** 2:
                worse = (
                    f"the learnt design leaves {math.sqrt(max(cut)):.4f} px on frames over {over_s:g} s; the "
                    f"design before left {self._limit_px:.4f}, and the limit is {_LOUDER:g} times that"
                )
        return worse

    @property
    def _before_px(self) -> float:
        comparison = self._comparison  # read once: consoles' thread asks, and the loop may drop it
        return math.nan if comparison is None else comparison.before_px

    # ------------------------------------------------------------ for consoles

    @property
    def state(self) -> LearningState:
        """As consoles show it."""
        report, in_force = self.report, self.in_force
        text = "" if report is None else report.text
        if in_force is not None:
            measured_px = math.sqrt(max(self._means_px2[-1]))
            return LearningState(
                setting=self.setting,
                state="in force",
                text=text,
                report=report,
                design_json=in_force.design_json,
                expected_px=in_force.learnt_camera_px,
                measured_px=measured_px,
                before_px=self._before_px,
            )
        if self._fell_back:
            return LearningState(
                setting=self.setting, state="fell back", text=self._fell_back, report=report
            )
        if report is None:
            return LearningState(setting=self.setting, state="collecting")
        return LearningState(
            setting=self.setting,
            state="failed" if self._failed else "advice" if report.worth_it else "kept",
            text=text,
            report=report,
        )


def has_moved(target_px: AzEl, before_px: AzEl, period_s: float) -> bool:
    """Whether the target is not where it was a frame before; so it is where that is not known (NaN)."""
    return not math.dist(target_px, before_px) <= STILL_PX_PER_S * period_s


def is_other_light(noise_px: float, other_px: float) -> bool:
    """Whether the noise of two stars' places differs so much that each needs a design of its own."""
    return max(noise_px, other_px) > MOST_NOISE_RATIO * min(noise_px, other_px)


def _gained(report: LearnerReport) -> float:
    """The part of the residual that a report's design would take away."""
    return 1.0 - report.learnt_px / report.present_px


def refused_report(report: LearnerReport) -> str:
    """Why a report's figures cannot be; empty if they can."""
    figures_px = (
        report.present_px,
        report.learnt_px,
        report.bound_px,
        report.learnt_camera_px,
        report.measured_px,
        report.noise_px,
    )
    if not all(0 <= px <= _MOST_PX for px in figures_px):  # NaN is not
        return f"a learner's report needs residuals of 0 to {_MOST_PX:g} px, got {figures_px}"
    if report.design_json and not report.design_json.startswith("{"):
        # Nothing else: a name with .py would be a file to run, and reports are also read from logs.
        return "a learner's report has the parameters of a design, a JSON object; this report has other text"
    if report.worth_it and not (report.design_json and 0 < report.learnt_px < report.present_px):
        return "a design that is worth a change leaves less than the present one; this report's does not"
    return ""
