"""The search for a star: a spiral about where it is expected, and a second look at what may be it.

A star that was followed and lost is searched for in rounds: a pause at its last place, then a spiral about it,
wider from round to round up to the rig's radius.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from fitctl.config import LEAST_OVERLAP, MOST_OVERLAP, Rig
from fitctl.controllers.centroid import LARGEST_PEAK, Star
from fitctl.controllers.estimator import StarEstimator
from fitctl.controllers.frame_counts import CONFIRMED, REJECTED, look_again
from fitctl.controllers.search_rounds import WIDEST_ROUND, round_fraction
from fitctl.controllers.spiral import Spiral, plan_spiral
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Finding, Trigger
from fitctl.messages.telemetry import SearchAgain
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
_SLEWS = 10.0  # the siderostat may take as many times as long to begin as its limits would let it
NEAR = 0.5  # of the field's radius: so near to its middle the siderostat must be before the spiral begins


@dataclass
class Candidate:
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
    again : bool
        The star was followed and lost.
    """

    def __init__(self, rig: Rig, loop_name: str, estimator: StarEstimator) -> None:
        loop = rig.stellar_loops[loop_name]
        self.centre_rad = np.zeros(2)
        self._settings = loop.acquisition
        self._estimator = estimator
        self._target_px = np.array([loop.target_px.az, loop.target_px.el])
        self._middle_px = np.array([rig.camera.width_px - 1, rig.camera.height_px - 1]) / 2
        scale = scales(rig, loop)
        self._scale = scale
        self._travel_rad = scale.travel_rad(loop.siderostat)
        self._slew_limit_s = _SLEWS * 2 * self._travel_rad / loop.siderostat.velocity_limit_rad_s
        self._plan_spiral = partial(plan_spiral, rig, loop_name)
        self._radius_sky_arcsec = self._settings.search_radius_sky_arcsec
        self._overlap = self._settings.field_overlap
        self._plan = self._plan_spiral()
        self._spiral = Spiral(self._plan)
        self._round = 0
        self._pause_s = 0.0
        self.again = False
        self._arrived = False
        self._since_s = math.nan
        self._asked = Acquire()
        self._candidate: Candidate | None = None

    @property
    def progress(self) -> float:
        """Part of the searched area, 0 to 1."""
        return self._spiral.progress

    def configure(self, asked: Acquire) -> None:
        """Make the next search, and no other, as a command asks that was not refused."""
        self._asked = asked

    def begin(self, *, again: bool = False) -> None:
        """A new search, about where the star is expected now, or as asked.

        With `again`, the star was followed until now: it is searched for in rounds, if the rig file allows it.
        """
        asked, self._asked = self._asked, Acquire()
        if asked.expected_az_sky_arcsec is not None and asked.expected_el_sky_arcsec is not None:
            offset = np.array([asked.expected_az_sky_arcsec, asked.expected_el_sky_arcsec])
            place_px = self._target_px + self._scale.sky_px(offset)
            self._estimator.place(place_px, np.zeros(2), np.zeros(2))
        self._radius_sky_arcsec = (
            asked.search_radius_sky_arcsec or self._settings.search_radius_sky_arcsec
        )
        self._overlap = asked.field_overlap or self._settings.field_overlap
        self.again = again and self._settings.search_again_s != 0
        self.centre_rad = self._star_in_the_middle_rad()
        self._arrived = self.again  # whatever is near the last place may be the star
        self._since_s = math.nan
        self._candidate = None
        self._begin_round(0)

    def _begin_round(self, number: int) -> None:
        """A spiral as wide as the round's; before it, a pause, if the star was lost."""
        fraction = round_fraction(number) if self.again else 1.0
        self._round = number
        self._pause_s = fraction * self._settings.search_again_pause_s if self.again else 0.0
        self._plan = self._plan_spiral(
            radius_sky_arcsec=fraction * self._radius_sky_arcsec, field_overlap=self._overlap
        )
        self._spiral = Spiral(self._plan)

    def has_arrived(self, motor_rad: Floats) -> bool:
        """Whether the siderostat, which was at `motor_rad`, has come near the spiral's middle.

        On its way from another star it would see that one, and a spiral that had begun would have passed
        the middle by.
        """
        if not self._arrived:
            middle_rad = np.clip(self.centre_rad, -self._travel_rad, self._travel_rad)
            away_px = float(np.abs(motor_rad - middle_rad).max()) * self._scale.motor_px_per_rad
            self._arrived = away_px <= NEAR * self._plan.field_radius_px
        return self._arrived

    def evaluate(self, star: Star | None, now_s: float) -> Finding | None:
        """What a frame exposed at `now_s` showed, if it is anything to tell."""
        candidate = self._candidate
        if math.isnan(self._since_s):
            self._since_s = now_s
        if not self._arrived:
            return self._wait_for_siderostat(now_s)
        if candidate is None:
            if star is None:
                return self._evaluate_progress(now_s)
            self._candidate = Candidate(self._star_in_the_middle_rad(), now_s)
            return None
        outcome = look_again(self._settings, candidate, star is not None, now_s)
        if outcome == CONFIRMED:
            return Finding(Trigger.STAR_FOUND, f"star on {candidate.frames} frames in a row")
        if outcome == REJECTED:
            self._candidate = None
            return Finding(None, "a candidate was not confirmed; the search goes on")
        return None

    def _evaluate_progress(self, now_s: float) -> Finding | None:
        """Whether a search without a star is over at `now_s`, or its round is."""
        limit_s = self._settings.search_again_s
        if self.again and limit_s is not None and now_s - self._since_s > limit_s:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"the star that was lost did not come back within {limit_s:g} s (search_again_s); "
                "check shutter and pointing, then acquire again",
            )
        return self._end_round() if self._spiral.exhausted else None

    def _end_round(self) -> Finding | None:
        """The spiral is done: the search is over, or goes on with the next round, which is reported once."""
        if not self.again:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"no star within {self._radius_sky_arcsec:g} arcsec of the start; "
                "check shutter and pointing, then acquire again",
            )
        ended = self._round
        self._begin_round(ended + 1)
        if ended != WIDEST_ROUND:
            return None
        return Finding(
            None,
            f"no star within {self._radius_sky_arcsec:g} arcsec of its last place; the search repeats with "
            f"pauses of {self._settings.search_again_pause_s:g} s until the star is back; "
            "check shutter and clouds, or end the search with hold, stop or another acquire",
        )

    def state_again(self, since_s: float) -> SearchAgain | None:
        """The search for a star that was lost at `since_s`, for consoles; None for another search."""
        if not self.again:
            return None
        number = self._round
        return SearchAgain(
            since_s=since_s,
            round_number=number + 1,
            radius_sky_arcsec=round_fraction(number) * self._radius_sky_arcsec,
            pauses=self._pause_s > 0,
            limit_s=self._settings.search_again_s,
        )

    def _wait_for_siderostat(self, now_s: float) -> Finding | None:
        if now_s - self._since_s <= self._slew_limit_s:
            return None
        return Finding(
            Trigger.SEARCH_EXHAUSTED,
            f"the siderostat did not come to where the search begins within {self._slew_limit_s:.0f} s; "
            "look whether its motors turn, then stop, recover and acquire again",
        )

    def advance(self, duration_s: float, motor_rad: Floats) -> Floats:
        """Go on for `duration_s`, or wait where something was seen; motor set-point, shape (2,)."""
        if self._candidate is not None:
            return self._candidate.motor_rad
        if not self.has_arrived(motor_rad):
            return self.centre_rad
        if self._pause_s > 0:
            self._pause_s -= duration_s
            return self.centre_rad
        return self.centre_rad + self._scale.motor_rad(self._spiral.advance(duration_s))

    def _star_in_the_middle_rad(self) -> Floats:
        """With the star in the middle of the field, the search sees farthest."""
        return self._estimator.motor_for_rad(self._middle_px, np.zeros(2))


def _too_faint(rig: Rig, loop_name: str, star_flux_dn: float | None) -> str:
    """Why a star of this flux could not be found, or nothing."""
    if star_flux_dn is None:
        return ""
    if not 0 < star_flux_dn < math.inf:
        return f"star_flux_dn must be above 0 (is {star_flux_dn:g})"
    acquisition = rig.stellar_loops[loop_name].acquisition
    least_dn = acquisition.detection_sigma * rig.camera.pixel_noise_dn / LARGEST_PEAK
    if star_flux_dn < least_dn:
        return (
            f"a star of {star_flux_dn:g} DN could not be told from noise; loops.{loop_name}.acquisition."
            f"detection_sigma needs at least {least_dn:.0f} DN"
        )
    return ""


def refused_search(rig: Rig, loop_name: str, asked: Acquire) -> str:
    """Why a search cannot be made as asked, or nothing."""
    loop = rig.stellar_loops[loop_name]
    expected = [asked.expected_az_sky_arcsec, asked.expected_el_sky_arcsec]
    given = [place for place in expected if place is not None]
    if len(given) == 1:
        return "expected_az_sky_arcsec and expected_el_sky_arcsec belong together"
    radius, overlap = asked.search_radius_sky_arcsec, asked.field_overlap
    if radius is not None and not 0 < radius < math.inf:
        return f"search_radius_sky_arcsec must be above 0 (is {radius:g})"
    if overlap is not None and not LEAST_OVERLAP <= overlap <= MOST_OVERLAP:
        return f"field_overlap must lie in {LEAST_OVERLAP:g} to {MOST_OVERLAP:g} (is {overlap:g})"
    too_faint = _too_faint(rig, loop_name, asked.star_flux_dn)
    if too_faint or (radius is None and not given):
        return too_faint
    radius = radius or loop.acquisition.search_radius_sky_arcsec
    travel = loop.siderostat.travel_sky_arcsec
    for place in given or [0.0]:
        reach = abs(place) + radius
        # Written so that what is no number is refused too.
        if not reach <= travel:
            return (
                f"the search would reach {reach:g} arcsec from where the encoders read zero; "
                f"travel_sky_arcsec of loops.{loop_name}.siderostat is {travel:g}"
            )
    return ""
