"""Both encoder counts, dated by the SYNC that latched it, unwrapped, and held against what motors can do.

Each SYNC is answered by one TPDO, in order; counting both dates a late one. A counter is an int32 and
wraps; the sum of its steps does not. A step larger than the motor can have made since the last reading is
kept back: the next reading shows whether it was false or the encoder has jumped.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

from fitctl.drivers.amplifiers import AXES
from fitctl.drivers.cia402.protocol import wrap_int32

_SPEED_MARGIN = 1.25  # over the motor's velocity limit
_MARGIN_COUNTS = 2  # two roundings
_MOST_OUTSTANDING = 1000  # the drive's heartbeat is missed long before


class Positions(NamedTuple):
    """Both counters without their wraps, and the host's monotonic time of the SYNC that latched them."""

    time_s: float
    counts: tuple[int, ...]


class Encoders:
    """Both encoders, reading by reading.

    Parameters
    ----------
    fastest_counts_s : float
        The motors' velocity limit.

    Attributes
    ----------
    latched : Positions or None
        The newest, until taken away.
    jumped : str
        Empty, or which encoders made a jump that no motor could; until :meth:`trust`.
    """

    def __init__(self, fastest_counts_s: float) -> None:
        self._fastest_counts_s = _SPEED_MARGIN * fastest_counts_s
        self._syncs_s: deque[float] = deque(maxlen=_MOST_OUTSTANDING)
        self.restart()

    def restart(self) -> None:
        """Nothing is known of the positions: the link is a new one."""
        self._syncs_s.clear()
        self._last: Positions | None = None
        self._suspect: Positions | None = None
        self.latched: Positions | None = None
        self.jumped = ""

    def trust(self) -> None:
        """Accept the positions as they are after a jump."""
        self.jumped = ""

    @property
    def outstanding(self) -> bool:
        """A SYNC has no answer yet."""
        return bool(self._syncs_s)

    def give_up(self) -> None:
        """The answers that are outstanding will never come."""
        self._syncs_s.clear()

    def sync_sent(self, time_s: float) -> None:
        """Record a SYNC, by the time just before it was sent.

        The drive latches its encoders at SYNC: not before that time, and as a rule hardly later. The
        time after sending can be long after it, on a machine that is busy.
        """
        self._syncs_s.append(time_s)

    def add(self, raw: tuple[int, int]) -> None:
        """Add the next answer; one without an outstanding SYNC is a copy, and ignored."""
        if not self._syncs_s:
            return
        last = self._last
        old = last.counts if last else raw
        counts = tuple(o + wrap_int32(n - o) for o, n in zip(old, raw, strict=True))
        positions = Positions(self._syncs_s.popleft(), counts)
        if last and not self._can_follow(last, positions):
            if not self._suspect or not self._can_follow(self._suspect, positions):
                self._suspect = positions
                return
            self.jumped = self._jump(last, positions)
        self._suspect = None
        self._last = self.latched = positions

    def _can_follow(self, earlier: Positions, later: Positions) -> bool:
        """Whether the motors can have made this step.

        At most, they had the time from the sending of the earlier SYNC to now.
        """
        elapsed_s = time.monotonic() - earlier.time_s
        reach_counts = self._fastest_counts_s * elapsed_s + _MARGIN_COUNTS
        steps = zip(earlier.counts, later.counts, strict=True)
        return all(abs(after - before) <= reach_counts for before, after in steps)

    def _jump(self, last: Positions, now: Positions) -> str:
        steps = zip(AXES, last.counts, now.counts, strict=True)
        return ", ".join(
            f"{axis} moved by {after - before} counts" for axis, before, after in steps
        )
