"""What the camera sees: Gaussian spots, integrated over each pixel, on bias, with pixel noise, 16 bit."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from fitctl.config import Camera, Spot

Floats = NDArray[np.float64]
FULL_WELL_DN = 65535


class Scene:
    """Renders frames of a camera with given spots.

    Parameters
    ----------
    camera : Camera
    spots : sequence of Spot
        Their order is that of the positions given to :meth:`expected`.
    """

    def __init__(self, camera: Camera, spots: Sequence[Spot]) -> None:
        self._shape = (camera.height_px, camera.width_px)
        self._bias_dn = camera.bias_dn
        self._noise_dn = camera.pixel_noise_dn
        self._flux_dn = np.array([spot.flux_dn for spot in spots])
        # The 1/e^2 diameter of a Gaussian is four standard deviations.
        self._sigma_px = np.array([spot.diameter_px / 4 for spot in spots])
        self._edges_x: Floats = np.arange(camera.width_px + 1.0) - 0.5
        self._edges_y: Floats = np.arange(camera.height_px + 1.0) - 0.5

    def expected(self, positions_px: Floats) -> Floats:
        """Noiseless frame, shape (..., height, width), of spots at (..., spots, 2) in (az, el)."""
        across = self._pixel_fractions(self._edges_x, positions_px[..., 0])
        down = self._pixel_fractions(self._edges_y, positions_px[..., 1])
        return self._bias_dn + (down * self._flux_dn[:, None]).swapaxes(-1, -2) @ across

    def frame(self, positions_px: Floats, random: np.random.Generator) -> NDArray[np.uint16]:
        """One frame with pixel noise, shape (height, width), of spots at (spots, 2)."""
        noisy = self.expected(positions_px)
        noisy += self._noise_dn * random.standard_normal(self._shape)
        return np.clip(np.rint(noisy), 0, FULL_WELL_DN).astype(np.uint16)

    def _pixel_fractions(self, edges: Floats, centre_px: Floats) -> Floats:
        """Part of a spot's light that falls on each column (or row), shape (..., spots, pixels)."""
        below = ndtr((edges - centre_px[..., None]) / self._sigma_px[:, None])
        return np.asarray(below[..., 1:] - below[..., :-1])


def centroid_noise_px(camera: Camera, flux_dn: float, window_px: int) -> float:
    """Standard deviation of Eq. 7 over a square window: 14 x 20 / F_total px for 7x7 px."""
    half = window_px // 2
    lever = math.sqrt(window_px * 2 * sum(k * k for k in range(1, half + 1)))
    return lever * camera.pixel_noise_dn / flux_dn
