"""What the machine lets us have of real time: FIFO scheduling, locked memory, a quiet collector."""

from __future__ import annotations

import ctypes
import gc
import os
import sys

_MCL_CURRENT_AND_FUTURE = 3
_PR_SET_TIMERSLACK = 29


def become_realtime(priority: int) -> str:
    """Ask for FIFO scheduling of the calling thread; returns what was reached, for people.

    Threads and processes that it starts do not inherit it: a recorder that starts up at this priority
    would starve everything else.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, os.sched_param(priority))
    except PermissionError:
        return "SCHED_OTHER: realtime not permitted (give the user an rtprio limit)"
    except OSError as error:
        return f"SCHED_OTHER: {error.strerror}"
    return f"SCHED_FIFO {priority}"


def lock_memory() -> str:
    """Ask for memory that is never paged out; returns what was reached, for people."""
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT_AND_FUTURE) == 0:
        return "memory locked"
    return f"memory not locked: {os.strerror(ctypes.get_errno())}"


def quiet_interpreter() -> None:
    """Take the collector out of the loop and let threads change places quickly."""
    gc.collect()
    gc.freeze()
    gc.disable()
    sys.setswitchinterval(2e-4)


def collect_young() -> None:
    """A collection short enough to do between ticks; the frozen start-up state is not looked at."""
    gc.collect(0)
