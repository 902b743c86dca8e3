"""The coarse loop: an integrator from focal-plane error to siderostat motor angle."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class CoarseIntegrator:
    """Motor set-point that moves at `gain` times the error, against it.

    Parameters
    ----------
    gain_rad_per_m : float
        k of Table 1: motor rad/s per metre of focal plane; 3227 gives 0.074 Hz.
    pixel_size_m, period_s : float
    """

    def __init__(self, gain_rad_per_m: float, pixel_size_m: float, period_s: float) -> None:
        self._step_rad_per_px = gain_rad_per_m * pixel_size_m * period_s
        self.setpoint_rad = np.zeros(2)

    def reset(self, setpoint_rad: Floats) -> None:
        """Start from `setpoint_rad`, shape (2,)."""
        self.setpoint_rad = np.array(setpoint_rad, dtype=float)

    def step(self, error_px: Floats) -> Floats:
        """One period with `error_px` (star less target), shape (2,); returns the set-point."""
        self.setpoint_rad = self.setpoint_rad - self._step_rad_per_px * error_px
        return self.setpoint_rad
