"""Timers of the mocks, on the running event loop."""

from __future__ import annotations

import asyncio
from collections.abc import Callable


class Periodic:
    """Calls `action` every so often while its period is above zero; a missed turn is skipped."""

    def __init__(self, action: Callable[[], None]) -> None:
        self._action = action
        self._period_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def set_period(self, period_s: float) -> None:
        """Start anew with this period; 0 stops."""
        if self._timer:
            self._timer.cancel()
            self._timer = None
        self._period_s = period_s
        if period_s > 0:
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(period_s, self._turn, loop.time() + period_s)

    def _turn(self, due_s: float) -> None:
        loop = asyncio.get_running_loop()
        due_s = max(due_s + self._period_s, loop.time())
        self._timer = loop.call_at(due_s, self._turn, due_s)
        self._action()


class Watchdog:
    """Calls `expired` once when it was fed, and then not again for its timeout.

    Feeding is a store and a clock reading, whatever the rate; the timer moves only when it fires.

    Attributes
    ----------
    timeout_s : float
    """

    def __init__(self, expired: Callable[[], None], timeout_s: float = 0.0) -> None:
        self._expired = expired
        self.timeout_s = timeout_s
        self._fed_s = 0.0
        self._timer: asyncio.TimerHandle | None = None

    def set_timeout(self, timeout_s: float) -> None:
        """Wait for the first feeding, with this timeout; 0 switches off."""
        self.stop()
        self.timeout_s = timeout_s

    def stop(self) -> None:
        """Wait for the first feeding again."""
        if self._timer:
            self._timer.cancel()
            self._timer = None

    def feed(self) -> None:
        """Put off the end; the first feeding arms."""
        loop = asyncio.get_running_loop()
        self._fed_s = loop.time()
        if self._timer is None and self.timeout_s > 0:
            self._timer = loop.call_later(self.timeout_s, self._check)

    def _check(self) -> None:
        loop = asyncio.get_running_loop()
        left_s = self._fed_s + self.timeout_s - loop.time()
        if left_s > 0:
            self._timer = loop.call_later(left_s, self._check)
        else:
            self._timer = None
            self._expired()
