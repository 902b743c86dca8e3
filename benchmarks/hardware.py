"""Mock devices stand for hardware, which does not wait for what else the computer has to do."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

PRIORITY = 40  # below all threads of the supervisor


def never_wait(pid: int) -> None:
    """Make a process as realtime as the supervisor is, where that is allowed."""
    for thread in Path(f"/proc/{pid}/task").iterdir():
        with suppress(PermissionError):
            os.sched_setscheduler(int(thread.name), os.SCHED_FIFO, os.sched_param(PRIORITY))
