"""The control laws that hold a star on its target: coarse, and the pair of a design, behind one prefilter."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.centroid import Star
from fitctl.controllers.pair import Design, Measurement, Pair, PairCommand
from fitctl.controllers.prefilter import Prefilter
from fitctl.loop.observation import Observation
from fitctl.model.optics import AzEl, scales

Floats = NDArray[np.float64]
_RECENT_S = 3.0  # of frames from which another design knows the night
_LEAST_RECENT_S = 0.5
_GAP = 1.5  # in frame periods: between exposures so far apart a frame is missing


class Pointing:
    """One loop's.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    target_px : array, shape (2,)
        Where the star is held at first.
    design : Design
        At work in VERNIER at first.

    Attributes
    ----------
    prefilter : Prefilter
    pair : Pair
        At work in VERNIER.
    coarse_step_rad_per_px : float
        Of the motors' set-point, in a frame.
    """

    def __init__(self, rig: Rig, loop_name: str, target_px: Floats, design: Design) -> None:
        loop, period_s = rig.stellar_loops[loop_name], rig.camera.period_s
        self._scale = scales(rig, loop)
        self._range_rad = loop.fsm.range_rad
        self.prefilter = Prefilter(loop.prefilter.time_constant_s, period_s, target_px)
        self.coarse_step_rad_per_px = (
            loop.coarse.gain_rad_per_m * self._scale.pixel_size_m * period_s
        )
        self._recent: deque[Measurement] = deque(maxlen=round(_RECENT_S / period_s))
        self._period_s, self._exposed_s = period_s, math.inf
        self._least_recent = round(_LEAST_RECENT_S / period_s)
        self.use(design)

    @property
    def design(self) -> Design:
        """At work in VERNIER."""
        return self.pair.design

    @property
    def command_px(self) -> AzEl:
        """The target as the prefilter has it now."""
        return self.prefilter.value_px

    @property
    def saturated(self) -> bool:
        """The pair last wanted more than the mirror's range."""
        return self.pair.saturated

    @property
    def recent(self) -> list[Measurement]:
        """The last seconds' frames, without gaps."""
        return list(self._recent)

    def use(self, design: Design) -> None:
        """Work with another design; where the star is held, :meth:`start_pair` is next."""
        self.pair = Pair(design, self._scale, self._range_rad)

    def start_coarse(self, target_px: Floats) -> None:
        """Rest on the target, shape (2,)."""
        self.prefilter.reset(target_px)

    def start_pair(self, held_rad: Floats, motor_rad: Floats) -> None:
        """Go on with the mirror held at `held_rad` and the motors at `motor_rad`, each shape (2,)."""
        self.forget()
        self.pair.start(held_rad, motor_rad, self.command_px)

    def start_knowing(self) -> bool:
        """Begin where recent frames bring the design; False where it has to begin from rest instead."""
        if len(self._recent) < self._least_recent or not self.pair.holds_by_itself:
            return False
        self.pair.start_knowing(self._recent)
        return True

    def step_coarse(self, observation: Observation, target_px: Floats) -> Floats | None:
        """One frame: the step of the motors' set-point, shape (2,); None where no star is visible."""
        command_px = self.prefilter.step(target_px)
        if observation.star is None:
            return None
        error_px = np.array(error_from(command_px, observation.star))
        return -self.coarse_step_rad_per_px * error_px.dot(self._scale.siderostat_back.T)

    def step_pair(self, observation: Observation, target_px: Floats) -> PairCommand | None:
        """One frame: what both stages shall do; None where no star is visible."""
        command_px = self.prefilter.step(target_px)
        if observation.star is None:
            self.forget()
            return None
        error_px = error_from(command_px, observation.star)
        if observation.frame is not None:
            exposed_s = observation.frame.mid_exposure_s
            if exposed_s - self._exposed_s > _GAP * self._period_s:
                self.forget()
            self._exposed_s = exposed_s
        measured = Measurement(
            error_px, command_px, observation.law_mirror_rad, observation.beam_rad
        )
        self.remember(measured)
        return self.pair.step(measured)

    def remember(self, measured: Measurement) -> None:
        """Keep a frame for a design that follows."""
        self._recent.append(measured)

    def forget(self) -> None:
        """Frames are missing: a design that follows cannot use those before."""
        self._recent.clear()


def error_from(target_px: AzEl, star: Star) -> AzEl:
    """How far a star is from a target."""
    return star.az_px - target_px[0], star.el_px - target_px[1]
