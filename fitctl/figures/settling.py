"""How a loop settles after a step: from true positions, or from a log's ticks."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class Settling(NamedTuple):
    """What followed a step.

    Attributes
    ----------
    settled_s : float
        From the step until the star stays within the tolerance; nan if it never does.
    overshoot_px : float
        Largest distance beyond the target on the step's far side; 0 if it never got there.
    """

    settled_s: float
    overshoot_px: float


def settling(time_s: Floats, distance_px: Floats, stepped_s: float, within_px: float) -> Settling:
    """Settling of one axis.

    Parameters
    ----------
    time_s, distance_px : arrays, shape (n,)
        Star less where it shall come to rest; NaN where it was not seen.
    stepped_s, within_px : float
    """
    after = (time_s >= stepped_s) & np.isfinite(distance_px)
    since_s, distance_px = time_s[after] - stepped_s, distance_px[after]
    if len(distance_px) == 0:
        return Settling(math.nan, math.nan)
    settled_s = _last_left_s(since_s, np.abs(distance_px) > within_px)
    side = np.sign(distance_px[np.argmax(np.abs(distance_px))])
    return Settling(settled_s, float(max(0.0, (-side * distance_px).max())))


def decayed_s(time_s: Floats, value: Floats, stepped_s: float, part: float) -> float:
    """From a step until a value stays below a part of the largest that it had since; nan if never."""
    after = time_s >= stepped_s
    size = np.abs(value[after])
    return _last_left_s(time_s[after] - stepped_s, size > part * size.max())


def _last_left_s(since_s: Floats, outside: NDArray[np.bool_]) -> float:
    """The first time from which on nothing is outside; 0 if nothing ever was, nan if the last still is."""
    rows = np.flatnonzero(outside)
    if len(rows) == 0:
        return 0.0
    return math.nan if rows[-1] == len(since_s) - 1 else float(since_s[rows[-1] + 1])
