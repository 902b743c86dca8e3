"""Estimates with how well they are known."""

from __future__ import annotations

import math
from typing import NamedTuple

Z_95 = 1.96


class Interval(NamedTuple):
    """An estimate and its 95 % confidence interval."""

    value: float
    low: float
    high: float

    def covers(self, truth: float) -> bool:
        """Whether the interval holds a value."""
        return self.low <= truth <= self.high

    def __str__(self) -> str:
        return f"{self.value:.4g} (95 %: {self.low:.4g} to {self.high:.4g})"


def of_logarithm(log: float, deviation: float) -> Interval:
    """Of a quantity whose logarithm is nearly normal: its error is a factor, not a difference."""
    half = Z_95 * min(deviation, 50.0)
    return Interval(math.exp(log), math.exp(log - half), math.exp(log + half))
