"""What the machine lets us have of real time: FIFO scheduling, locked memory, a quiet collector."""

from __future__ import annotations

import ctypes
import gc
import os
import sys

_MCL_CURRENT, _MCL_FUTURE, _MCL_ONFAULT = 1, 2, 4
_M_ARENA_MAX = -8
_STACK_BYTES = 1 << 19
_MOST_OBJECTS = 2000  # a full collection of so many lasts 0.5 ms
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
    """Let threads change places quickly, and collect no garbage by itself: a :class:`GarbageCollector` does."""
    gc.disable()
    sys.setswitchinterval(2e-4)


class GarbageCollector:
    """Collects garbage between ticks: every cycle among the objects that are not set aside, in 0.2 ms.

    Collecting among the 60 000 objects of libraries and settings would stop all threads for 20 to 40 ms. The
    collector sets them aside at the start, and once more after the devices' libraries have come. What dies
    among those set aside, such as the driver of a device that was opened again, is collected when the stages
    come to rest.
    """

    def __init__(self) -> None:
        self._pointing = False
        self._collect_everything()

    def collect(self, *, pointing: bool) -> None:
        """Collect; called about once a second.

        Parameters
        ----------
        pointing : bool
            Whether a loop has a star or looks for one, so that a long collection has to wait.
        """
        came_to_rest = self._pointing and not pointing
        self._pointing = pointing
        if came_to_rest:
            self._collect_everything()
            return
        gc.collect()
        if len(gc.get_objects()) > _MOST_OBJECTS:
            gc.freeze()

    def _collect_everything(self) -> None:
        gc.unfreeze()
        gc.collect()
        gc.freeze()
