"""A timer for the event loop that is not rounded to milliseconds, as epoll's own time limit is."""

from __future__ import annotations

import asyncio
import contextlib
import ctypes
import os
import time
from collections.abc import Callable

_TFD_NONBLOCK = os.O_NONBLOCK
_TFD_CLOEXEC = os.O_CLOEXEC
_TFD_TIMER_ABSTIME = 1


class _Timespec(ctypes.Structure):
    _fields_ = (("tv_sec", ctypes.c_long), ("tv_nsec", ctypes.c_long))


class _Itimerspec(ctypes.Structure):
    _fields_ = (("it_interval", _Timespec), ("it_value", _Timespec))


class AbsoluteTimer:
    """Linux timerfd: calls back at a time of the monotonic clock.

    Parameters
    ----------
    callback : callable
        Called from the running event loop.

    Raises
    ------
    OSError
        If the kernel grants no timer.
    """

    def __init__(self, callback: Callable[[], None]) -> None:
        self._callback = callback
        self._libc = ctypes.CDLL(None, use_errno=True)
        fd = self._libc.timerfd_create(time.CLOCK_MONOTONIC, _TFD_NONBLOCK | _TFD_CLOEXEC)
        if fd < 0:
            raise _os_error()
        self._fd = fd
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(fd, self._expired)

    def arm(self, when_s: float) -> None:
        """Call back once at `when_s`, or at once if it has passed; replaces what was armed before."""
        nanoseconds = max(1, round(when_s * 1e9))  # 0 would disarm
        seconds, rest = divmod(nanoseconds, 1_000_000_000)
        self._set(_Itimerspec(_Timespec(0, 0), _Timespec(seconds, rest)))

    def disarm(self) -> None:
        """Call back no more."""
        self._set(_Itimerspec())

    def close(self) -> None:
        """Give the timer back; safe to call twice."""
        if self._fd >= 0:
            self._loop.remove_reader(self._fd)
            os.close(self._fd)
            self._fd = -1

    def _set(self, spec: _Itimerspec) -> None:
        if self._libc.timerfd_settime(self._fd, _TFD_TIMER_ABSTIME, ctypes.byref(spec), None) < 0:
            raise _os_error()

    def _expired(self) -> None:
        with contextlib.suppress(BlockingIOError):  # armed anew since the loop saw it
            os.read(self._fd, 8)
            self._callback()


def _os_error() -> OSError:
    code = ctypes.get_errno()
    return OSError(code, os.strerror(code))
