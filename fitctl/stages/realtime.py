"""What the machine lets us have of real time: FIFO scheduling, locked memory, a quiet collector."""

from __future__ import annotations

import ctypes
import gc
import os
import sys

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_M_ARENA_MAX = -8
_STACK_BYTES = 1 << 19
_ATTRIBUTE_BYTES = 64  # of a pthread_attr_t, which has 56
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


def bound_memory() -> None:
    """Let threads reserve little, because :func:`lock_memory` locks what they reserve; before any starts.

    By default each thread has a stack of 8 MB, and a heap of its own in 64 MB of addresses. This holds also for
    threads that libraries start.
    """
    libc = ctypes.CDLL(None)
    libc.mallopt(_M_ARENA_MAX, 1)
    attributes = ctypes.create_string_buffer(_ATTRIBUTE_BYTES)
    libc.pthread_attr_init(attributes)
    libc.pthread_attr_setstacksize(attributes, ctypes.c_size_t(_STACK_BYTES))
    libc.pthread_setattr_default_np(attributes)


def lock_memory() -> str:
    """Ask for memory that is never paged out; returns what was reached, for people.

    What is mapped now comes in at once; what is mapped later, page by page as it is used.
    """
    libc = ctypes.CDLL(None, use_errno=True)
    if libc.mlockall(_MCL_CURRENT) == 0 and libc.mlockall(_MCL_FUTURE | _MCL_ONFAULT) == 0:
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
