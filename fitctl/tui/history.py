"""The last minute of a loop's ticks as one array, which grows as needed and drops what is too old."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

KEPT_S = 60.0
_FIRST_ROWS = 4096


class Past:
    """Named numbers of each tick, oldest first.

    Parameters
    ----------
    fields : sequence of str
        Names of the columns. The first is `time_s`.
    """

    def __init__(self, fields: Sequence[str]) -> None:
        self._column = {name: column for column, name in enumerate(fields)}
        self._rows: Floats = np.empty((_FIRST_ROWS, len(fields)))
        self._first = self._end = 0

    def __len__(self) -> int:
        return self._end - self._first

    @property
    def newest_s(self) -> float:
        """Time of the newest row; 0.0 without any."""
        return float(self._rows[self._end - 1, 0]) if len(self) else 0.0

    def add(self, rows: Iterable[Sequence[float]], now_s: float) -> None:
        """Append rows, and drop those that are older than `KEPT_S` at `now_s`."""
        for row in rows:
            if self._end == len(self._rows):
                self._make_room()
            self._rows[self._end] = row
            self._end += 1
        self._first += int(self._since(now_s - KEPT_S))

    def since(self, time_s: float, *fields: str) -> Floats:
        """Rows from a time on, shape (n, fields); a copy."""
        first = self._first + self._since(time_s)
        return self._rows[first : self._end, [self._column[name] for name in fields]]

    def _since(self, time_s: float) -> np.intp:
        return np.searchsorted(self._rows[self._first : self._end, 0], time_s)

    def _make_room(self) -> None:
        kept = self._rows[self._first : self._end]
        if 2 * len(kept) > len(self._rows):
            self._rows = np.empty((2 * len(self._rows), self._rows.shape[1]))
        self._rows[: len(kept)] = kept
        self._first, self._end = 0, len(kept)
