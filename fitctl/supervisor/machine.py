"""The computer under the instrument: its disk, its clocks, and whether the recorder keeps up."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

_SURE_S = 0.001  # two clocks read within this time are read together


def free_bytes(folder: Path) -> int:
    """Room for ordinary users where `folder` is."""
    return shutil.disk_usage(folder).free


def wall_minus_monotonic_s(
    wall: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic
) -> float | None:
    """Difference of the clocks; None when we were interrupted between reading them."""
    before_s = monotonic()
    wall_s = wall()
    after_s = monotonic()
    return wall_s - (before_s + after_s) / 2 if after_s - before_s < _SURE_S else None


class Machine:
    """Measures what interlocks judge of the computer.

    Parameters
    ----------
    folder : Path
        Where the log is written.
    backlog : callable
        Part of the record queue that is taken.
    measured : callable
        Takes a quantity's name and its value.
    """

    def __init__(
        self,
        folder: Path,
        backlog: Callable[[], float],
        measured: Callable[[str, float], None],
    ) -> None:
        self._folder = folder
        self._backlog = backlog
        self._measured = measured
        self._difference_s = wall_minus_monotonic_s()

    def look(self) -> None:
        """Measure; called about once a second, on a thread that may wait for a disk."""
        self._measured("recorder_backlog_fraction", self._backlog())
        before_s, now_s = self._difference_s, wall_minus_monotonic_s()
        if before_s is not None and now_s is not None:
            self._measured("clock_step_s", now_s - before_s)
        self._difference_s = now_s if now_s is not None else before_s
        self._measured("disk_free_bytes", float(free_bytes(self._folder)))
