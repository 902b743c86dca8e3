"""What the camera sees: Gaussian spots, integrated over each pixel, on bias, with pixel noise, 16 bit."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera, HotPixel, Spot
from fitctl.model.compiled import compilable, compiled, numba_installed
from fitctl.model.image.light import light_below, light_fractions, light_table
from fitctl.model.image.pixel_noise import GOLDEN, QUANTILE_SHIFT, mix, pixel_normals, quantiles

Floats = NDArray[np.float64]


class Scene:
    """Renders frames of a camera with given spots.

    Parameters
    ----------
    camera : Camera
    spots : sequence of Spot
        Their order is that of the positions given to :meth:`expected`.
    hot_pixels : sequence of HotPixel
        They read so much more on every frame.
    instants : int
        Of an exposure: positions are all spots' at the first, then at the next.
    """

    def __init__(
        self,
        camera: Camera,
        spots: Sequence[Spot],
        hot_pixels: Sequence[HotPixel] = (),
        instants: int = 1,
    ) -> None:
        self._shape = (camera.height_px, camera.width_px)
        self._bias_dn = camera.bias_dn
        self._noise_dn = camera.pixel_noise_dn
        self._photon_dn = photon_dn(camera)
        self._full_dn = camera.full_scale_dn
        self._flux_dn = np.array([spot.flux_dn / instants for spot in spots] * instants)
        # The 1/e^2 diameter of a Gaussian is four standard deviations.
        self._sigma_px = np.array([spot.diameter_px / 4 for spot in spots] * instants)
        self._light_dn = np.empty(self._shape)
        self._down, self._across = np.empty(self._shape[0]), np.empty(self._shape[1])
        self._edges_x: Floats = np.arange(camera.width_px + 1.0) - 0.5
        self._edges_y: Floats = np.arange(camera.height_px + 1.0) - 0.5
        self._hot = [(pixel.el_px, pixel.az_px, pixel.dn) for pixel in hot_pixels]

    def expected(self, positions_px: Floats) -> Floats:
        """Noiseless frame, shape (..., height, width), of spots at (..., spots, 2) in (az, el)."""
        across = self._pixel_fractions(self._edges_x, positions_px[..., 0])
        down = self._pixel_fractions(self._edges_y, positions_px[..., 1])
        return self._bias_dn + (down * self._flux_dn[:, None]).swapaxes(-1, -2) @ across

    def frame(
        self, positions_px: Floats, key: int, number: int, noise_dn: float | None = None
    ) -> NDArray[np.uint16]:
        """One frame with pixel noise, shape (height, width), of spots at (spots, 2).

        The noise is that of frame `number` of the run whose key is given
        (:mod:`fitctl.model.image.pixel_noise`); its standard deviation is the camera's, if none is given.
        """
        if not numba_installed():
            return self.frame_reference(positions_px, key, number, noise_dn)
        compiled(render)(
            self._light_dn,
            0,
            0,
            self._shape[1],
            positions_px,
            self._flux_dn,
            self._sigma_px,
            len(self._flux_dn),
            self._bias_dn,
            self._noise_dn if noise_dn is None else noise_dn,
            self._photon_dn,
            self._full_dn,
            np.uint64(key),
            number,
            quantiles(),
            light_table(),
            self._down,
            self._across,
        )
        return self._with_hot_pixels(self._light_dn)

    def frame_reference(
        self, positions_px: Floats, key: int, number: int, noise_dn: float | None = None
    ) -> NDArray[np.uint16]:
        """:meth:`frame` in NumPy; the compiled one is held to this."""
        noise = pixel_normals(key, number, math.prod(self._shape)).reshape(self._shape)
        expected_dn = self.expected(positions_px)
        dark_dn = self._noise_dn if noise_dn is None else noise_dn
        noise_dn2 = dark_dn**2 + self._photon_dn * (expected_dn - self._bias_dn)
        noisy = expected_dn + np.sqrt(noise_dn2) * noise
        return self._with_hot_pixels(np.clip(np.rint(noisy), 0, self._full_dn))

    def _with_hot_pixels(self, read_dn: Floats) -> NDArray[np.uint16]:
        for row, column, dn in self._hot:
            read_dn[row, column] = min(round(read_dn[row, column] + dn), self._full_dn)
        return read_dn.astype(np.uint16)

    def _pixel_fractions(self, edges: Floats, centre_px: Floats) -> Floats:
        """Part of a spot's light that falls on each column (or row), shape (..., spots, pixels)."""
        below = light_below((edges - centre_px[..., None]) / self._sigma_px[:, None])
        return np.asarray(below[..., 1:] - below[..., :-1])


@compilable(inline=True)
def render(
    light_dn: Floats,
    first_row: int,
    first_column: int,
    width_px: int,
    positions_px: Floats,
    flux_dn: Floats,
    sigma_px: Floats,
    spots: int,
    bias_dn: float,
    noise_dn: float,
    photon_dn: float,
    full_dn: float,
    key: Any,
    number: int,
    table: Floats,
    light: Floats,
    down: Floats,
    across: Floats,
) -> None:
    """:meth:`Scene.frame`, or a part of it, whole numbers into `light_dn`.

    A spot at NaN is left out. Where photons have noise, it is taken for normal: from some ten electrons on it
    is, and fewer are lost in a camera's own noise. `down` and `across` are room for a column and a row.
    """
    rows, columns = light_dn.shape
    for row in range(rows):
        for column in range(columns):
            light_dn[row, column] = bias_dn
    for spot in range(spots):
        az_px, el_px = positions_px[spot, 0], positions_px[spot, 1]
        if math.isnan(az_px):
            continue
        left, right = light_fractions(first_column, az_px, sigma_px[spot], light, across)
        if left >= right:
            continue
        top, bottom = light_fractions(first_row, el_px, sigma_px[spot], light, down)
        for row in range(top, bottom):
            row_dn = flux_dn[spot] * down[row]
            for column in range(left, right):
                light_dn[row, column] += row_dn * across[column]
    frame = mix(key + np.uint64(number) * GOLDEN)
    for row in range(rows):
        pixel = (first_row + row) * width_px + first_column + 1
        for column in range(columns):
            bits = mix(frame + np.uint64(pixel + column) * GOLDEN)
            deviation_dn = noise_dn
            if photon_dn > 0:
                deviation_dn = math.sqrt(
                    noise_dn**2 + photon_dn * (light_dn[row, column] - bias_dn)
                )
            noisy = light_dn[row, column] + deviation_dn * table[bits >> QUANTILE_SHIFT]
            light_dn[row, column] = min(max(np.rint(noisy), 0.0), full_dn)


def photon_dn(camera: Camera) -> float:
    """What one electron reads, in DN; 0 where photons are taken to have no noise."""
    return 0.0 if camera.electrons_per_dn is None else 1 / camera.electrons_per_dn
