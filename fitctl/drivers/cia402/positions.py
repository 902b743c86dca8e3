"""Both encoder counts, dated by the SYNC that latched it, unwrapped, and held against what motors can do.

Each SYNC is answered by one TPDO, in order; counting both dates a late one. A counter is an int32 and
wraps; the sum of its steps does not. A step larger than the motor can have made since the last reading, at
the velocities that it was commanded, is kept back: the next reading shows whether it was false or the encoder
has jumped.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from fitctl.drivers.amplifiers import AXES
from fitctl.drivers.cia402.protocol import wrap_int32

_SPEED_MARGIN = 1.25  # over the motor's velocity limit, and over what was commanded
_UNCOMMANDED_PART = 0.05  # of the velocity limit: what a motor may do beside its command (choice)
_SLOWING_S = 0.05  # time constant in which a motor may still have an earlier, higher speed (choice)
_MARGIN_COUNTS = 2  # two roundings
_MOST_OUTSTANDING = 1000  # the drive's heartbeat is missed long before


class Positions(NamedTuple):
    """Both counters without their wraps, and the host's monotonic time of the SYNC that latched them."""

    time_s: float
    counts: tuple[int, ...]


Pair = tuple[float, float]


class _Sync(NamedTuple):
    """When a SYNC was sent, and how fast the motors may have turned until then, in counts/s."""

    time_s: float
    possible_counts_s: Pair


def _faster(one: Pair, other: Pair) -> Pair:
    return max(one[0], other[0]), max(one[1], other[1])


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
        self._fastest_counts_s = fastest_counts_s
        self._syncs: deque[_Sync] = deque(maxlen=_MOST_OUTSTANDING)
        self.restart()

    def restart(self) -> None:
        """Nothing is known of the positions: the link is a new one."""
        self._syncs.clear()
        fastest = (self._fastest_counts_s, self._fastest_counts_s)
        self._commanded = self._possible = self._since_last = fastest
        self._sync_s = -math.inf
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
        return bool(self._syncs)

    def give_up(self) -> None:
        """The answers that are outstanding will never come."""
        for sync in self._syncs:
            self._since_last = _faster(self._since_last, sync.possible_counts_s)
        self._syncs.clear()

    def sync_sent(self, time_s: float, commanded_counts_s: Sequence[float] | None = None) -> None:
        """Record a SYNC, by the time just before it was sent, and the velocities sent with it.

        Without velocities the motors are without current: anything may turn them.

        The drive latches its encoders at SYNC: not before that time, and as a rule hardly later. The
        time after sending can be long after it, on a machine that is busy.
        """
        before, fastest = self._commanded, self._fastest_counts_s
        self._commanded = (
            (fastest, fastest)
            if commanded_counts_s is None
            else (abs(commanded_counts_s[0]), abs(commanded_counts_s[1]))
        )
        left = math.exp((self._sync_s - time_s) / _SLOWING_S)
        slowing = (left * self._possible[0], left * self._possible[1])
        # Until now the motors had the command before; only from now on they slow down from it.
        self._possible = _faster(_faster(self._commanded, before), slowing)
        self._sync_s = time_s
        self._syncs.append(_Sync(time_s, self._possible))

    def add(self, raw: tuple[int, int]) -> None:
        """Add the next answer; one without an outstanding SYNC is a copy, and ignored."""
        if not self._syncs:
            return
        last = self._last
        old = last.counts if last else raw
        counts = tuple(o + wrap_int32(n - o) for o, n in zip(old, raw, strict=True))
        sync = self._syncs.popleft()
        positions = Positions(sync.time_s, counts)
        self._since_last = _faster(self._since_last, sync.possible_counts_s)
        if last and not self._can_follow(last, positions):
            if not self._suspect or not self._can_follow(self._suspect, positions):
                self._suspect = positions
                return
            self.jumped = self._jump(last, positions)
        self._suspect = None
        self._last = self.latched = positions
        self._since_last = sync.possible_counts_s

    def _can_follow(self, earlier: Positions, later: Positions) -> bool:
        """Whether the motors can have made this step.

        At most, they had the time from the sending of the earlier SYNC to now, and the highest velocity
        commanded since.
        """
        elapsed_s = time.monotonic() - earlier.time_s
        uncommanded_counts_s = _UNCOMMANDED_PART * self._fastest_counts_s
        for before, after, possible in zip(
            earlier.counts, later.counts, self._since_last, strict=True
        ):
            fastest = min(self._fastest_counts_s, possible + uncommanded_counts_s)
            if abs(after - before) > _SPEED_MARGIN * fastest * elapsed_s + _MARGIN_COUNTS:
                return False
        return True

    def _jump(self, last: Positions, now: Positions) -> str:
        steps = zip(AXES, last.counts, now.counts, strict=True)
        return ", ".join(
            f"{axis} moved by {after - before} counts" for axis, before, after in steps
        )
