"""The filter on commanded beam angle: second order, critically damped, both axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Prefilter:
    """1 / (tau s + 1)^2, stepped exactly for a command that is constant over the period.

    Parameters
    ----------
    time_constant_s, period_s : float
    initial_px : array, shape (2,)
    """

    def __init__(self, time_constant_s: float, period_s: float, initial_px: Floats) -> None:
        x = period_s / time_constant_s
        decay = math.exp(-x)
        # Distance to the command and its rate (in units of tau) of a critically damped approach.
        self._transition = decay * np.array([[1 + x, x], [-x, 1 - x]])
        self.reset(initial_px)

    def reset(self, value_px: Floats) -> None:
        """Rest at `value_px`, shape (2,)."""
        self.value_px = np.array(value_px, dtype=float)
        self._rate = np.zeros_like(self.value_px)

    def step(self, command_px: Floats) -> Floats:
        """Go on by one period; returns the filtered command, shape (2,)."""
        distance = self.value_px - command_px
        self.value_px, self._rate = (
            command_px + self._transition[0, 0] * distance + self._transition[0, 1] * self._rate,
            self._transition[1, 0] * distance + self._transition[1, 1] * self._rate,
        )
        return self.value_px
