"""How a Gaussian spot's light is shared out among pixels, by a table that all who render use alike."""

from __future__ import annotations

import functools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]
REACH_SIGMAS = 8.5  # beyond lies a part of the light in 1e17
PER_SIGMA = 32


@functools.cache
def light_table() -> Floats:
    """Cubics for the part of the light below an edge, shape (intervals, 4), highest power first.

    Hermite's, from the normal distribution and its density at intervals of 1/32 standard deviation
    over +-8.5: right to 4e-9 of the light, 1e-4 DN of a star, and three times as quick as an error function.
    """
    knots = np.arange(-REACH_SIGMAS, REACH_SIGMAS + 0.5 / PER_SIGMA, 1 / PER_SIGMA)
    # The error function of math: the supervisor, which subtracts light, imports no scipy.
    value = np.array([math.erfc(-knot / math.sqrt(2)) / 2 for knot in knots])
    rise = np.exp(-(knots**2) / 2) / np.sqrt(2 * np.pi) / PER_SIGMA
    step = np.diff(value)
    cubics = np.column_stack(
        [
            rise[:-1] + rise[1:] - 2 * step,
            3 * step - 2 * rise[:-1] - rise[1:],
            rise[:-1],
            value[:-1],
        ]
    )
    cubics.flags.writeable = False
    return cubics


def light_below(distance_sigmas: Floats) -> Floats:
    """Part of a spot's light below edges at some distance from its centre."""
    table = light_table()
    # np.clip and np.moveaxis would take longer than all the rest.
    within = np.minimum(np.maximum(distance_sigmas, -REACH_SIGMAS), REACH_SIGMAS)
    place = (within + REACH_SIGMAS) * PER_SIGMA
    interval = np.minimum(place.astype(int), len(table) - 1)
    x = place - interval
    cubic = table[interval]
    return np.asarray(((cubic[..., 0] * x + cubic[..., 1]) * x + cubic[..., 2]) * x + cubic[..., 3])


@compilable(inline=True)
def light_fractions(
    first: int, centre_px: float, sigma_px: float, table: Floats, fraction: Floats
) -> Any:
    """Part of a spot's light on pixels ``first + k``; returns the first and the end of those that get any.

    :func:`light_below` at the edges, one after the other.
    """
    reach_px = REACH_SIGMAS * sigma_px
    low = max(0, math.ceil(centre_px - reach_px - 0.5) - first)
    high = min(len(fraction), math.floor(centre_px + reach_px + 0.5) - first + 1)
    below = 0.0
    for edge in range(low, high + 1):
        distance = (first + edge - 0.5 - centre_px) / sigma_px
        place = (min(max(distance, -REACH_SIGMAS), REACH_SIGMAS) + REACH_SIGMAS) * PER_SIGMA
        interval = min(int(place), len(table) - 1)
        x = place - interval
        c3, c2, c1, c0 = (
            table[interval, 0], table[interval, 1], table[interval, 2], table[interval, 3],
        )  # fmt: skip
        above = ((c3 * x + c2) * x + c1) * x + c0
        if edge > low:
            fraction[edge - 1] = above - below
        below = above
    return low, max(low, high)


def centroid_noise_px(
    camera: Camera, flux_dn: float, window_px: int, diameter_px: float = math.nan
) -> float:
    """Standard deviation of Eq. 7 over a square window: 14 x 20 / F_total px for 7x7 px.

    Where the camera's photons have noise, a spot of this 1/e^2 diameter adds its own, on the mean of its
    places within a pixel: the second moment of its light about the window's centre.
    """
    half = window_px // 2
    lever_px2 = window_px * 2 * sum(k * k for k in range(1, half + 1))
    variance_px2 = lever_px2 * (camera.pixel_noise_dn / flux_dn) ** 2
    if camera.electrons_per_dn is not None:
        # Width, the pixel's own, and how far the middle of the window is from the spot.
        moment_px2 = (diameter_px / 4) ** 2 + 1 / 12 + 1 / 12
        variance_px2 += moment_px2 / (camera.electrons_per_dn * flux_dn)
    return math.sqrt(variance_px2)
