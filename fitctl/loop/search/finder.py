"""Find a loop's star on a frame: at its expected place, where a person pointed, or anywhere."""

from __future__ import annotations

from collections.abc import Callable, Iterable

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.attribution import FOLLOWED_PX, is_within
from fitctl.controllers.centroid import OtherLight, Star, StarSensor, moving_with_star
from fitctl.controllers.estimator import StarEstimator
from fitctl.logging.records import Severity
from fitctl.loop.search.attribution import Attribution, nearest
from fitctl.messages.modes import TRACKING, WITH_WINDOW, Mode
from fitctl.model.optics import AzEl, scales

Floats = NDArray[np.float64]


class StarFinder:
    """One loop's.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    target_px : array, shape (2,)
        Where a star of which nothing is known is taken to be.
    report_event : callable
        Takes the severity and the text of an event.

    Attributes
    ----------
    estimator : StarEstimator
    attribution : Attribution or None
        None where no other loop's star is on the frame.
    look_at_px : tuple of float or None
        Where the star is looked for on the next frame, and then no more.
    last : Star or None
        The star when it was last found.
    """

    def __init__(
        self,
        rig: Rig,
        loop_name: str,
        target_px: Floats,
        report_event: Callable[[Severity, str], None],
    ) -> None:
        loop = rig.stellar_loops[loop_name]
        self.estimator = StarEstimator(scales(rig, loop), target_px)
        self.attribution: Attribution | None = None
        if len(rig.stellar_loops) > 1:
            self.attribution = Attribution(rig.camera, self.estimator)
        self.look_at_px: AzEl | None = None
        self.last: Star | None = None
        self._visible = False
        self._sensor = StarSensor(rig.camera, loop)
        self._loop = loop
        self._report_event = report_event

    def expect_flux(self, flux_dn: float) -> None:
        """What the star's light is to be from now on."""
        self._sensor.expect(flux_dn)

    def noise_px(self, flux_dn: float) -> float:
        """One standard deviation of where the star is found, if its light is this."""
        return self._sensor.noise_px(flux_dn)

    def exclude(
        self, followed: Iterable[list[OtherLight]], candidates: Iterable[list[OtherLight]]
    ) -> None:
        """From now on no star is looked for where other loops follow theirs, and their light is subtracted.

        So is the light of their candidates, but each of these may be this loop's star. Each loop's list begins
        with its star.
        """
        spots = [spots for spots in followed if spots]
        self._sensor.excluded_px = [(star.az_px, star.el_px) for star, *_ in spots]
        self._sensor.other_light = [spot for of_loop in (*spots, *candidates) for spot in of_loop]

    def spots(self, moved_px: AzEl = (0.0, 0.0)) -> list[OtherLight]:
        """The star when it was last found, then what moves with it; dark if the last frame lacks it.

        `moved_px` is how far the stages have taken all of it since.
        """
        if self.last is None:
            return []
        az_px, el_px, flux_dn, *_ = self.last
        az_px, el_px = az_px + moved_px[0], el_px + moved_px[1]
        flux_dn *= self._visible
        return [
            OtherLight(az_px, el_px, flux_dn, self._loop.spot_diameter_px),
            *moving_with_star(self._loop, self._loop.other_spots, az_px, el_px, flux_dn),
        ]

    def find(
        self,
        image: NDArray[np.uint16],
        mode: Mode,
        motor_rad: Floats,
        mirror_rad: Floats,
        *,
        follows: bool,
        again: bool,
    ) -> Star | None:
        """The star on a frame that was exposed with the stages as given, each shape (2,).

        Where it `follows`, the star was on the frame before; a search is made `again` for one that was lost.
        """
        stages_px = self.estimator.stages_px(motor_rad, mirror_rad)
        star = self._looked_for(image, mode)
        if star is None:
            expected_px = self.estimator.predict_px(stages_px)
            star = self._sensor.in_window(image, *expected_px) if follows else None
            star = star or self._find_own(image, mode, expected_px, again=again)
        self.last, self._visible = star or self.last, star is not None
        if star is not None and self.attribution is not None:
            self.attribution.observe(star, mode, stages_px)
        elif star is not None and mode in TRACKING:
            self.estimator.observe((star.az_px, star.el_px), stages_px)
        return star

    def _find_own(
        self, image: NDArray[np.uint16], mode: Mode, expected_px: AzEl, *, again: bool
    ) -> Star | None:
        """The loop's own star on a whole frame, on which other stars may be that look alike.

        One that is followed is near where it is expected; one that was lost probably is. So is one in an
        experiment, which may be to find out where the stages move it.
        """
        stars = self._sensor.candidates(image)
        if self.attribution is not None:
            return self.attribution.choose(stars, mode, expected_px)
        if mode in WITH_WINDOW:
            near = (star for star in stars if is_within(*star[:2], *expected_px, FOLLOWED_PX))
            return nearest(near, expected_px)
        if again or mode is Mode.EXPERIMENT:
            return nearest(stars, expected_px)
        return next(stars, None)  # the brightest

    def _looked_for(self, image: NDArray[np.uint16], mode: Mode) -> Star | None:
        """The star at the place of a `look` command, if there is one."""
        look_px, self.look_at_px = self.look_at_px, None
        if look_px is None or mode not in WITH_WINDOW:
            return None
        star = self._sensor.find_at(image, *look_px)
        place = f"az {look_px[0]:g}, el {look_px[1]:g} px"
        if star is None:
            self._report_event("warning", f"no star in the window at {place}; nothing changes")
        else:
            self._report_event("info", f"the star at {place} is followed from now on")
        return star
