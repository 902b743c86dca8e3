"""A loop's ticks of the last minute as one array, which grows as it must and is cut as it may."""

from __future__ import annotations

import operator

import numpy as np
from numpy.typing import NDArray

from fitctl.logging.records import Tick

Floats = NDArray[np.float64]

KEPT_S = 60.0
FIELDS = (
    "time_s",
    "error_az_px",
    "error_el_px",
    "fsm_az_rad",
    "fsm_el_rad",
    "frame_age_s",
    "compute_s",
    "sense_s",
    "decide_s",
)
_VALUES = operator.attrgetter(*FIELDS)
_COLUMN = {name: column for column, name in enumerate(FIELDS)}
_FIRST_ROWS = 4096


class Past:
    """The fields named in `FIELDS` of each tick, oldest first."""

    def __init__(self) -> None:
        self._rows: Floats = np.empty((_FIRST_ROWS, len(FIELDS)))
        self._first = self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    def add(self, ticks: list[Tick], now_s: float) -> None:
        """Take some ticks, and let go of what is older than `KEPT_S` at `now_s`."""
        for tick in ticks:
            if self._end == len(self._rows):
                self._make_room()
            self._rows[self._end] = _VALUES(tick)
            self._end += 1
        self._first += int(self._since(now_s - KEPT_S))

    def since(self, time_s: float, *fields: str) -> Floats:
        """Rows from a time on, shape (n, fields); a copy."""
        first = self._first + self._since(time_s)
        return self._rows[first : self._end, [_COLUMN[name] for name in fields]]

    def _since(self, time_s: float) -> np.intp:
        return np.searchsorted(self._rows[self._first : self._end, 0], time_s)

    def _make_room(self) -> None:
        kept = self._rows[self._first : self._end]
        if 2 * len(kept) > len(self._rows):
            self._rows = np.empty((2 * len(self._rows), len(FIELDS)))
        self._rows[: len(kept)] = kept
        self._first, self._end = 0, len(kept)
