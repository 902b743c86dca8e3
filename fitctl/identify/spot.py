"""The width of a loop's spot, from frames: the template of ``sensor = "fit"``.

Every frame gives the spot's light, place and background by least squares, and all frames together its width. A
spot that a moving star smears has the width that the sensor will see. The loop's other spots are part of the
model: they move with the star, and have its width. Bad and saturated pixels do not count.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, WINDOW_PX, Camera, Loop, Rig
from fitctl.controllers.centroid import StarSensor
from fitctl.controllers.dark import Dark
from fitctl.controllers.spot_fit import gaussian_shape
from fitctl.identify.drawing import BLACK, BLUE, new_figure
from fitctl.identify.errors import IdentifyError
from fitctl.identify.frames import TimedImage
from fitctl.model.drives import Drive, standstill

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Floats = NDArray[np.float64]
RECOMMENDED_S = 10.0
LEAST_FRAMES = 100
MOST_FRAMES = 3000
NOT_ROUND = 2.0
"""A round Gaussian leaves the pixels' noise; more than so many times that is another shape."""
_LEAST_PIXELS = WINDOW_PX**2 // 2 + 1  # of a window, that are neither bad nor saturated
_AMOUNTS = 5  # of a frame: flux, two coordinates, width, background
_NARROWEST_PX, _WIDEST_PX = 1.0, 8.0
_STEPS, _ENOUGH_PX = 30, 1e-5
_SLOPE_PX = 1e-3  # for derivatives


@dataclass(frozen=True)
class SpotResult:
    """A spot's width.

    Attributes
    ----------
    loop : str
    diameter_px, diameter_sd_px : float
        1/e^2, and one standard deviation.
    rig_diameter_px : float
        As the rig file has it.
    frames : int
    flux_dn : float
        Median.
    excess : float
        RMS of what the fit leaves, over the pixels' noise.
    distance_px, light : arrays, shape (pixels,)
        Of the pixels that count: distance from the spot's centre, and light as a part of the spot's. The light
        of other spots is subtracted.
    """

    loop: str
    diameter_px: float
    diameter_sd_px: float
    rig_diameter_px: float
    frames: int
    flux_dn: float
    excess: float
    distance_px: Floats
    light: Floats

    def fragment(self) -> dict[str, Any]:
        """What to lay over the rig file."""
        return {"loops": {self.loop: {"spot_diameter_px": round(self.diameter_px, 4)}}}

    def lines(self) -> list[str]:
        """For an operator."""
        lines = [
            f"spot diameter (1/e^2): {self.diameter_px:.4f} +- {self.diameter_sd_px:.4f} px, rig file "
            f"{self.rig_diameter_px:g}",
            f"{self.frames} frames of {self.flux_dn:.0f} DN; unexplained {self.excess:.2f} times the pixels' "
            "noise",
        ]
        if self.excess > NOT_ROUND:
            lines.append(
                'The spot is not a round Gaussian: sensor = "fit" still finds it, but with more noise than '
                "designs assume. Look at the plot, at focus and at neighbours"
            )
        return lines

    def draw(self) -> Figure:
        """Light of the pixels over their distance, and the Gaussian."""
        figure = new_figure()
        axes = figure.add_subplot()
        axes.plot(self.distance_px, self.light, ".", markersize=2, color=BLUE, label="pixels")
        farthest_px = float(self.distance_px.max())
        at_px = np.linspace(0.0, farthest_px, 200)
        shape = [
            gaussian_shape(self.diameter_px, np.array(one), np.array(0.0)).reshape(
                WINDOW_PX, WINDOW_PX
            )[HALF_WINDOW_PX, HALF_WINDOW_PX]
            for one in at_px
        ]
        axes.plot(at_px, shape, color=BLACK, label=f"Gaussian, {self.diameter_px:.3f} px")
        axes.set(
            xlabel="distance from the spot's centre (px)", ylabel="part of the light on a pixel"
        )
        axes.legend()
        return figure


def plan(_rig: Rig, _loop_name: str) -> list[Drive]:
    """Nothing moves, for a little longer than is needed."""
    return standstill(RECOMMENDED_S + 2.0)


def analyse(rig: Rig, loop_name: str, frames: Iterable[TimedImage]) -> SpotResult:
    """The spot's width from the frames that show it.

    Raises
    ------
    IdentifyError
        If there are too few of them, or it is as narrow as a pixel or as wide as the window.
    """
    camera, loop = rig.camera, rig.stellar_loops[loop_name]
    windows = _windows(frames, camera, loop)
    spots = _Spots.of(loop)
    diameter_px, each_px, places, left_dn = _fit(windows, spots, loop.spot_diameter_px)
    if not _NARROWEST_PX < diameter_px < _WIDEST_PX:
        msg = (
            f"the spot's diameter comes out at {diameter_px:.2f} px; expected {_NARROWEST_PX:g} to "
            f"{_WIDEST_PX:g} px; look at focus and exposure, and record again"
        )
        raise IdentifyError(msg)
    flux_dn, az_px, el_px, background_dn = places.T
    shape = spots.shape(diameter_px, az_px, el_px)
    photon_dn = 1 / (camera.electrons_per_dn or math.inf)
    light = np.maximum(flux_dn[:, None] * shape, 0.0)
    expected_dn2 = camera.pixel_noise_dn**2 + photon_dn * light
    freedom = np.count_nonzero(windows.counts) - _AMOUNTS * len(flux_dn)
    centres = np.arange(WINDOW_PX) - HALF_WINDOW_PX
    el_at, az_at = np.meshgrid(centres, centres, indexing="ij")
    few = slice(None, None, max(1, len(flux_dn) // 100))
    counts = windows.counts[few]
    distance_px = np.hypot(az_at.ravel() - az_px[few, None], el_at.ravel() - el_px[few, None])
    part = (windows.light_dn[few] - background_dn[few, None]) / flux_dn[few, None]
    others = shape[few] - gaussian_shape(diameter_px, az_px[few], el_px[few])
    return SpotResult(
        loop=loop_name,
        diameter_px=diameter_px,
        diameter_sd_px=float(each_px.std(ddof=1)) / math.sqrt(len(each_px)),
        rig_diameter_px=loop.spot_diameter_px,
        frames=len(flux_dn),
        flux_dn=float(np.median(flux_dn)),
        excess=math.sqrt(float(np.sum(left_dn**2 / expected_dn2)) / freedom),
        distance_px=distance_px[counts],
        light=(part - others)[counts],
    )


class _Windows(NamedTuple):
    """Pixels about the loop's star.

    Attributes
    ----------
    light_dn : array, shape (frames, 49)
        Less what pixels read without any.
    counts : array of bool, shape (frames, 49)
        False for pixels that are bad or saturated.
    """

    light_dn: Floats
    counts: NDArray[np.bool_]


def _windows(frames: Iterable[TimedImage], camera: Camera, loop: Loop) -> _Windows:
    sensor, dark = StarSensor(camera, loop), Dark(camera)
    lights_dn: list[Floats] = []
    counts: list[NDArray[np.bool_]] = []
    spoilt = 0
    for _, image in frames:
        star = sensor.find(image)
        if star is None:
            continue
        el, az = star.window_el_px - HALF_WINDOW_PX, star.window_az_px - HALF_WINDOW_PX
        good = np.ones(WINDOW_PX**2, dtype=bool)
        good[list(dark.without_measurement(image, el, az, WINDOW_PX, WINDOW_PX))] = False
        if np.count_nonzero(good) < _LEAST_PIXELS:
            spoilt += 1
            continue
        lights_dn.append(dark.light(image, el, az, WINDOW_PX, WINDOW_PX).ravel().copy())
        counts.append(good)
        if len(counts) == MOST_FRAMES:
            break
    if len(counts) < LEAST_FRAMES:
        more = f"; on {spoilt} more, half of its pixels are bad or saturated" if spoilt else ""
        msg = (
            f"{len(counts)} whole frames show the star{more}; expected at least {LEAST_FRAMES}; a log keeps "
            "few but during the experiment of `fitctl identify spot`: hold the star and run that without --log"
        )
        raise IdentifyError(msg)
    return _Windows(np.array(lights_dn), np.array(counts))


class _Spots(NamedTuple):
    """The loop's star and its other spots, which move with it.

    Attributes
    ----------
    offsets_px : array, shape (spots, 2)
        From the star, azimuth and elevation.
    parts : array, shape (spots,)
        Light, as a part of the star's.
    """

    offsets_px: Floats
    parts: Floats

    @classmethod
    def of(cls, loop: Loop) -> _Spots:
        """From the rig file."""
        spots = loop.other_spots
        return cls(
            np.array([(0.0, 0.0), *((one.offset_px.az, one.offset_px.el) for one in spots)]),
            np.array([1.0, *(one.flux_dn / loop.star_flux_dn for one in spots)]),
        )

    def shape(self, diameter_px: float, az_px: Floats, el_px: Floats) -> Floats:
        """:func:`gaussian_shape` of all spots together, as a part of the star's light."""
        az_offsets_px, el_offsets_px = self.offsets_px.T
        each = gaussian_shape(
            diameter_px, az_px[..., None] + az_offsets_px, el_px[..., None] + el_offsets_px
        )
        return np.asarray(self.parts @ each)


def _fit(
    windows: _Windows, spots: _Spots, diameter_px: float
) -> tuple[float, Floats, Floats, Floats]:
    """The width that suits all frames, by Gauss and Newton.

    Returns
    -------
    diameter_px : float
    each_px : array, shape (frames,)
        Of each frame by itself.
    places : array, shape (frames, 4)
        Flux, place on both axes, background.
    left_dn : array, shape (frames, 49)
        What the fit leaves; 0 where a pixel does not count.
    """
    light_dn, counts = windows
    # From a centre of gravity.
    centres = np.arange(WINDOW_PX) - float(HALF_WINDOW_PX)
    el_at, az_at = (one.ravel() for one in np.meshgrid(centres, centres, indexing="ij"))
    flux_dn = light_dn.sum(axis=1)
    values = np.column_stack(
        [flux_dn, light_dn @ az_at / flux_dn, light_dn @ el_at / flux_dn, np.zeros(len(flux_dn))]
    )
    for _ in range(_STEPS):
        flux_dn, az_px, el_px, background_dn = values.T
        shape = spots.shape(diameter_px, az_px, el_px)

        terms = np.stack(
            [
                shape,
                *(flux_dn[:, None] * slope for slope in _slopes(spots, diameter_px, az_px, el_px)),
                np.ones_like(shape),
            ],
            axis=-1,
        )
        terms *= counts[..., None]
        left_dn = counts * (light_dn - flux_dn[:, None] * shape - background_dn[:, None])
        turned = terms.swapaxes(1, 2)
        steps = np.linalg.solve(turned @ terms, turned @ left_dn[..., None])[..., 0]
        each_px = diameter_px + steps[:, 3]
        wider_px = float(np.median(steps[:, 3]))
        values = values + steps[:, [0, 1, 2, 4]]
        diameter_px = float(np.clip(diameter_px + wider_px, 0.5, 2 * WINDOW_PX))
        if abs(wider_px) < _ENOUGH_PX:
            break
    return float(np.mean(each_px)), each_px, values, left_dn


def _slopes(spots: _Spots, diameter_px: float, az_px: Floats, el_px: Floats) -> list[Floats]:
    """Of the spots' shape by the star's place on both axes and by the width, each shape (frames, 49)."""
    at = np.array([np.full_like(az_px, diameter_px), az_px, el_px])
    slopes = []
    for by in (1, 2, 0):
        step = _SLOPE_PX * np.eye(3)[by][:, None]
        ahead, behind = (spots.shape(one[0, 0], one[1], one[2]) for one in (at + step, at - step))
        slopes.append((ahead - behind) / (2 * _SLOPE_PX))
    return slopes
