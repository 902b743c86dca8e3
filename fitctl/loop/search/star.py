"""The search for a star: about where it is expected, once the siderostat has come there."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from fitctl.config import LEAST_OVERLAP, MOST_OVERLAP, AxisPair, Rig
from fitctl.controllers.centroid import LARGEST_PEAK, Star
from fitctl.controllers.spiral import SpiralPlan, plan_spiral
from fitctl.loop.search.attribution import Attribution, OtherStages
from fitctl.loop.search.finder import StarFinder
from fitctl.loop.search.spiral import (
    SpiralSearch,
    Wanted,
    asked_place_sky_arcsec,
    refused_area,
)
from fitctl.loop.sky import sky_rad_s
from fitctl.messages.commands import Acquire
from fitctl.messages.modes import Finding, Trigger
from fitctl.model.optics import scales

Floats = NDArray[np.float64]
_CHECK_COLLECTOR = (
    "shutter and pointing, and bring the collector back with fitctl send collector reference if it moved while "
    "its beam was not held"
)
_STAR = Wanted(
    name="star",
    found=Trigger.STAR_FOUND,
    confirmed="star on {} frames in a row",
    rejected="a candidate was not confirmed; the search goes on",
    check="shutter and pointing",
    check_long="shutter and clouds",
)


class StarSearch(SpiralSearch):
    """One stellar loop's; :meth:`start_where_expected` begins it anew.

    All angles are of motors that do not have to follow the star on the sky.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    finder : StarFinder
        Knows where the star is expected, and where what a frame shows is.
    read_target_px : callable
        Reads where the loop holds its star now, shape (2,).
    """

    def __init__(
        self, rig: Rig, loop_name: str, finder: StarFinder, read_target_px: Callable[[], Floats]
    ) -> None:
        loop = rig.stellar_loops[loop_name]
        self._rig = rig
        self._loop_name = loop_name
        self._estimator, self._attribution = finder.estimator, finder.attribution
        self._zero_px = np.array([loop.target_px.az, loop.target_px.el])
        self._read_target_px = read_target_px
        self._middle_px = np.array([rig.camera.width_px - 1, rig.camera.height_px - 1]) / 2
        scale = scales(rig, loop)
        self._scale = scale
        self._asked = Acquire()
        self._overlap: float | None = None
        # What moved the light without a held beam turned the star by as much.
        moves = loop.link is not None and rig.collector is not None
        wanted = _STAR._replace(check=_CHECK_COLLECTOR) if moves else _STAR
        super().__init__(
            wanted,
            loop.acquisition,
            self._plan_spiral,
            scale.motor_rad,
            loop.siderostat,
            scale.motor_px_per_rad,
        )

    def _plan_spiral(self, radius_sky_arcsec: float) -> SpiralPlan:
        return plan_spiral(
            self._rig,
            self._loop_name,
            radius_sky_arcsec=radius_sky_arcsec,
            field_overlap=self._overlap,
        )

    def configure(self, asked: Acquire) -> None:
        """Make the next search, and no other, as a command asks that was not refused."""
        self._asked = asked

    @property
    def asked_place_sky_arcsec(self) -> Floats | None:
        """Where the next search is to begin, as a command asked; shape (2,)."""
        return asked_place_sky_arcsec(self._asked)

    def start_where_expected(self, sky_rad: Floats, *, again: bool = False) -> None:
        """A new search, about where the star is expected now, or as a command asked.

        By the time of the command the star had moved by itself by `sky_rad`, shape (2,), as an angle of the
        motors. With `again`, it was followed until now: it is searched for in rounds, if the rig file allows
        it.
        """
        place_sky_arcsec, asked, self._asked = self.asked_place_sky_arcsec, self._asked, Acquire()
        if self._attribution is not None:
            self._attribution.begin_search()
        if place_sky_arcsec is not None:
            place_px = self._zero_px + self._scale.sky_px(place_sky_arcsec)
            self._estimator.place(place_px, sky_rad, np.zeros(2))
        self._overlap = asked.field_overlap
        # Two stars that were followed would lie on each other in the middle of the field.
        at_target = again and self._attribution is not None
        self.start(
            self._star_on_target_rad() if at_target else self._star_in_the_middle_rad(),
            again=again,
            radius_sky_arcsec=asked.search_radius_sky_arcsec,
        )

    def evaluate(
        self, star: Star | None, others: Mapping[str, OtherStages], now_s: float
    ) -> Finding | None:
        """What a frame exposed at `now_s` means for the search.

        `others` are the stages of the loops whose stars may be on the same frame, by name, at its exposure.
        """
        if not self._arrived:
            return self._wait_for_siderostat(now_s)
        if self._attribution is not None:
            return self._look_at_candidate(self._attribution, star, others, now_s)
        if star is None:
            return self.look(False, self.centre_rad, now_s)
        return self.look(True, self._star_in_the_middle_rad(), now_s)

    def _look_at_candidate(
        self,
        attribution: Attribution,
        star: Star | None,
        others: Mapping[str, OtherStages],
        now_s: float,
    ) -> Finding | None:
        """The star may be another loop's: the second look shows whether it moves with this loop's stages."""
        if attribution.candidate is None:
            if star is None:
                return self.look(False, self.centre_rad, now_s)
            place_px = attribution.propose(star, self._read_target_px(), others)
            return self.look(True, self._estimator.motor_for_rad(place_px, np.zeros(2)), now_s)
        has_moved = star is not None and attribution.has_moved(star, others)
        finding = self.look(has_moved, self.centre_rad, now_s)
        if finding is not None and finding.trigger is None:
            attribution.reject()
            self._arrived, self._slews_since_s = False, math.nan
        elif finding is not None:
            attribution.confirm()
        return finding

    def _begin_round(self, number: int) -> None:
        super()._begin_round(number)
        if self._attribution is not None:
            self._attribution.begin_round()

    def _star_on_target_rad(self) -> Floats:
        return self._estimator.motor_for_rad(self._read_target_px(), np.zeros(2))

    def _star_in_the_middle_rad(self) -> Floats:
        """With the star in the middle of the field, the search sees farthest."""
        return self._estimator.motor_for_rad(self._middle_px, np.zeros(2))


def _too_faint_or_bright(rig: Rig, loop_name: str, star_flux_dn: float | None) -> str:
    """Why a star of this flux could not be found or measured, or nothing."""
    if star_flux_dn is None:
        return ""
    if not 0 < star_flux_dn < math.inf:
        return f"star_flux_dn must be above 0 (is {star_flux_dn:g})"
    loop, camera = rig.stellar_loops[loop_name], rig.camera
    most_dn = (camera.full_scale_dn - camera.bias_dn) / loop.brightest_part
    if star_flux_dn > most_dn:
        return (
            f"a star of {star_flux_dn:g} DN would saturate its brightest pixel, which counts to "
            f"{camera.full_scale_dn}; at most {most_dn:.0f} DN can be measured; dim it, or expose for less time"
        )
    least_dn = loop.acquisition.detection_sigma * camera.pixel_noise_dn / LARGEST_PEAK
    if star_flux_dn < least_dn:
        return (
            f"a star of {star_flux_dn:g} DN could not be distinguished from noise; "
            f"loops.{loop_name}.acquisition.detection_sigma needs at least {least_dn:.0f} DN"
        )
    return ""


def _too_fast(rig: Rig, loop_name: str, asked: Acquire) -> str:
    """Why the siderostat could not follow a star of this rate, or nothing."""
    rates = (asked.rate_az_sky_arcsec_s, asked.rate_el_sky_arcsec_s)
    az, el = rates
    if az is None and el is None:
        return ""
    if az is None or el is None:
        return "rate_az_sky_arcsec_s and rate_el_sky_arcsec_s belong together"
    loop = rig.stellar_loops[loop_name]
    scale = scales(rig, loop)
    motor_rad_s = np.abs(sky_rad_s(AxisPair.model_construct(az=az, el=el), scale)).max()
    # Written so that what is no number is refused too.
    if not motor_rad_s <= loop.siderostat.velocity_limit_rad_s:
        most = loop.siderostat.velocity_limit_rad_s * loop.siderostat.sky_arcsec_per_motor_rad
        return (
            f"the siderostat cannot follow a star at az {az:g}, el {el:g} arcsec/s; velocity_limit_rad_s of "
            f"loops.{loop_name}.siderostat is {most:.0f} arcsec/s for a motor"
        )
    return ""


def refused_search(rig: Rig, loop_name: str, asked: Acquire) -> str:
    """Why a search cannot be made as asked, or nothing."""
    overlap = asked.field_overlap
    if overlap is not None and not LEAST_OVERLAP <= overlap <= MOST_OVERLAP:
        return f"field_overlap must lie in {LEAST_OVERLAP:g} to {MOST_OVERLAP:g} (is {overlap:g})"
    return (
        _too_faint_or_bright(rig, loop_name, asked.star_flux_dn)
        or _too_fast(rig, loop_name, asked)
        or refused_area(rig.stellar_loops[loop_name], loop_name, asked)
    )
