"""The vernier loop: the compensator of Eq. 20 with the deadzone feedback of Fig. 10."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray

from fitctl.model.optics import saturate_diamond

Floats = NDArray[np.float64]

EQ20_GAIN = 18.3
EQ20_ZEROS = (25.0, 4.5, 0.5)
EQ20_ZERO_PAIRS = ((5.5, 37.2), (5.98, 39.5))
EQ20_POLES = (15.6, 4.4, 1.2, 0.44)
EQ20_POLE_PAIRS = ((5.9, 39.1), (3.8, 39.9))


def _roots(real: tuple[float, ...], pairs: tuple[tuple[float, float], ...]) -> Floats:
    return np.concatenate([[-r for r in real], *(np.roots([1.0, *pair]) for pair in pairs)])


def eq20_zpk() -> tuple[Floats, Floats, float]:
    """Zeros, poles (rad/s) and gain of Eq. 20; its gain at rest is 26.75."""
    return _roots(EQ20_ZEROS, EQ20_ZERO_PAIRS), _roots(EQ20_POLES, EQ20_POLE_PAIRS), EQ20_GAIN


@functools.cache
def eq20_discrete(period_s: float) -> tuple[Floats, Floats, Floats, float]:
    """Eq. 20 by Tustin at the loop's period: A (8, 8), B (8,), C (8,), D."""
    import control  # a second of import, and only the loop needs it

    zeros, poles, gain = eq20_zpk()
    continuous = control.ss(control.zpk(zeros, poles, gain))
    discrete = control.sample_system(continuous, period_s, method="bilinear")
    return (
        np.ascontiguousarray(discrete.A),
        np.ascontiguousarray(discrete.B[:, 0]),
        np.ascontiguousarray(discrete.C[0]),
        float(discrete.D[0, 0]),
    )


class Vernier:
    """Both axes' compensators, from error in pixels to mirror angle in radians.

    Once the wanted mirror angle leaves the diamond of what the stacks reach, the excess is added to the
    error, much as it would have shown had the mirror followed (a frame later, where the camera takes
    nearly two): the compensator sees a mirror without limits and does not wind up.

    Parameters
    ----------
    period_s : float
        Loop period.
    mirror_px_per_rad : float
        How far the mirror moves the star.
    range_rad : float
        phi_max: |az| + |el| of the mirror.
    """

    def __init__(self, period_s: float, mirror_px_per_rad: float, range_rad: float) -> None:
        self._a, self._b, self._c, self._d = eq20_discrete(period_s)
        self._mirror_px_per_rad = mirror_px_per_rad
        self._range_rad = range_rad
        self.reset()

    def reset(self) -> None:
        """Forget everything; the mirror starts from its bias."""
        self._state = np.zeros((2, self._b.size))
        self._excess_px = np.zeros(2)
        self.saturated = False

    def step(self, error_px: Floats) -> Floats:
        """One period with `error_px` (star less target), shape (2,); returns mirror angles, shape (2,)."""
        seen_px = error_px + self._excess_px
        wanted_px = -(self._state @ self._c + self._d * seen_px)
        self._state = self._state @ self._a.T + seen_px[:, None] * self._b
        mirror_rad = saturate_diamond(wanted_px / self._mirror_px_per_rad, self._range_rad)
        self._excess_px = wanted_px - mirror_rad * self._mirror_px_per_rad
        self.saturated = bool((np.abs(self._excess_px) > 1e-9).any())
        return mirror_rad
