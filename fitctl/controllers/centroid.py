"""Where the star is on a frame: centre of gravity over a window (Eq. 7), and a finder over the whole frame."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, WINDOW_PX, Camera, Loop, OtherSpot
from fitctl.controllers.dark import Dark
from fitctl.controllers.spot_fit import SpotFit, spot_fit
from fitctl.model.compiled import compilable
from fitctl.model.image.light import REACH_SIGMAS, centroid_noise_px, light_below

_LEVER_PX = np.arange(-HALF_WINDOW_PX, HALF_WINDOW_PX + 1.0)
# Eq. 7's three sums over a window, row by row: light, and its moments along azimuth and elevation.
_SUMS = np.array(
    [
        np.ones(_LEVER_PX.size**2),
        np.tile(_LEVER_PX, _LEVER_PX.size),
        np.repeat(_LEVER_PX, _LEVER_PX.size),
    ]
)
EDGE_PX = HALF_WINDOW_PX - 1.5  # nearer to its edge, the window would cut the spot
MAX_CANDIDATES = 6  # spots of a frame that are looked at
MOST_HOT = 24  # pixels of a frame that are passed over as no spots
REACH_DIAMETERS = 1.0  # from the centre of a spot: beyond lies a part of its light in 10 000
_EDGES_PX = np.arange(-HALF_WINDOW_PX, HALF_WINDOW_PX + 2.0) - 0.5
_STEPS_PER_PX = 64  # of the table of near spots' light: a place is wrong by 0.008 px at most
AS_EXPECTED_PX = (
    0.1  # a star that is farther from where it was expected is fitted again, beside its near spots
)
LARGEST_PEAK = 0.6  # of a spot's light in its brightest pixel; a hot pixel has all of it


class Star(NamedTuple):
    """A star on a frame.

    Attributes
    ----------
    az_px, el_px : float
        Centre of gravity, or the centre of the fitted spot, global pixel coordinates.
    flux_dn : float
        Sum over the window, dark subtracted.
    window_az_px, window_el_px : int
        Centre of the 7x7 window.
    sigma_az_px, sigma_el_px : float
        One standard deviation of the place, from pixel noise and photons; of a centroid, with the light that
        is expected.
    """

    az_px: float
    el_px: float
    flux_dn: float
    window_az_px: int
    window_el_px: int
    sigma_az_px: float = math.nan
    sigma_el_px: float = math.nan

    @property
    def position_px(self) -> NDArray[np.float64]:
        """Where it is, shape (2,)."""
        return np.array([self.az_px, self.el_px])

    @property
    def off_centre_px(self) -> float:
        """How far that is from the window's centre, along the axis on which it is farther."""
        return max(abs(self.az_px - self.window_az_px), abs(self.el_px - self.window_el_px))


@compilable()
def window_centre(px: float, largest_px: int) -> int:
    """The pixel nearest to `px`, along one axis, about which the window fits on the frame."""
    return min(max(round(px), HALF_WINDOW_PX), largest_px)


class OtherLight(NamedTuple):
    """A spot of another loop: where it is, its whole light, and its 1/e^2 diameter."""

    az_px: float
    el_px: float
    flux_dn: float
    diameter_px: float


class StarSensor:
    """Finds one loop's pointing spot.

    Parameters
    ----------
    camera : Camera
    loop : Loop
        Its flux range separates the pointing spot from fringe spots and hot pixels.

    Attributes
    ----------
    excluded_px : list of pair of float
        Places of other loops' stars: a star whose window would hold one of these is not this loop's.
    fit : SpotFit or None
        How the star is measured; None for the centroid.
    other_light : list of OtherLight
        Spots of other loops. Their light is subtracted from a window, or it would pull this loop's star.
    near_spots : list of OtherSpot
        The loop's own other spots, where their light reaches into the star's window: a fit subtracts it.
    """

    def __init__(self, camera: Camera, loop: Loop) -> None:
        self.excluded_px: list[tuple[float, float]] = []
        self.other_light: list[OtherLight] = []
        self._dark = Dark(camera)
        self.threshold_dn = loop.acquisition.detection_sigma * camera.pixel_noise_dn
        self.near_spots = [
            spot
            for spot in loop.other_spots
            if _reaches(spot.offset_px.az, spot.offset_px.el, loop.spot_diameter_px)
        ]
        self._near_light = _NearLight(loop, self.near_spots)
        self._flux_range = loop.flux_range
        self._camera, self._loop = camera, loop
        self.largest_az_px, self.largest_el_px = camera.largest_window_px
        self.expect(loop.star_flux_dn)

    def expect(self, star_flux_dn: float) -> None:
        """From now on the loop's star is the one with this flux, within the loop's range about it."""
        self.flux_low_dn = self._flux_range.low * star_flux_dn
        self.flux_high_dn = self._flux_range.high * star_flux_dn
        self.fit = fit_for(self._camera, self._loop, star_flux_dn)
        self._centroid_sigma_px = centroid_noise_px(
            self._camera, star_flux_dn, _LEVER_PX.size, self._loop.spot_diameter_px
        )

    def noise_px(self, star_flux_dn: float) -> float:
        """As :func:`sensor_noise_px`, of the fit that is at hand: another one would take milliseconds."""
        return _noise_px(self.fit, self._camera, self._loop, star_flux_dn)

    def measure(
        self, image: NDArray[np.uint16], window_az_px: float, window_el_px: float
    ) -> Star | None:
        """Eq. 7 over the window nearest to the given centre; None when this loop's star is not in it."""
        return self._accepted(self._centroid(image, window_az_px, window_el_px))

    def in_window(
        self, image: NDArray[np.uint16], expected_az_px: float, expected_el_px: float
    ) -> Star | None:
        """:meth:`measure` where the star is expected; None also where the window cuts it.

        What is expected may be half a window off after a jump.
        """
        star = self.measure(image, expected_az_px, expected_el_px)
        return None if star is None or star.off_centre_px > EDGE_PX else star

    def find(self, image: NDArray[np.uint16]) -> Star | None:
        """Look over the whole frame; the brightest of what may be this loop's star, or None."""
        return next(self.candidates(image), None)

    def candidates(self, image: NDArray[np.uint16]) -> Iterator[Star]:
        """All spots that could be this loop's star, brightest first."""
        search = self._dark.light(image, 0, 0, *image.shape)
        spots = 0
        for _ in range(MAX_CANDIDATES + MOST_HOT):
            el_px, az_px = divmod(int(search.argmax()), search.shape[1])
            if search[el_px, az_px] < self.threshold_dn or spots == MAX_CANDIDATES:
                return
            spot = self._centroid(image, az_px, el_px)
            spots += spot is not None
            star = self._whole(image, spot)
            if star is not None:
                yield star
            search[
                max(0, el_px - HALF_WINDOW_PX) : el_px + HALF_WINDOW_PX + 1,
                max(0, az_px - HALF_WINDOW_PX) : az_px + HALF_WINDOW_PX + 1,
            ] = -math.inf

    def find_at(self, image: NDArray[np.uint16], az_px: float, el_px: float) -> Star | None:
        """Measure this loop's star about a place; None when it is not there, or the frame cuts it."""
        return self._whole(image, self._centroid(image, az_px, el_px))

    def _whole(self, image: NDArray[np.uint16], spot: Star | None) -> Star | None:
        """A spot, if it is this loop's star and the frame does not cut it."""
        if spot is not None:
            # Once more about its own centre, so that the window does not cut the spot.
            spot = self._centred(image, spot)
        star = self._accepted(spot)
        # A spot cut by the frame's edge has its centre of gravity away from the window's centre.
        return star if star is not None and star.off_centre_px <= 1.0 else None

    def _centred(self, image: NDArray[np.uint16], star: Star) -> Star | None:
        """The centroid about a star's own centre, which often is where its window is."""
        az = window_centre(star.az_px, self.largest_az_px)
        el = window_centre(star.el_px, self.largest_el_px)
        if az == star.window_az_px and el == star.window_el_px:
            return star
        return self._centroid(image, az, el)

    def _centroid(
        self, image: NDArray[np.uint16], window_az_px: float, window_el_px: float
    ) -> Star | None:
        """Eq. 7; None where there is no light, or one pixel has most of it."""
        az = window_centre(window_az_px, self.largest_az_px)
        el = window_centre(window_el_px, self.largest_el_px)
        side = _LEVER_PX.size
        light_dn = self._dark.light(image, el - HALF_WINDOW_PX, az - HALF_WINDOW_PX, side, side)
        for spot in self.other_light:
            if _reaches(spot.az_px - az, spot.el_px - el, spot.diameter_px):
                light_dn -= spot_light(spot, az, el)
        flux_dn, az_moment, el_moment = _SUMS.dot(light_dn.ravel()).tolist()
        peak_dn = light_dn.item(light_dn.argmax())  # `max` takes four times as long
        if flux_dn <= 0 or peak_dn > LARGEST_PEAK * flux_dn:
            return None
        az_px, el_px = az_moment / flux_dn, el_moment / flux_dn
        if self.fit is None:
            sigma_px = self._centroid_sigma_px
            return Star(az + az_px, el + el_px, flux_dn, az, el, sigma_px, sigma_px)
        expected_px = window_az_px - az, window_el_px - el
        top, left = el - HALF_WINDOW_PX, az - HALF_WINDOW_PX
        without = self._dark.without_measurement(image, top, left, side, side)
        place = self.fit.place(
            self._without_near(light_dn, flux_dn, expected_px), az_px, el_px, without
        )
        if (
            place is not None
            and self.near_spots
            and math.dist(place[:2], expected_px) > AS_EXPECTED_PX
        ):
            lone_dn = self._without_near(light_dn, flux_dn, place[:2])
            place = self.fit.place(lone_dn, *place[:2], without)
        if place is None:
            return None
        az_px, el_px, _, az_sigma_px, el_sigma_px = place
        return Star(az + az_px, el + el_px, flux_dn, az, el, az_sigma_px, el_sigma_px)

    def _without_near(
        self, light_dn: NDArray[np.float64], flux_dn: float, star_px: tuple[float, float]
    ) -> NDArray[np.float64]:
        """A window's light less that of near spots, with the star at a place from the window's centre."""
        if not self.near_spots:
            return light_dn
        beside_star = self._near_light.of_star(*star_px)
        return light_dn - flux_dn / (1.0 + float(beside_star.sum())) * beside_star

    def _accepted(self, star: Star | None) -> Star | None:
        if star is None or not self.flux_low_dn <= star.flux_dn <= self.flux_high_dn:
            return None
        for az_px, el_px in self.excluded_px:
            if max(abs(star.az_px - az_px), abs(star.el_px - el_px)) <= HALF_WINDOW_PX:
                return None
        return star


class _NearLight:
    """Light of spots near a loop's star on its window, from a table: :func:`spot_light` takes too long."""

    def __init__(self, loop: Loop, spots: Iterable[OtherSpot]) -> None:
        self._spots = [
            (spot.offset_px.az, spot.offset_px.el, spot.flux_dn / loop.star_flux_dn)
            for spot in spots
        ]
        sigma_px = loop.spot_diameter_px / 4
        self._ends_px = math.ceil(REACH_SIGMAS * sigma_px) + _LEVER_PX.size
        ends = self._ends_px * _STEPS_PER_PX
        distance_px = np.arange(-ends, ends + 1) / _STEPS_PER_PX
        self._parts = light_below((distance_px + 0.5) / sigma_px)
        self._parts -= light_below((distance_px - 0.5) / sigma_px)

    def of_star(self, az_px: float, el_px: float) -> NDArray[np.float64]:
        """Shape (7, 7), as a part of the star's light; where the star is, from the window's centre."""
        light = np.zeros((_LEVER_PX.size, _LEVER_PX.size))
        for az_offset_px, el_offset_px, part in self._spots:
            across, down = self._along(az_px + az_offset_px), self._along(el_px + el_offset_px)
            light += part * down[:, None] * across
        return light

    def _along(self, place_px: float) -> NDArray[np.float64]:
        """Of the window's columns, or its rows. At the table's ends no light is left."""
        first_px = self._ends_px - HALF_WINDOW_PX - place_px
        first = round(min(max(first_px, 0.0), 2 * self._ends_px - _LEVER_PX.size) * _STEPS_PER_PX)
        return self._parts[first : first + _LEVER_PX.size * _STEPS_PER_PX : _STEPS_PER_PX]


def fit_for(camera: Camera, loop: Loop, star_flux_dn: float) -> SpotFit | None:
    """The fit of a loop's star with this flux; None where the loop's sensor is the centroid."""
    if loop.sensor == "centroid":
        return None
    return spot_fit(
        loop.spot_diameter_px, camera.pixel_noise_dn, star_flux_dn, camera.electrons_per_dn
    )


def sensor_noise_px(camera: Camera, loop: Loop, star_flux_dn: float) -> float:
    """One standard deviation of where a loop's sensor finds a star of this flux, along one axis."""
    return _noise_px(fit_for(camera, loop, star_flux_dn), camera, loop, star_flux_dn)


def _noise_px(fit: SpotFit | None, camera: Camera, loop: Loop, star_flux_dn: float) -> float:
    if fit is None:
        return centroid_noise_px(camera, star_flux_dn, WINDOW_PX, loop.spot_diameter_px)
    return fit.noise_px(star_flux_dn)


def moving_with_star(
    loop: Loop, spots: Iterable[OtherSpot], az_px: float, el_px: float, flux_dn: float
) -> list[OtherLight]:
    """Spots of a loop's `other_spots`, with its star at a place and of a flux."""
    return [
        OtherLight(
            az_px + spot.offset_px.az,
            el_px + spot.offset_px.el,
            spot.flux_dn * flux_dn / loop.star_flux_dn,
            loop.spot_diameter_px,
        )
        for spot in spots
    ]


def _reaches(away_az_px: float, away_el_px: float, diameter_px: float) -> bool:
    """Whether a spot so far from a window's centre leaves light in the window."""
    away_px = max(abs(away_az_px), abs(away_el_px))
    return away_px < _LEVER_PX.size / 2 + REACH_DIAMETERS * diameter_px


def spot_light(spot: OtherLight, az_px: int, el_px: int) -> NDArray[np.float64]:
    """What a spot leaves on each pixel of the window about a place, shape (7, 7), in DN."""
    centres_px, places_px = np.array((((az_px,), (el_px,)), ((spot.az_px,), (spot.el_px,))))
    below = light_below((centres_px + _EDGES_PX - places_px) / (spot.diameter_px / 4))
    across, down = below[:, 1:] - below[:, :-1]
    return spot.flux_dn * (down[:, None] * across)
