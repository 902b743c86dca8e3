"""What runs at a pace of its own beside the frames, on a thread each."""

from __future__ import annotations

import threading
from collections import deque
from typing import Protocol

from fitctl.clock import Clock
from fitctl.stages.realtime import become_realtime


class Periodic(Protocol):
    """What wants to be run at a pace of its own."""

    period_s: float
    late_s: deque[float]

    @property
    def threaded(self) -> bool:
        """A thread runs it, and no request does so by itself."""
        ...

    @threaded.setter
    def threaded(self, threaded: bool) -> None: ...

    @property
    def skipped(self) -> int:
        """Periods that were too late."""
        ...

    @skipped.setter
    def skipped(self, skipped: int) -> None: ...

    def period(self) -> None:
        """Do one period's work."""

    def wait(self) -> None:
        """Return once there is work, or after a while."""


class PeriodicThread:
    """Runs something periodic with absolute deadlines; a missed deadline is skipped, never made up.

    Attributes
    ----------
    error : Exception or None
        What has ended it before it was stopped.
    """

    def __init__(self, work: Periodic, clock: Clock) -> None:
        self.error: Exception | None = None
        self._work = work
        self._clock = clock
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._run, name=type(work).__name__, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._work.threaded = True
        self._thread.start()

    def stop(self) -> None:
        """End the thread after the period it is in."""
        self._ending.set()
        self._thread.join(timeout=5.0)
        self._work.threaded = False

    def _run(self) -> None:
        try:
            self._go_on()
        except Exception as error:
            self._work.threaded = False  # the thread that requests work does it then
            self.error = error
            raise

    def _go_on(self) -> None:
        become_realtime(priority=60)
        period_s = self._work.period_s
        deadline_s = self._clock.now_s() + period_s
        while not self._ending.is_set():
            self._clock.sleep_until(deadline_s)
            late_s = self._clock.now_s() - deadline_s
            self._work.late_s.append(late_s)
            self._work.period()
            self._work.wait()
            passed = max(1, int((self._clock.now_s() - deadline_s) / period_s) + 1)
            deadline_s += passed * period_s
            self._work.skipped += passed - 1
