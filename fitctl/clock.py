"""Time: the machine's monotonic clock with absolute deadlines, and a virtual clock, one interface."""

from __future__ import annotations

import ctypes
import errno
import os
import time
from typing import Protocol

_CLOCK_MONOTONIC = 1
_TIMER_ABSTIME = 1


class Clock(Protocol):
    """What the loop needs of time."""

    def now_s(self) -> float:
        """Seconds since an arbitrary, fixed origin; never goes back."""
        ...

    def sleep_until(self, deadline_s: float) -> None:
        """Return at `deadline_s`, or at once if it has passed."""
        ...


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class MonotonicClock:
    """The machine's CLOCK_MONOTONIC; all processes of one machine share it."""

    def __init__(self) -> None:
        self._nanosleep = ctypes.CDLL(None, use_errno=True).clock_nanosleep

    def now_s(self) -> float:
        """Seconds since the machine's monotonic origin."""
        return time.monotonic()

    def sleep_until(self, deadline_s: float) -> None:
        """Sleep to an absolute deadline, so that oversleeping once does not shift the next."""
        deadline_s = max(deadline_s, 0.0)  # the system call refuses negative times
        seconds = int(deadline_s)
        spec = _Timespec(seconds, int((deadline_s - seconds) * 1e9))
        while True:
            code = self._nanosleep(
                _CLOCK_MONOTONIC, _TIMER_ABSTIME, ctypes.byref(spec), ctypes.c_void_p(None)
            )
            if code == 0:
                return
            if code != errno.EINTR:
                raise OSError(code, os.strerror(code))


class VirtualClock:
    """A clock that stands still until it is advanced: for simulation and tests."""

    def __init__(self, start_s: float = 0.0) -> None:
        self._now_s = start_s

    def now_s(self) -> float:
        """The virtual time."""
        return self._now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Move the time on, at once."""
        if deadline_s > self._now_s:  # noqa: PLR1730 - max takes thrice as long, 700 times a second
            self._now_s = deadline_s


class Watchdog:
    """Expires when nothing has come for too long, and this computer has looked for it in the last `again_s`.

    A computer that stands still reads nothing; what was sent meanwhile it reads afterwards. So after a pause it
    looks for `again_s` more before the watchdog expires.

    Parameters
    ----------
    limit_s : float
    again_s : float
        How long the computer must have looked in vain; at most `limit_s`.
    now_s : float
    """

    def __init__(self, limit_s: float, again_s: float, now_s: float) -> None:
        self.limit_s = limit_s
        self._again_s = again_s
        self.feed(now_s)

    def feed(self, now_s: float) -> None:
        """It has come."""
        self._fed_s = now_s
        self._in_vain_s: float | None = None

    def silent_s(self, now_s: float) -> float:
        """How long nothing has come."""
        return now_s - self._fed_s

    def expired(self, now_s: float) -> bool:
        """Whether it has expired; call it whenever you have looked for what feeds it."""
        silent_s = now_s - self._fed_s
        if silent_s < self.limit_s - self._again_s:
            return False
        if self._in_vain_s is None:
            self._in_vain_s = now_s
        return silent_s > self.limit_s and now_s - self._in_vain_s >= self._again_s
