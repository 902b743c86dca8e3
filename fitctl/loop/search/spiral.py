"""What every search does: a spiral about a place, and a second look at what may be it.

What was followed and lost is searched for in rounds: a pause at its last place, then a spiral about it,
wider from round to round up to the rig's radius.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Loop, MetrologyLoop
from fitctl.config.devices import AnySiderostat
from fitctl.config.loops import Acquisition
from fitctl.controllers.frame_counts import CONFIRMED, REJECTED, look_again
from fitctl.controllers.search_rounds import WIDEST_ROUND, round_fraction
from fitctl.controllers.spiral import Spiral, SpiralPlan
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Finding, Trigger
from fitctl.messages.telemetry import SearchAgain

Floats = NDArray[np.float64]
_SLEWS = 10.0  # the siderostat may take as many times as long to begin as its limits would let it
NEAR = 0.5  # of the field's radius: so near to its middle the siderostat must be before the spiral begins


class Wanted(NamedTuple):
    """What a search is for, in the words of its findings.

    Attributes
    ----------
    name : str
    found : Trigger
    confirmed : str
        With the count of observations for ``{}``.
    rejected : str
    check, check_long : str
        What a person looks at when nothing is found; when nothing is found for long.
    """

    name: str
    found: Trigger
    confirmed: str
    rejected: str
    check: str
    check_long: str


@dataclass
class Candidate:
    """What was seen on the way: the siderostat goes back to where it was, and looks again."""

    motor_rad: Floats
    since_s: float
    frames: int = 0


class SpiralSearch:
    """One loop's; :meth:`start` begins it anew.

    Parameters
    ----------
    wanted : Wanted
    settings : Acquisition
    plan : callable
        The spiral of a search radius, arcsec on the sky.
    motor_rad : callable
        Motor angles of pixels in the focal plane, both of shape (2,).
    siderostat : AnySiderostat
    px_per_motor_rad : float

    Attributes
    ----------
    centre_rad : array, shape (2,)
        Motor angles about which the spiral runs.
    again : bool
        What is searched for was followed and lost.
    """

    def __init__(
        self,
        wanted: Wanted,
        settings: Acquisition,
        plan: Callable[[float], SpiralPlan],
        motor_rad: Callable[[Floats], Floats],
        siderostat: AnySiderostat,
        px_per_motor_rad: float,
    ) -> None:
        self.centre_rad = np.zeros(2)
        self.again = False
        self._wanted = wanted
        self._settings = settings
        self._make_plan = plan
        self._motor_rad = motor_rad
        self._px_per_motor_rad = px_per_motor_rad
        self._travel_rad = siderostat.travel_rad
        self._slew_limit_s = _SLEWS * 2 * self._travel_rad / siderostat.velocity_limit_rad_s
        self._arrived = False
        self._slews_since_s = math.nan
        self._radius_sky_arcsec = settings.search_radius_sky_arcsec
        self._plan = plan(self._radius_sky_arcsec)
        self._spiral = Spiral(self._plan)
        self._round = 0
        self._pause_s = 0.0
        self._since_s = math.nan
        self._candidate: Candidate | None = None

    @property
    def progress(self) -> float:
        """Part of the searched area, 0 to 1."""
        return self._spiral.progress

    def start(
        self, centre_rad: Floats, *, again: bool = False, radius_sky_arcsec: float | None = None
    ) -> None:
        """Begin a search about motor angles, shape (2,).

        With `again`, what is searched for was followed until now: the search goes in rounds, if the rig file
        allows it. The radius is the rig's unless given.
        """
        self.centre_rad = centre_rad
        self.again = again and self._settings.search_again_s != 0
        self._radius_sky_arcsec = radius_sky_arcsec or self._settings.search_radius_sky_arcsec
        self._since_s = math.nan
        self._candidate = None
        self._arrived = self.again  # whatever is near the last place may be what was lost
        self._slews_since_s = math.nan
        self._begin_round(0)

    def _begin_round(self, number: int) -> None:
        """A spiral as wide as the round's; before it, a pause, if the search is for what was lost."""
        fraction = round_fraction(number) if self.again else 1.0
        self._round = number
        self._pause_s = fraction * self._settings.search_again_pause_s if self.again else 0.0
        self._plan = self._make_plan(fraction * self._radius_sky_arcsec)
        self._spiral = Spiral(self._plan)

    def look(self, is_there: bool, motor_rad: Floats, now_s: float) -> Finding | None:
        """What an observation made at `now_s` means for the search.

        Parameters
        ----------
        is_there : bool
            Whether it shows what may be the thing searched for.
        motor_rad : array, shape (2,)
            Where the siderostat looks at it again.
        now_s : float
        """
        candidate = self._candidate
        if math.isnan(self._since_s):
            self._since_s = now_s
        if candidate is None:
            if is_there:
                self._candidate = Candidate(motor_rad, now_s)
                return None
            return self._evaluate_progress(now_s)
        outcome = look_again(self._settings, candidate, is_there, now_s)
        if outcome == CONFIRMED:
            return Finding(self._wanted.found, self._wanted.confirmed.format(candidate.frames))
        if outcome == REJECTED:
            self._candidate = None
            return Finding(None, self._wanted.rejected)
        return None

    def _evaluate_progress(self, now_s: float) -> Finding | None:
        """Whether a search that found nothing is over at `now_s`, or its round is."""
        limit_s = self._settings.search_again_s
        if self.again and limit_s is not None and now_s - self._since_s > limit_s:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"the {self._wanted.name} that was lost did not come back within {limit_s:g} s "
                f"(search_again_s); check {self._wanted.check}, then acquire again",
            )
        return self._end_round() if self._spiral.exhausted else None

    def _end_round(self) -> Finding | None:
        """The spiral is done: the search is over, or goes on with the next round, which is reported once."""
        wanted = self._wanted
        if not self.again:
            return Finding(
                Trigger.SEARCH_EXHAUSTED,
                f"no {wanted.name} within {self._radius_sky_arcsec:g} arcsec of the start; "
                f"check {wanted.check}, then acquire again",
            )
        ended = self._round
        self._begin_round(ended + 1)
        if ended != WIDEST_ROUND:
            return None
        return Finding(
            None,
            f"no {wanted.name} within {self._radius_sky_arcsec:g} arcsec of its last place; the search "
            f"repeats with pauses of {self._settings.search_again_pause_s:g} s until the {wanted.name} is "
            f"back; check {wanted.check_long}, or end the search with release, stop or another acquire",
        )

    def state_again(self, since_s: float) -> SearchAgain | None:
        """The search for what was lost at `since_s`, for consoles; None for another search."""
        if not self.again:
            return None
        return SearchAgain(
            since_s=since_s,
            round_number=self._round + 1,
            radius_sky_arcsec=round_fraction(self._round) * self._radius_sky_arcsec,
            pauses=self._pause_s > 0,
            limit_s=self._settings.search_again_s,
        )

    def is_near(self, motor_rad: Floats, place_rad: Floats) -> bool:
        """Whether the siderostat, at `motor_rad`, is so near to a place that it has arrived there."""
        away_px = float(np.abs(motor_rad - place_rad).max()) * self._px_per_motor_rad
        return away_px <= NEAR * self._plan.field_radius_px

    def has_arrived(self, motor_rad: Floats, beam_rad: Floats) -> bool:
        """Whether the siderostat, which was at `motor_rad`, has come near where the spiral begins or goes on.

        With what else turns the star, it was at `beam_rad`, as the spiral's places are. Beyond its travel it
        does not come nearer than its travel's end.

        On its way from another star it would see that one, and a spiral that had begun would have passed
        the middle by. On its way from a candidate that was rejected, another one would turn it round at its
        full speed, which its motors cannot follow.
        """
        if not self._arrived:
            own_rad = self._spiral_place_rad() - (beam_rad - motor_rad)
            own_rad = np.clip(own_rad, -self._travel_rad, self._travel_rad)
            self._arrived = self.is_near(motor_rad, own_rad)
        return self._arrived

    def _wait_for_siderostat(self, now_s: float) -> Finding | None:
        """Until it has arrived, that the search is over at `now_s` if that took too long."""
        if math.isnan(self._slews_since_s):
            self._slews_since_s = now_s
        if now_s - self._slews_since_s <= self._slew_limit_s:
            return None
        return Finding(
            Trigger.SEARCH_EXHAUSTED,
            "the siderostat did not reach the start of the search, or the place to continue it, within "
            f"{self._slew_limit_s:.0f} s; check that its motors turn, then stop, recover and acquire again",
        )

    def delay(self, duration_s: float) -> None:
        """The search was kept waiting for `duration_s`, which does not count."""
        self._since_s += duration_s
        self._slews_since_s += duration_s
        if self._candidate is not None:
            self._candidate.since_s += duration_s

    def advance_from(self, motor_rad: Floats, beam_rad: Floats, duration_s: float) -> Floats:
        """As :meth:`advance`, but on the way to the spiral until the siderostat has arrived there."""
        if self._candidate is None and not self.has_arrived(motor_rad, beam_rad):
            return self._spiral_place_rad()
        return self.advance(duration_s)

    def advance(self, duration_s: float) -> Floats:
        """Go on for `duration_s`, or wait where something was seen; motor set-point, shape (2,)."""
        if self._candidate is not None:
            return self._candidate.motor_rad
        if self._pause_s > 0:
            self._pause_s -= duration_s
            return self.centre_rad
        self._spiral.advance(duration_s)
        return self._spiral_place_rad()

    def _spiral_place_rad(self) -> Floats:
        """Motor angles, shape (2,), where the spiral is."""
        return self.centre_rad + self._motor_rad(self._spiral.position_px())


def asked_place_sky_arcsec(asked: Acquire) -> Floats | None:
    """Where a command asks for a search, shape (2,), from the encoders' zero; None without a place."""
    az, el = asked.expected_az_sky_arcsec, asked.expected_el_sky_arcsec
    return None if az is None or el is None else np.array([az, el])


def refused_area(settings: Loop | MetrologyLoop, name: str, asked: Acquire) -> str:
    """Why a search cannot be made where a command asks for it, or nothing."""
    expected = [asked.expected_az_sky_arcsec, asked.expected_el_sky_arcsec]
    given = [place for place in expected if place is not None]
    if len(given) == 1:
        return "expected_az_sky_arcsec and expected_el_sky_arcsec belong together"
    radius = asked.search_radius_sky_arcsec
    if radius is not None and not 0 < radius < math.inf:
        return f"search_radius_sky_arcsec must be above 0 (is {radius:g})"
    if radius is None and not given:
        return ""
    radius = radius or settings.acquisition.search_radius_sky_arcsec
    travel = settings.siderostat.travel_sky_arcsec
    for place in given or [0.0]:
        reach = abs(place) + radius
        # Written so that what is no number is refused too.
        if not reach <= travel:
            return (
                f"the search would reach {reach:g} arcsec from where the encoders read zero; "
                f"travel_sky_arcsec of loops.{name}.siderostat is {travel:g}"
            )
    return ""
