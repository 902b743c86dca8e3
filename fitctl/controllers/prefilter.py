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
        # Of a critically damped approach: distance to the command and its rate (in units of tau).
        self._transition = decay * np.array([[1 + x, x], [-x, 1 - x]])
        self.reset(initial_px)

    def reset(self, value_px: Floats) -> None:
        """Rest at `value_px`, shape (2,)."""
        self.value_px = np.array(value_px, dtype=float)
        self._approach = np.zeros((2, 2))

    def step(self, command_px: Floats) -> Floats:
        """Go on by one period; returns the filtered command, shape (2,)."""
        self._approach[0] = self.value_px - command_px
        self._approach = self._transition.dot(self._approach)  # `@` takes twice as long
        self.value_px = command_px + self._approach[0]
        return self.value_px
