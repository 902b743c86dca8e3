"""The computer under the instrument: its disk, its clocks, and whether the recorder keeps up."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from pathlib import Path

from fitctl.logging.records import Severity

_SURE_S = 0.001  # two clocks read within this time are read together
_LATE_S = 5.0


def free_bytes(folder: Path) -> int:
    """Room for ordinary users where `folder` is; where that disk is far away, its answer may never come."""
    return shutil.disk_usage(folder).free


def wall_minus_monotonic_s(
    wall: Callable[[], float] = time.time, monotonic: Callable[[], float] = time.monotonic
) -> float | None:
    """Difference of the clocks; None when we were interrupted between reading them."""
    before_s = monotonic()
    wall_s = wall()
    after_s = monotonic()
    return wall_s - (before_s + after_s) / 2 if after_s - before_s < _SURE_S else None


class Machine:
    """Measures what interlocks judge of the computer.

    The disk is asked on a thread of its own, because a disk of the network may let everyone wait who asks. It
    is a daemon: what a thread waits for in the kernel cannot be ended, and must not keep the process.

    Parameters
    ----------
    folder : Path
        Where the log is written.
    backlog : callable
        Part of the record queue that is taken.
    measured : callable
        Takes a quantity's name and its value; from any thread.
    note : callable
        Takes events; from any thread.
    """

    def __init__(
        self,
        folder: Path,
        backlog: Callable[[], float],
        measured: Callable[[str, float], None],
        note: Callable[[Severity, str, str], None],
    ) -> None:
        self._folder = folder
        self._backlog = backlog
        self._measured = measured
        self._note = note
        self._difference_s = wall_minus_monotonic_s()
        self._wanted = threading.Event()
        self._asked_s: float | None = None  # while the disk has not answered
        self._trouble = ""
        threading.Thread(target=self._ask_disk, name="disk", daemon=True).start()

    def look(self) -> None:
        """Measure, without waiting for anything; called about once a second."""
        self._measured("recorder_backlog_fraction", self._backlog())
        before_s, now_s = self._difference_s, wall_minus_monotonic_s()
        if before_s is not None and now_s is not None:
            self._measured("clock_step_s", now_s - before_s)
        self._difference_s = now_s if now_s is not None else before_s
        asked_s = self._asked_s
        if asked_s is None:
            self._asked_s = time.monotonic()
            self._wanted.set()
        elif time.monotonic() - asked_s > _LATE_S:
            self._tell(f"has not reported its free space for {_LATE_S:g} s")

    def _ask_disk(self) -> None:
        while True:
            self._wanted.wait()
            self._wanted.clear()
            try:
                self._measured("disk_free_bytes", float(free_bytes(self._folder)))
                self._tell("")
            except OSError as error:
                self._tell(f"does not report its free space: {error.strerror}")
            self._asked_s = None

    def _tell(self, trouble: str) -> None:
        """Say what is wrong with the disk, and that it is over, once each."""
        was, self._trouble = self._trouble, trouble
        disk = f"the disk of {self._folder}"
        if trouble and trouble != was:
            remedy = "look at that disk, and at its link if it is not in this computer"
            text = f"{disk} {trouble}; interlocks use the last value; {remedy}"
            self._note("warning", "computer", text)
        elif was and not trouble:
            self._note("info", "computer", f"{disk} reports its free space again")
