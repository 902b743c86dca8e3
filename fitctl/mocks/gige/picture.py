"""What the sensor makes of the light: faults of star and sensor, gain, and the pixel's format."""

from __future__ import annotations

import math
import time

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera
from fitctl.drivers.gige.protocol import PixelFormat
from fitctl.mocks.faults import FaultKind, Faults

FULL_SCALE_DN = 65535
_HALVING_MIN_S = 1e-3
HOT_PIXEL = (0.25, 0.75)  # its place on the sensor, across and down, in parts of its size

PICTURE_FAULTS = {
    "star_fading": FaultKind("starlight halves again and again, with this half-life", "s", 1.0),
    "star_dim": FaultKind("only this part of the starlight remains", "of its light", 0.7),
    "dark_half": FaultKind("one half of the sensor gets no light", parts=("left", "right")),
    "star_jump": FaultKind("the whole picture moves by this along both axes", "px", 4.0),
    "star_double": FaultKind("all light appears a second time, this far away along az", "px", 8.0),
    "background_jump": FaultKind("every pixel reads this much more", "DN", 2000.0),
    "hot_pixel": FaultKind("one pixel reads this much more", "DN", 20000.0),
    "saturation": FaultKind("no pixel exceeds this value", "DN", 3000.0),
}


class Sensor:
    """The image as the sensor gives it.

    Parameters
    ----------
    camera : Camera
        Its bias is what remains without light; its pixel noise stays when the light fades.
    faults : Faults
    """

    def __init__(self, camera: Camera, faults: Faults) -> None:
        self._camera = camera
        self._faults = faults
        self._fading_since_s = 0.0
        self._random = np.random.default_rng(0)
        faults.on_change(self._note)

    def expose(self, image: NDArray[np.uint16], host_s: float) -> NDArray[np.uint16]:
        """The rendered image of a host time with the active faults applied."""
        values = {kind: self._faults.value(kind) for kind in PICTURE_FAULTS}
        middle = image.shape[1] // 2
        halves = {"left": np.s_[:, :middle], "right": np.s_[:, middle:]}
        dark = [half for half in halves if self._faults.value("dark_half", half) is not None]
        if not dark and all(value is None for value in values.values()):
            return image
        dn = image.astype(float)
        for half in dark:
            dn[halves[half]] = self._faded(dn[halves[half]], 0.0)
        halving_s = values["star_fading"]
        if halving_s is not None:
            fading_s = max(0.0, host_s - self._fading_since_s)
            dn = self._faded(dn, 0.5 ** (fading_s / max(halving_s, _HALVING_MIN_S)))
        dim = values["star_dim"]
        if dim is not None:
            dn = self._faded(dn, min(max(dim, 0.0), 1.0))
        jump_px = values["star_jump"]
        if jump_px is not None:
            dn = self._displaced(dn, round(jump_px), round(jump_px))
        double_px = values["star_double"]
        if double_px is not None:
            dn += self._displaced(dn, 0, round(double_px)) - self._camera.bias_dn
        dn += values["background_jump"] or 0.0
        across, down = HOT_PIXEL
        height_px, width_px = image.shape
        dn[int(down * height_px), int(across * width_px)] += values["hot_pixel"] or 0.0
        most_dn = values["saturation"]
        full_dn = FULL_SCALE_DN if most_dn is None else most_dn
        return np.clip(np.minimum(np.rint(dn), full_dn), 0, FULL_SCALE_DN).astype(np.uint16)

    def _faded(self, dn: NDArray[np.float64], left: float) -> NDArray[np.float64]:
        """Part of the light is left, and all of the noise."""
        bias_dn, noise_dn = self._camera.bias_dn, self._camera.pixel_noise_dn
        noise = self._random.standard_normal(dn.shape)
        return bias_dn + left * (dn - bias_dn) + noise_dn * math.sqrt(1 - left**2) * noise

    def _displaced(self, dn: NDArray[np.float64], down: int, across: int) -> NDArray[np.float64]:
        """Moved by whole pixels; what comes in from outside is dark."""
        camera, (height, width) = self._camera, dn.shape
        moved = camera.bias_dn + camera.pixel_noise_dn * self._random.standard_normal(dn.shape)
        rows, columns = np.arange(height) - down, np.arange(width) - across
        inside_rows = (rows >= 0) & (rows < height)
        inside_columns = (columns >= 0) & (columns < width)
        moved[np.ix_(inside_rows, inside_columns)] = dn[
            np.ix_(rows[inside_rows], columns[inside_columns])
        ]
        return moved

    def _note(self, kind: str) -> None:
        if kind == "star_fading":
            self._fading_since_s = time.monotonic()


def pixels(image: NDArray[np.uint16], gain_db: float, pixel_format: PixelFormat) -> bytes:
    """An image as it is sent: amplified, clipped, and cut to the format's most significant bits."""
    if gain_db:
        amplified = image * 10 ** (gain_db / 20)
        image = np.clip(np.rint(amplified), 0, FULL_SCALE_DN).astype(np.uint16)
    return (image >> (16 - pixel_format.bits)).astype(f"<u{pixel_format.bytes}").tobytes()
