"""Both encoder counts, dated by the SYNC that latched them, unwrapped, and checked for plausibility.

Each SYNC is answered by one TPDO, in order; counting both dates a late one. A counter is an int32 and
wraps; the sum of its steps does not.
"""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

from fitctl.drivers.cia402.protocol import wrap_int32
from fitctl.drivers.plausibility import MotionCheck, Pair

_MOST_OUTSTANDING = 1000  # the drive's heartbeat is missed long before


class Positions(NamedTuple):
    """Both counters without their wraps, and the host's monotonic time of the SYNC that latched them."""

    time_s: float
    counts: tuple[int, int]


class _Sync(NamedTuple):
    """When a SYNC was sent, and how fast the motors may have turned until then, in counts/s."""

    time_s: float
    possible_counts_s: Pair


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
    motion : MotionCheck
        In counts.
    """

    def __init__(self, fastest_counts_s: float) -> None:
        self._syncs: deque[_Sync] = deque(maxlen=_MOST_OUTSTANDING)
        self.motion = MotionCheck(fastest_counts_s, 1.0)
        self.restart()

    def restart(self) -> None:
        """Nothing is known of the positions: the link is a new one."""
        self._syncs.clear()
        self.motion.restart()
        self._counts: tuple[int, int] | None = None
        self.latched: Positions | None = None

    @property
    def outstanding(self) -> bool:
        """A SYNC has no answer yet."""
        return bool(self._syncs)

    def give_up(self) -> None:
        """The answers that are outstanding will never come."""
        for sync in self._syncs:
            self.motion.miss(sync.possible_counts_s)
        self._syncs.clear()

    def sync_sent(self, time_s: float, commanded_counts_s: Pair | None = None) -> None:
        """Record a SYNC, by the time just before it was sent, and the velocities sent with it.

        Without velocities the motors are without current: anything may turn them.

        The drive latches its encoders at SYNC: not before that time, and as a rule hardly later. The
        time after sending can be long after it, on a machine that is busy.
        """
        self._syncs.append(_Sync(time_s, self.motion.command(time_s, commanded_counts_s)))

    def add(self, raw: tuple[int, int]) -> None:
        """Add the next answer; one without an outstanding SYNC is a copy, and ignored."""
        if not self._syncs:
            return
        az, el = self._counts or raw
        counts = (az + wrap_int32(raw[0] - az), el + wrap_int32(raw[1] - el))
        sync = self._syncs.popleft()
        if self.motion.accept(sync.time_s, time.monotonic(), sync.possible_counts_s, counts):
            self._counts = counts
            self.latched = Positions(sync.time_s, counts)
