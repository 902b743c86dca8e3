"""Where a spot is in a window, by least squares: as closely as its light and the pixels' noise allow.

Eq. 7's centre of gravity weights each pixel by its distance, so that dark pixels far from the star bring
most of its noise. A fit of the spot's known shape weights them by what they say: on FIT 0.0023 px instead
of 0.0100.

About a place, a spot of flux A on a background b is A (g - dx g_x - dy g_y) + b, with g its light on each
pixel and g_x, g_y its slopes. Least squares, weighted by each pixel's expected variance, gives A, A dx, A dy
and b as sums over the pixels with factors that hang on the place within a pixel alone: they are made once,
for places 1/8 px apart. What is left out between them is below 0.0003 px for a spot of 3 px in the middle
pixel. The slopes of narrower spots change faster: at 1.5 px it is 0.0014 px RMS, which :meth:`SpotFit.noise_px`
includes.
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX, WINDOW_PX
from fitctl.model.compiled import compilable
from fitctl.model.image.light import light_below

Floats = NDArray[np.float64]
STEPS_PER_PX = 8
# Of the places for which there are weights, from the window's centre, along each axis.
REACH_PX = 1.5
NODES = int(REACH_PX * STEPS_PER_PX)
PLACES = 2 * NODES + 1  # along an axis
# Of the nodes, those of the middle pixel.
_PIXEL = (slice(NODES - STEPS_PER_PX // 2, NODES + STEPS_PER_PX // 2),) * 2
_EDGES_PX = np.arange(WINDOW_PX + 1) - WINDOW_PX / 2
_SLOPE_STEP_PX = 1e-3
_EXACT_PX = 1e-4  # an error between nodes that is smaller, RMS, does not count (choice)
# A pixel is left out if it misses the fit by so many standard deviations.
_INEXACT_PART = 1e-3  # of the flux: so far off may a pixel of a bright spot be between two nodes
_OUTLIER_SIGMAS = 6.0
# One, two or three are, if no more than such a part of the misfit is the others', or no more than theirs should
# be by so many times. A spot that is wider than told misses at several pixels alike: without the worst one, two
# or three of a spot that is 13 % narrower, 0.19, 0.14 and 0.09 of its misfit stay at least.
_OTHERS_PARTS, _OTHERS_TIMES = (0.2, 0.1, 0.05), 2.0
# Where another width explains such a part of the misfit, no pixel is an outlier.
_WIDTH_PART = 0.85
_MOST_WITHOUT = (
    24  # pixels that do not count: with half of the window, the others determine the spot
)
_REMEMBERED = 1000  # weights, of 1.6 kB
_AMOUNTS = 4  # flux, two moments, background


class _Solution(NamedTuple):
    """Where the pixels put the spot, by weights made for a node.

    Attributes
    ----------
    amounts : array, shape (4,)
    left_dn : array, shape (49,)
        What is left of the pixels; 0 of those that are left out.
    """

    az_px: float
    el_px: float
    flux_dn: float
    weights: Floats
    node: tuple[int, int]
    amounts: Floats
    left_dn: Floats


class SpotPlace(NamedTuple):
    """A fitted spot.

    Attributes
    ----------
    az_px, el_px : float
        From the window's centre.
    flux_dn : float
        All its light.
    az_sigma_px, el_sigma_px : float
        One standard deviation, from pixel noise and photons, both as large as the pixels' misfit says. For a
        narrow spot it includes the error between nodes.
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


def _nodes_px() -> tuple[Floats, Floats]:
    """Azimuth and elevation of each node, shapes (rows, columns)."""
    places = np.arange(-NODES, NODES + 1) / STEPS_PER_PX
    el_px, az_px = np.meshgrid(places, places, indexing="ij")
    return az_px, el_px


def _terms(diameter_px: float) -> Floats:
    """Light, minus its slopes, and background on each pixel, at each node, shape (rows, columns, 49, 4)."""
    az_px, el_px = _nodes_px()
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
        # What the fit would miss without a pixel (Cook and Weisberg, Residuals and Influence, 1982).
        self._missed_per_dn = 1 / (self._deviation_dn * np.sqrt(1 - leverage))
        self._wider = self._misfit_of_another_width(diameter_px)
        self._between_px = self._error_between_nodes_px(diameter_px)
        # Bad pixels stay where they are, and a star that is held lies at a few nodes.
        self._weights_without = functools.lru_cache(_REMEMBERED)(self._leave_out)

    def _misfit_of_another_width(self, diameter_px: float) -> Floats:
        """What a spot that is a little wider misses the fit by at each node, shape (nodes, nodes, 49).

        In parts of each pixel's noise, and of length 1.
        """
        az_px, el_px = _nodes_px()
        narrow, wide = (
            gaussian_shape((1 + step) * diameter_px, az_px, el_px)
            for step in (-_SLOPE_STEP_PX, _SLOPE_STEP_PX)
        )
        change = (wide - narrow)[..., None]
        left = (change - self._terms @ (self.weights @ change))[..., 0] / self._deviation_dn
        return np.asarray(left / np.linalg.norm(left, axis=-1, keepdims=True))

    def _error_between_nodes_px(self, diameter_px: float) -> float:
        """RMS error of a place without noise, along an axis, on the mean of places within a pixel.

        0 if it is below :data:`_EXACT_PX`. Each place is measured from its nearest node. Noise sometimes leads
        to the next node, so the error of a spot narrower than 1.2 px is larger: at 1 px by a fifth.
        """
        points, weights = np.polynomial.legendre.leggauss(3)
        off_az_px, off_el_px = (
            np.stack(np.meshgrid(points, points)).reshape(2, -1) / 2 / STEPS_PER_PX
        )
        az_px, el_px = (place[_PIXEL][..., None] for place in _nodes_px())
        shape = gaussian_shape(diameter_px, az_px + off_az_px, el_px + off_el_px)
        amounts = shape @ self.weights[_PIXEL][:, :, :3].swapaxes(-1, -2)
        flux, az_moment, el_moment = np.moveaxis(amounts, -1, 0)
        square_px2 = (az_moment / flux - off_az_px) ** 2 + (el_moment / flux - off_el_px) ** 2
        # Gauss-Legendre: the weights of nine places add up to 4, and there are two axes.
        mean_px2 = square_px2.mean(axis=(0, 1)) @ np.outer(weights, weights).ravel() / 8
        error_px = math.sqrt(mean_px2)
        return 0.0 if error_px < _EXACT_PX else error_px

    def _variance_dn2(self, light_dn: Floats) -> Floats:
        return self._noise_dn**2 + self._photon_dn * np.maximum(light_dn, 0.0)

    def place(
        self, light_dn: Floats, az_px: float, el_px: float, without: tuple[int, ...] = ()
    ) -> SpotPlace | None:
        """Where the spot is that lies near a place; None if there is none within the window's reach.

        Nor is there one where half of the pixels do not count.

        Parameters
        ----------
        light_dn : array, shape (7, 7)
            Dark subtracted.
        az_px, el_px : float
            Where it was found to be, from the window's centre.
        without : tuple of int, optional
            Pixels that do not count, row by row. A few more that miss the fit by far are left out.
        """
        if len(without) > _MOST_WITHOUT:
            return None
        pixels_dn = light_dn.ravel()
        found = self._converge(pixels_dn, az_px, el_px, without)
        if found is None:
            return None
        if (worst := self._outlier(found)) is not None:
            found, without = self._without_outliers(pixels_dn, found, without, worst)
        left_dn, az_weights, el_weights = found.left_dn, found.weights[1], found.weights[2]
        if self._photon_dn:  # in parts of each pixel's noise
            noise_dn = np.sqrt(self._variance_dn2(self._terms[found.node].dot(found.amounts)))
            left_dn = left_dn / noise_dn
            az_weights, el_weights = az_weights * noise_dn, el_weights * noise_dn
        freedom = pixels_dn.size - len(without) - _AMOUNTS
        scale = math.sqrt(left_dn.dot(left_dn) / freedom) / found.flux_dn
        between_px = self._between_px
        az_sigma_px = math.hypot(scale * math.sqrt(az_weights.dot(az_weights)), between_px)
        el_sigma_px = math.hypot(scale * math.sqrt(el_weights.dot(el_weights)), between_px)
        return SpotPlace(found.az_px, found.el_px, found.flux_dn, az_sigma_px, el_sigma_px)

    def _converge(
        self, pixels_dn: Floats, az_px: float, el_px: float, without: tuple[int, ...]
    ) -> _Solution | None:
        """Two steps from a place; the first may begin half a pixel off, the second ends at the spot."""
        at = -1, -1
        for _ in range(2):
            before, at = at, (node(el_px), node(az_px))
            if at == before:
                break  # with the same weights it would end at the same place
            weights = self._weights_without(at, without) if without else self.weights[at]
            amounts = weights.dot(pixels_dn)
            flux_dn, az_moment, el_moment, _ = amounts.tolist()
            if flux_dn <= 0:
                return None
            az_px = (at[1] - NODES) / STEPS_PER_PX + az_moment / flux_dn
            el_px = (at[0] - NODES) / STEPS_PER_PX + el_moment / flux_dn
        if max(abs(az_px), abs(el_px)) > HALF_WINDOW_PX:
            return None
        left_dn = pixels_dn - self._terms[at].dot(amounts)
        for pixel in without:
            left_dn[pixel] = 0.0
        return _Solution(az_px, el_px, flux_dn, weights, at, amounts, left_dn)

    def _outlier(self, found: _Solution) -> int | None:
        """The pixel that misses the fit by most standard deviations, if by too many."""
        missed = np.abs(found.left_dn * self._missed_per_dn[found.node])
        worst = int(missed.argmax())
        limit_2 = _OUTLIER_SIGMAS**2 * self._expected_2(found)
        return worst if missed.item(worst) ** 2 > limit_2 else None

    def _without_outliers(
        self, pixels_dn: Floats, found: _Solution, without: tuple[int, ...], worst: int | None
    ) -> tuple[_Solution, tuple[int, ...]]:
        """Without the few pixels that spoil a fit; as it was if they are not few, or not outliers."""
        deviations = found.left_dn / self._deviation_dn[found.node]
        misfit = float(deviations.dot(deviations))
        if float(deviations.dot(self._wider[found.node])) ** 2 >= _WIDTH_PART * misfit:
            return found, without  # a spot that is wider or narrower than told
        left_out, fewer = without, found
        expected = pixels_dn.size * self._expected_2(found)
        for _ in _OTHERS_PARTS:
            if worst is None:
                break
            part = _OTHERS_PARTS[len(left_out) - len(without)]
            left_out = (*left_out, worst)
            tried = self._converge(pixels_dn, fewer.az_px, fewer.el_px, left_out)
            if tried is None:
                break
            deviations = tried.left_dn / self._deviation_dn[tried.node]
            left = float(deviations.dot(deviations))
            if left <= max(part * misfit, _OTHERS_TIMES * expected):
                found, without, misfit = tried, left_out, left
            if left <= expected:
                break
            fewer, worst = tried, self._outlier(tried)
        return found, without

    def _expected_2(self, found: _Solution) -> float:
        """What a pixel may miss: its noise, and the steps between nodes; in variances."""
        return 1 + (_INEXACT_PART * found.flux_dn / self._noise_dn) ** 2

    def _leave_out(self, at: tuple[int, int], without: tuple[int, ...]) -> Floats:
        """A node's weights without some pixels, shape (4, 49): as if each of them read what the fit says."""
        weights, pixels = self.weights[at], list(without)
        seen = -self._terms[at][pixels].dot(weights)
        seen[range(len(pixels)), pixels] += 1.0
        return np.asarray(weights - weights[:, pixels].dot(np.linalg.solve(seen[:, pixels], seen)))

    def noise_px(self, flux_dn: float) -> float:
        """One standard deviation of a spot's place along an axis, on the mean of places within a pixel.

        For a narrow spot it includes the error between nodes.
        """
        variance_dn2 = self._variance_dn2(flux_dn * self._terms[*_PIXEL, :, 0])
        variances = np.square(self.weights[*_PIXEL, 1:3]) * variance_dn2[:, :, None, :]
        random_px = math.sqrt(variances.sum(axis=-1).mean()) / flux_dn
        return math.hypot(random_px, self._between_px)


def _make_weights(terms: Floats, deviation_dn: Floats) -> Floats:
    """Factors of the pixels in each term, shape (..., 4, pixels)."""
    scaled = np.linalg.pinv(terms / deviation_dn[..., None])
    return np.asarray(scaled / deviation_dn[..., None, :], dtype=np.float64)


@compilable(inline=True)
def node(place_px: float) -> int:
    """The nearest place that has weights."""
    return min(max(round(place_px * STEPS_PER_PX) + NODES, 0), 2 * NODES)


def spot_fit(
    diameter_px: float, noise_dn: float, flux_dn: float, electrons_per_dn: float | None
) -> SpotFit:
    """One fit for all who ask for the same; see :class:`SpotFit`.

    To make one takes 10 ms. Without photon noise it is the same for any light.
    """
    if electrons_per_dn is None:
        return _remembered(diameter_px, noise_dn, 1.0, math.inf)
    return _remembered(diameter_px, noise_dn, flux_dn, electrons_per_dn)


_remembered = functools.lru_cache(maxsize=8)(SpotFit)
