"""The search for a star: a spiral about where it is expected, and a second look at what may be it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.centroid import Star
from fitctl.controllers.estimator import StarEstimator
from fitctl.controllers.spiral import Spiral, plan_spiral
from fitctl.model.optics import scales
from fitctl.supervisor.modes import Trigger

Floats = NDArray[np.float64]


class Finding(NamedTuple):
    """What a frame means for the search; without a trigger it goes on."""

    trigger: Trigger | None
    reason: str


@dataclass
class _Sighting:
    """A star seen during the search: the siderostat goes back to where it saw it, and looks again."""

    motor_rad: Floats
    since_s: float
    frames: int = 0


class Search:
    """One loop's; :meth:`begin` begins it anew.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    estimator : StarEstimator
        Knows where the star is expected, and where what is seen is.

    Attributes
    ----------
    centre_rad : array, shape (2,)
        Motor angles about which the spiral runs.
    """

    def __init__(self, rig: Rig, loop_name: str, estimator: StarEstimator) -> None:
        loop = rig.loops[loop_name]
        self.centre_rad = np.zeros(2)
        self._settings = loop.acquisition
        self._estimator = estimator
        self._middle_px = np.array([rig.camera.width_px - 1, rig.camera.height_px - 1]) / 2
        self._motor_px_per_rad = scales(rig, loop).motor_px_per_rad
        self._plan = plan_spiral(rig, loop_name)
        self._spiral = Spiral(self._plan)
        self._sighting: _Sighting | None = None

    @property
    def progress(self) -> float:
        """Part of the searched area, 0 to 1."""
        return self._spiral.progress

    def begin(self) -> None:
        """A new spiral, about where the star is expected now."""
        self.centre_rad = self._star_in_the_middle_rad()
        self._spiral = Spiral(self._plan)
        self._sighting = None

    def judge(self, star: Star | None, now_s: float) -> Finding | None:
        """What a frame exposed at `now_s` showed, if it is anything to tell."""
        settings, sighting = self._settings, self._sighting
        if sighting is None:
            if star is not None:
                self._sighting = _Sighting(self._star_in_the_middle_rad(), now_s)
            elif self._spiral.exhausted:
                return Finding(
                    Trigger.SEARCH_EXHAUSTED,
                    f"no star within {settings.search_radius_sky_arcsec:g} arcsec of the start; "
                    "check shutter and pointing, then acquire again",
                )
            return None
        settled = now_s >= sighting.since_s + settings.settle_s
        sighting.frames = sighting.frames + 1 if star is not None and settled else 0
        if sighting.frames >= settings.found_frames:
            return Finding(Trigger.STAR_FOUND, f"star on {sighting.frames} frames in a row")
        if now_s > sighting.since_s + settings.settle_s + settings.confirm_timeout_s:
            self._sighting = None
            return Finding(None, "a sighting was not confirmed; the search goes on")
        return None

    def advance(self, duration_s: float) -> Floats:
        """Go on for `duration_s`, or wait where something was seen; motor set-point, shape (2,)."""
        if self._sighting is not None:
            return self._sighting.motor_rad
        return self.centre_rad + self._spiral.advance(duration_s) / self._motor_px_per_rad

    def _star_in_the_middle_rad(self) -> Floats:
        """With the star in the middle of the field, the search sees farthest."""
        return self._estimator.motor_for_rad(self._middle_px, np.zeros(2))
