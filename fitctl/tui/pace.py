"""How often the console draws: as often as it likes, but not for more than its share of a core."""

from __future__ import annotations

import time
from collections.abc import Callable

SHARE = 0.12
LONGEST_S = 1.0


class Pace:
    """Lets drawing wait while more processor time was used than `SHARE` of the time gone by.

    So a terminal of any size leaves the machine to the loop; a large one is drawn less often, but never
    less than about once in `LONGEST_S`, also where reading the telemetry alone takes the whole share.

    Parameters
    ----------
    clock, processor : callable
        Seconds gone by, and seconds that this process has used.
    """

    def __init__(
        self,
        clock: Callable[[], float] = time.monotonic,
        processor: Callable[[], float] = time.process_time,
    ) -> None:
        self._clock = clock
        self._processor = processor
        self._at_s = clock()
        self._used_s = processor()
        self._owed_s = 0.0
        self._drawn_s = self._at_s

    def due(self) -> bool:
        """Whether something may be drawn now; the caller then draws."""
        now_s, used_s = self._clock(), self._processor()
        self._owed_s += used_s - self._used_s - SHARE * (now_s - self._at_s)
        self._owed_s = min(max(self._owed_s, 0.0), SHARE * LONGEST_S)
        self._at_s, self._used_s = now_s, used_s
        is_due = self._owed_s <= 0.0 or now_s - self._drawn_s >= LONGEST_S
        if is_due:
            self._drawn_s = now_s
        return is_due
