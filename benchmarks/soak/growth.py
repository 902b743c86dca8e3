"""Memory, handles and threads of each process, and how they grow."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
import psutil
from numpy.typing import NDArray
from scipy.stats import theilslopes

SAMPLE_S = 5.0
_WARM_UP_S = 600.0
_WARM_UP_FRACTION = 0.25  # of a life, where that is less
_BLOCKS = 60  # at the most; neighbouring samples are hardly independent, medians of a minute nearly
_BLOCK_S = 60.0
_FEWEST_BLOCKS = 4
QUANTITIES = ("rss_mb", "handles", "threads")


class Growth(NamedTuple):
    """How one quantity of one process went, after its warm-up.

    Attributes
    ----------
    first, last, most : float
        Medians of the first and the last block, and the greatest sample.
    per_hour, low, high : float
        Theil and Sen's slope through the medians of the blocks, with its 95 % interval; NaN where the
        process lived too briefly.
    lived_s : float
        From its first sample to its last.
    """

    first: float
    last: float
    most: float
    per_hour: float
    low: float
    high: float
    lived_s: float


class Samples:
    """What processes use, every few seconds, by their role; a role may have had several processes."""

    def __init__(self) -> None:
        self._rows: dict[str, dict[int, list[tuple[float, ...]]]] = {}
        self._processes: dict[int, psutil.Process] = {}

    def take(self, now_s: float, pids: Mapping[str, int]) -> None:
        """One sample of each; a process that is just ending is left out."""
        for role, pid in pids.items():
            try:
                process = self._processes.setdefault(pid, psutil.Process(pid))
                with process.oneshot():
                    memory = process.memory_info().rss / 1e6
                    row = (now_s, memory, process.num_fds(), process.num_threads())
            except psutil.Error:
                continue
            self._rows.setdefault(role, {}).setdefault(pid, []).append(row)

    def growth(self) -> dict[str, dict[str, Growth]]:
        """By role and quantity, of that process of the role which lived longest."""
        lives = {
            role: np.array(max(by_pid.values(), key=len)) for role, by_pid in self._rows.items()
        }
        return {
            role: {
                name: _growth(rows[:, 0], rows[:, 1 + index])
                for index, name in enumerate(QUANTITIES)
            }
            for role, rows in lives.items()
        }

    def newest(self, role: str) -> float:
        """Memory of a role's newest process in MB; NaN before its first sample."""
        by_pid = self._rows.get(role)
        return list(by_pid.values())[-1][-1][1] if by_pid else math.nan


def _growth(time_s: NDArray[np.float64], value: NDArray[np.float64]) -> Growth:
    """Growth of one quantity; shapes (samples,)."""
    lived_s = float(time_s[-1] - time_s[0])
    late = time_s - time_s[0] >= min(_WARM_UP_S, _WARM_UP_FRACTION * lived_s)
    time_s, value = time_s[late], value[late]
    count = int(min(_BLOCKS, (time_s[-1] - time_s[0]) / _BLOCK_S, len(time_s)))
    blocks = max(count, 1)
    times_s = [np.median(part) for part in np.array_split(time_s, blocks)]
    values = [float(np.median(part)) for part in np.array_split(value, blocks)]
    slope = low = high = math.nan
    if count >= _FEWEST_BLOCKS:
        fit = theilslopes(values, np.array(times_s) / 3600, alpha=0.95)
        slope, low, high = fit.slope, fit.low_slope, fit.high_slope
    return Growth(
        values[0], values[-1], float(value.max()), float(slope), float(low), float(high), lived_s
    )
