"""Encoder readings, compared with how far the motors can have turned since the last one.

A checksum covers a link, never an encoder, its cable or its counter; an ASCII answer has none at all. A
reading that is further away than the commanded velocities allow is dropped; the next reading shows whether it
was false, or the encoder has jumped.
"""

from __future__ import annotations

import math
from typing import NamedTuple

SPEED_MARGIN = 1.25
"""Factor on a commanded velocity, and on the velocity limit: gain errors of amplifiers, overshoot (choice)."""
_UNCOMMANDED_PART = 0.05  # of the velocity limit: what a motor may do beside its command (choice)
_SLOWING_S = 0.05  # time constant in which a motor may still have an earlier, higher speed (choice)
_ROUNDINGS = 2  # counts: a step is the difference of two rounded readings

Pair = tuple[float, float]


class _Reading(NamedTuple):
    """Both positions, and when they were asked for: they are never older."""

    asked_s: float
    position: Pair


class MotionCheck:
    """Both motors of a siderostat, in any unit of angle.

    Parameters
    ----------
    fastest : float
        The motors' velocity limit, unit/s.
    count : float
        One count of the encoder, unit.

    Attributes
    ----------
    jumped : pair of float or None
        How far both encoders moved when at least one made a jump that no motor could; until :meth:`restart` or
        :meth:`trust`.
    """

    def __init__(self, fastest: float, count: float) -> None:
        self._fastest = fastest
        self._margin = _ROUNDINGS * count
        self.restart()

    def restart(self) -> None:
        """Forget all readings: the next one is accepted wherever it is."""
        self._commanded = self._possible = self._since_last = (self._fastest, self._fastest)
        self._commanded_s = -math.inf
        self._last: _Reading | None = None
        self._suspect: _Reading | None = None
        self.jumped: Pair | None = None

    def trust(self) -> None:
        """Accept the positions as they are after a jump."""
        self.jumped = None

    def command(self, time_s: float, velocity: Pair | None) -> Pair:
        """Record the velocities that are commanded from `time_s` on.

        Parameters
        ----------
        time_s : float
        velocity : pair of float or None
            None if a motor may be without current: then anything may turn it.

        Returns
        -------
        pair of float
            How fast the motors may have turned until the reading that is asked for with this command. A caller
            whose readings come late keeps it for that reading.
        """
        before = self._commanded
        self._commanded = (
            (self._fastest, self._fastest)
            if velocity is None
            else (abs(velocity[0]), abs(velocity[1]))
        )
        left = math.exp((self._commanded_s - time_s) / _SLOWING_S)
        slowing = (left * self._possible[0], left * self._possible[1])
        # Until now the motors had the command before; only from now on they slow down from it.
        self._possible = _faster(_faster(self._commanded, before), slowing)
        self._commanded_s = time_s
        return self._possible

    def miss(self, possible: Pair) -> None:
        """Count a command without a reading: what was possible with it remains possible until the next one."""
        self._since_last = _faster(self._since_last, possible)

    def accept(self, asked_s: float, now_s: float, possible: Pair, position: Pair) -> bool:
        """Whether a reading is plausible, or agrees with the one that was dropped before it (:attr:`jumped`).

        Parameters
        ----------
        asked_s : float
            When it was asked for.
        now_s : float
            By when it was read.
        possible : pair of float
            Of the command that it was asked for with (:meth:`command`).
        position : pair of float
        """
        reading = _Reading(asked_s, position)
        self.miss(possible)
        last = self._last
        if last is not None and not self._can_follow(last, reading, now_s):
            if self._suspect is None or not self._can_follow(self._suspect, reading, now_s):
                self._suspect = reading
                return False
            self.jumped = (
                position[0] - last.position[0],
                position[1] - last.position[1],
            )
        self._suspect = None
        self._last = reading
        self._since_last = possible
        return True

    def _can_follow(self, earlier: _Reading, later: _Reading, now_s: float) -> bool:
        """Whether the motors can have made this step.

        At most, they had the time from the asking for the earlier reading to now, and the highest velocity
        commanded since.
        """
        elapsed_s = now_s - earlier.asked_s
        for before, after, possible in zip(
            earlier.position, later.position, self._since_last, strict=True
        ):
            fastest = min(self._fastest, possible + _UNCOMMANDED_PART * self._fastest)
            if abs(after - before) > SPEED_MARGIN * fastest * elapsed_s + self._margin:
                return False
        return True


def _faster(one: Pair, other: Pair) -> Pair:
    return max(one[0], other[0]), max(one[1], other[1])
