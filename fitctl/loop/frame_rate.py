"""Whether frames come at the rig file's rate: a short change of it tells vibrations from their aliases."""

from __future__ import annotations

import math
import statistics
from collections import deque

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
OTHER_RATE = 0.015
"""Of the frame period: from so much on, frames come at another rate. Cameras keep theirs to a thousandth."""
MEDIAN_OF = 15
"""Intervals whose median counts: a missing frame, or one that is dated wrongly, is no other rate."""


def off_grid(apart: Floats) -> Floats:
    """By how much frames are later than multiples of the frame period, all in frame periods, shape as given."""
    return np.asarray(apart - np.maximum(1.0, np.rint(apart)))


class RateWatch:
    """Whether the last frames came at another rate.

    Parameters
    ----------
    period_s : float
        Of frames, by the rig file.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._last_s = math.nan
        self._off: deque[float] = deque(maxlen=MEDIAN_OF)

    def is_other(self, exposed_s: float) -> bool:
        """Take the next frame's mid-exposure; whether frames come at another rate now."""
        apart = (exposed_s - self._last_s) / self._period_s
        self._last_s = exposed_s
        if not math.isnan(apart):
            self._off.append(apart - max(1, round(apart)))
        return bool(self._off) and abs(statistics.median(self._off)) > OTHER_RATE
