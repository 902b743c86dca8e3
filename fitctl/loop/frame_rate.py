"""Whether frames come at the rig file's rate; a short change of it distinguishes vibrations from aliases."""

from __future__ import annotations

from collections import deque

OTHER_RATE = 0.018
"""Of the frame period: from so much on, frames come at another rate. A change is at least 0.02."""
_LEAST_FRAMES, _WATCHED_S = 15, 0.3


def frames_watched(period_s: float) -> int:
    """Over so many frames their rate is measured: jitter of single dates must not count."""
    return max(_LEAST_FRAMES, round(_WATCHED_S / period_s))


class RateWatch:
    """Whether the last frames came at another rate.

    Parameters
    ----------
    period_s : float
        Of frames, by the rig file.
    """

    def __init__(self, period_s: float) -> None:
        self._period_s = period_s
        self._frames = frames_watched(period_s)
        # When frames were exposed, and how many periods were due until then, missing frames included.
        self._seen: deque[tuple[float, int]] = deque(maxlen=self._frames + 1)

    def is_other(self, exposed_s: float) -> bool:
        """Take the next frame's mid-exposure; whether frames come at another rate now."""
        seen, due = self._seen, 0
        if seen:
            last_s, due = seen[-1]
            due += max(1, round((exposed_s - last_s) / self._period_s))
        seen.append((exposed_s, due))
        first_s, first_due = seen[0]
        if due - first_due < self._frames:
            return False
        apart = (exposed_s - first_s) / self._period_s
        return abs(apart / (due - first_due) - 1) > OTHER_RATE
