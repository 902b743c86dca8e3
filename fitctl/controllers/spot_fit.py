"""Where a spot is in a window, by least squares: as closely as its light and the pixels' noise allow.

Eq. 7's centre of gravity weights each pixel by its distance, so that dark pixels far from the star bring
most of its noise. A fit of the spot's known shape weights them by what they say: on FIT 0.0024 px instead
of 0.0100.

About a place, a spot of flux A on a background b is A (g - dx g_x - dy g_y) + b, with g its light on each
pixel and g_x, g_y its slopes. Least squares, weighted by each pixel's expected variance, gives A, A dx, A dy
and b as sums over the pixels with factors that hang on the place within a pixel alone: they are made once,
for places 1/8 px apart. What is left out between them is below 0.0003 px for a spot in the middle pixel.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX
from fitctl.model.compiled import compilable
from fitctl.model.image.light import light_below

Floats = NDArray[np.float64]
STEPS_PER_PX = 8
REACH_PX = (
    1.5  # of the places for which there are weights, from the window's centre, along each axis
)
NODES = int(REACH_PX * STEPS_PER_PX)
PLACES = 2 * NODES + 1  # along an axis
_SIDE = 2 * HALF_WINDOW_PX + 1
_EDGES_PX = np.arange(_SIDE + 1) - _SIDE / 2
_SLOPE_STEP_PX = 1e-3
# A pixel is left out if it misses the fit by so many standard deviations, and no more than such a part of the
# misfit is the others', or no more than theirs should be by so many times: a spot that is wider than told
# misses at several pixels alike.
_INEXACT_PART = 1e-3  # of the flux: so far off may a pixel of a bright spot be between two nodes
_OUTLIER_SIGMAS, _OTHERS_PART, _OTHERS_TIMES = 6.0, 0.2, 2.0


class _Solution(NamedTuple):
    """Where the pixels put the spot: `fit_dn` is what each should read, by weights made for a node."""

    az_px: float
    el_px: float
    flux_dn: float
    weights: Floats
    node: tuple[int, int]
    fit_dn: Floats


class SpotPlace(NamedTuple):
    """A fitted spot.

    Attributes
    ----------
    az_px, el_px : float
        From the window's centre.
    flux_dn : float
        All its light.
    az_sigma_px, el_sigma_px : float
        One standard deviation, from pixel noise and photons.
    """

    az_px: float
    el_px: float
    flux_dn: float
    az_sigma_px: float
    el_sigma_px: float


def gaussian_shape(diameter_px: float, az_px: Floats, el_px: Floats) -> Floats:
    """Part of a Gaussian spot's light on each pixel of a window, shape (..., 49), row by row.

    Parameters
    ----------
    diameter_px : float
        1/e^2.
    az_px, el_px : arrays, shape (...)
        Where the spot is, from the window's centre.
    """
    across, down = (
        np.diff(light_below((_EDGES_PX - place[..., None]) / (diameter_px / 4)))
        for place in (az_px, el_px)
    )
    return np.asarray((down[..., :, None] * across[..., None, :]).reshape(*az_px.shape, -1))


def _terms(diameter_px: float) -> Floats:
    """Light, minus its slopes, and background on each pixel, at each node, shape (rows, columns, 49, 4)."""
    places = np.arange(-NODES, NODES + 1) / STEPS_PER_PX
    el_px, az_px = np.meshgrid(places, places, indexing="ij")
    step = _SLOPE_STEP_PX
    ahead_az, behind_az, ahead_el, behind_el = (
        gaussian_shape(diameter_px, az_px + az_step, el_px + el_step)
        for az_step, el_step in ((step, 0.0), (-step, 0.0), (0.0, step), (0.0, -step))
    )
    shape = gaussian_shape(diameter_px, az_px, el_px)
    return np.stack(
        [
            shape,
            (ahead_az - behind_az) / (2 * step),
            (ahead_el - behind_el) / (2 * step),
            np.ones_like(shape),
        ],
        axis=-1,
    )


class SpotFit:
    """Least squares over 7x7 px for the spots of one loop.

    Parameters
    ----------
    diameter_px : float
        A spot's 1/e^2 diameter.
    noise_dn : float
        One standard deviation of a pixel without light.
    flux_dn : float
        The light that is expected. Another one is measured too, not quite as well.
    electrons_per_dn : float
        Photons add noise of their own; infinite is none.

    Attributes
    ----------
    weights : array, shape (nodes, nodes, 4, 49)
        For a spot at each node, row by row: factors of the pixels in its flux, its flux times its distance
        from the node along azimuth and elevation, and the background.
    """

    def __init__(
        self,
        diameter_px: float,
        noise_dn: float,
        flux_dn: float,
        electrons_per_dn: float = math.inf,
    ) -> None:
        self._noise_dn = noise_dn
        self._photon_dn = 1 / electrons_per_dn
        self._terms = _terms(diameter_px)
        self._deviation_dn = np.sqrt(self._variance_dn2(flux_dn * self._terms[..., 0]))
        self.weights = _make_weights(self._terms, self._deviation_dn)
        leverage = np.einsum("rcpt,rctp->rcp", self._terms, self.weights)
        self._leverage_scale = 1 / np.sqrt(1 - leverage)

    def _variance_dn2(self, light_dn: Floats) -> Floats:
        return self._noise_dn**2 + self._photon_dn * np.maximum(light_dn, 0.0)

    def place(
        self, light_dn: Floats, az_px: float, el_px: float, good: NDArray[np.bool_] | None = None
    ) -> SpotPlace | None:
        """Where the spot is that lies near a place; None if there is none within the window's reach.

        Parameters
        ----------
        light_dn : array, shape (7, 7)
            Dark subtracted.
        az_px, el_px : float
            Where it was found to be, from the window's centre.
        good : array of bool, shape (7, 7), optional
            Pixels that count; all without it.
        """
        pixels_dn = light_dn.ravel()
        counts = None if good is None else good.ravel()
        found = self._converge(pixels_dn, az_px, el_px, counts)
        if counts is None and found is not None:
            outlier = self._outlier(pixels_dn, found)
            if outlier is not None:
                counts = np.ones(pixels_dn.size, dtype=bool)
                counts[outlier] = False
                found = self._converge(pixels_dn, az_px, el_px, counts)
        if found is None:
            return None
        variance_dn2 = self._variance_dn2(found.fit_dn)
        variances = np.square(found.weights[1:3]).dot(variance_dn2)
        sigmas_px = (np.sqrt(variances) / found.flux_dn).tolist()
        return SpotPlace(found.az_px, found.el_px, found.flux_dn, *sigmas_px)

    def _converge(
        self, pixels_dn: Floats, az_px: float, el_px: float, counts: NDArray[np.bool_] | None
    ) -> _Solution | None:
        """Two steps from a place; the first may begin half a pixel off, the second ends at the spot."""
        for _ in range(2):
            at = node(el_px), node(az_px)
            weights = self.weights[at]
            if counts is not None:
                weights = np.zeros(weights.shape)
                weights[:, counts] = _make_weights(
                    self._terms[at][counts], self._deviation_dn[at][counts]
                )
            amounts = weights.dot(pixels_dn)
            flux_dn, az_moment, el_moment, _ = amounts.tolist()
            if flux_dn <= 0:
                return None
            az_px = (at[1] - NODES) / STEPS_PER_PX + az_moment / flux_dn
            el_px = (at[0] - NODES) / STEPS_PER_PX + el_moment / flux_dn
        if max(abs(az_px), abs(el_px)) > HALF_WINDOW_PX:
            return None
        fit_dn = self._terms[at].dot(amounts)
        return _Solution(az_px, el_px, flux_dn, weights, at, fit_dn)

    def _outlier(self, pixels_dn: Floats, found: _Solution) -> int | None:
        """The pixel without which the fit is right; None if it is right, or wrong for another reason."""
        deviations = (pixels_dn - found.fit_dn) / self._deviation_dn[found.node]
        # What the fit would miss without a pixel (Cook and Weisberg, Residuals and Influence, 1982).
        missed = deviations * self._leverage_scale[found.node]
        worst = int(np.abs(missed).argmax())
        worst_2 = missed.item(worst) ** 2
        expected_2 = 1 + (_INEXACT_PART * found.flux_dn / self._noise_dn) ** 2
        if worst_2 <= _OUTLIER_SIGMAS**2 * expected_2:
            return None
        misfit = float(deviations.dot(deviations))
        limit = max(_OTHERS_PART * misfit, _OTHERS_TIMES * expected_2 * deviations.size)
        return worst if misfit - worst_2 <= limit else None

    def noise_px(self, flux_dn: float) -> float:
        """One standard deviation of a spot's place along an axis, on the mean of places within a pixel."""
        half = STEPS_PER_PX // 2
        pixel = slice(NODES - half, NODES + half)
        variance_dn2 = self._variance_dn2(flux_dn * self._terms[pixel, pixel, :, 0])
        variances = np.square(self.weights[pixel, pixel, 1:3]) * variance_dn2[:, :, None, :]
        return math.sqrt(variances.sum(axis=-1).mean()) / flux_dn


def _make_weights(terms: Floats, deviation_dn: Floats) -> Floats:
    """Factors of the pixels in each term, shape (..., 4, pixels)."""
    scaled = np.linalg.pinv(terms / deviation_dn[..., None])
    return np.asarray(scaled / deviation_dn[..., None, :], dtype=np.float64)


@compilable(inline=True)
def node(place_px: float) -> int:
    """The nearest place that has weights."""
    return min(max(round(place_px * STEPS_PER_PX) + NODES, 0), 2 * NODES)


@functools.lru_cache(maxsize=8)
def spot_fit(
    diameter_px: float, noise_dn: float, flux_dn: float, electrons_per_dn: float | None
) -> SpotFit:
    """One fit for all who ask for the same; see :class:`SpotFit`."""
    return SpotFit(diameter_px, noise_dn, flux_dn, electrons_per_dn or math.inf)
