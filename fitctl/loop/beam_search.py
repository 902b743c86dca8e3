"""The search for a metrology beam: its siderostat goes along a spiral until a photodiode has light.

As with stars, a beam that was held and lost is searched for in rounds: a pause at its last place, then a spiral
about it, wider from round to round up to the rig's radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.frame_counts import CONFIRMED, REJECTED, look_again
from fitctl.controllers.search_rounds import WIDEST_ROUND, round_fraction
from fitctl.controllers.spiral import Spiral, plan_beam_spiral
from fitctl.messages.modes import Finding, Trigger
from fitctl.messages.telemetry import SearchAgain
from fitctl.model.optics import motor_sky_rad_per_rad, sky_px_per_rad

Floats = NDArray[np.float64]


@dataclass
class _Candidate:
    """Light that was seen on the way: the siderostat goes back to where it was, and looks again."""

    motor_rad: Floats
    since_s: float
    frames: int = 0


class BeamSearch:
    """One metrology loop's; :meth:`begin` begins it anew.

    Parameters
    ----------
    rig : Rig
    loop_name : str

    Attributes
    ----------
    centre_rad : array, shape (2,)
        Motor angles about which the spiral runs.
    again : bool
        The beam was held and lost.
    """

    def __init__(self, rig: Rig, loop_name: str) -> None:
        loop = rig.metrology_loops[loop_name]
        self.centre_rad = np.zeros(2)
        self.again = False
        self._settings = loop.acquisition
        self._rad_per_px = 1.0 / (motor_sky_rad_per_rad(loop.siderostat) * sky_px_per_rad(rig))
        self._plan_spiral = partial(plan_beam_spiral, rig, loop_name)
        self._radius_sky_arcsec = self._settings.search_radius_sky_arcsec
        self._spiral = Spiral(self._plan_spiral())
        self._round = 0
        self._pause_s = 0.0
        self._since_s = math.nan
        self._candidate: _Candidate | None = None

    @property
    def progress(self) -> float:
        """Part of the searched area, 0 to 1."""
        return self._spiral.progress

    def begin(
        self, centre_rad: Floats, *, again: bool = False, radius_sky_arcsec: float | None = None
    ) -> None:
        """A new search about motor angles, shape (2,).

        With `again`, the beam was held until now: it is searched for in rounds, if the rig file allows it.
        The radius is the rig's unless given.
        """
        self.centre_rad = centre_rad
        self.again = again and self._settings.search_again_s != 0
        self._radius_sky_arcsec = radius_sky_arcsec or self._settings.search_radius_sky_arcsec
        self._since_s = math.nan
        self._candidate = None
        self._begin_round(0)

    def _begin_round(self, number: int) -> None:
        fraction = round_fraction(number) if self.again else 1.0
        self._round = number
        self._pause_s = fraction * self._settings.search_again_pause_s if self.again else 0.0
        self._spiral = Spiral(
            self._plan_spiral(radius_sky_arcsec=fraction * self._radius_sky_arcsec)
        )

    def evaluate(self, has_light: bool, motor_rad: Floats, sampled_s: float) -> Finding | None:
        """What a sample taken at `sampled_s`, with the motors at `motor_rad`, means for the search."""
        candidate = self._candidate
        if math.isnan(self._since_s):
            self._since_s = sampled_s
        if candidate is None:
            if has_light:
                self._candidate = _Candidate(motor_rad, sampled_s)
                return None
            return self._evaluate_progress(sampled_s)
        outcome = look_again(self._settings, candidate, has_light, sampled_s)
        if outcome == CONFIRMED:
            return Finding(Trigger.BEAM_FOUND, f"light on {candidate.frames} samples in a row")
        if outcome == REJECTED:
            self._candidate = None
            return Finding(None, "light was not confirmed; the search for the beam goes on")
        return None

    def _evaluate_progress(self, now_s: float) -> Finding | None:
        limit_s = self._settings.search_again_s
        if self.again and limit_s is not None and now_s - self._since_s > limit_s:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"the beam that was lost did not come back within {limit_s:g} s (search_again_s); "
                "check the laser and its path, then acquire again",
            )
        return self._end_round() if self._spiral.exhausted else None

    def _end_round(self) -> Finding | None:
        """The spiral is done: the search is over, or goes on with the next round, which is reported once."""
        if not self.again:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"no beam within {self._radius_sky_arcsec:g} arcsec of the start; "
                "check the laser and its path, then acquire again",
            )
        ended = self._round
        self._begin_round(ended + 1)
        if ended != WIDEST_ROUND:
            return None
        return Finding(
            None,
            f"no beam within {self._radius_sky_arcsec:g} arcsec of its last place; the search repeats with "
            f"pauses of {self._settings.search_again_pause_s:g} s until the beam is back; "
            "check the laser and its path, or end the search with hold, stop or another acquire",
        )

    def state_again(self, since_s: float) -> SearchAgain | None:
        """The search for a beam that was lost at `since_s`, for consoles; None for another search."""
        if not self.again:
            return None
        return SearchAgain(
            since_s=since_s,
            round_number=self._round + 1,
            radius_sky_arcsec=round_fraction(self._round) * self._radius_sky_arcsec,
            pauses=self._pause_s > 0,
            limit_s=self._settings.search_again_s,
        )

    def advance(self, duration_s: float) -> Floats:
        """Go on for `duration_s`, or wait where light was seen; motor set-point, shape (2,)."""
        if self._candidate is not None:
            return self._candidate.motor_rad
        if self._pause_s > 0:
            self._pause_s -= duration_s
            return self.centre_rad
        return self.centre_rad + self._rad_per_px * self._spiral.advance(duration_s)
