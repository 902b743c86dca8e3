"""Threads on virtual time: one runs at a time, until it waits, and the earliest deadline decides which is next.

The supervisor's own threads, locks, events and futures run on these in place of the interpreter's, unchanged:
:func:`installed` puts these in the modules that use them. Each thread is a greenlet, so that a wait costs a
microsecond, and the order of everything depends on nothing but the deadlines.
"""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable, Iterator
from concurrent.futures import Executor, Future
from contextlib import ExitStack, contextmanager
from itertools import count
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import patch

from greenlet import GreenletExit, getcurrent, greenlet

_WITH_THREADS = (
    "fitctl.daemon.machine",
    "fitctl.service.service",
    "fitctl.supervisor.collector",
    "fitctl.stages.collector",
    "fitctl.stages.injector",
    "fitctl.stages.periodic",
)


class _Due:
    """What is to happen at a time: a thread goes on, or a function is called, which must not wait."""

    __slots__ = ("fired", "run")

    def __init__(self, run: Any) -> None:
        self.run = run
        self.fired = False


class VirtualTime:
    """The clock, and the threads that wait by it.

    Attributes
    ----------
    escaped : list of (str, Exception)
        Each exception that ended a thread, with the thread's name, or that a function raised which
        :meth:`call_at` was given, with that function's name.
    """

    def __init__(self) -> None:
        self.escaped: list[tuple[str, Exception]] = []
        self._now_s = 0.0
        self._due: list[tuple[float, int, _Due]] = []
        self._number = 0
        self._hub = getcurrent()
        self._threads: list[greenlet] = []
        self._killed: set[greenlet] = set()
        self._process: list[greenlet] = []
        self._stalled_until_s = self._stalled_s = self._all_stalled_until_s = 0.0
        self._over = False

    # ------------------------------------------------------------ the clock

    def now_s(self) -> float:
        """The virtual time."""
        return self._now_s

    def sleep_until(self, deadline_s: float) -> None:
        """Wait; the others go on meanwhile."""
        if self._over:
            raise GreenletExit
        due = self._due
        if not due or due[0][0] > deadline_s:  # nothing else happens before
            if deadline_s > self._now_s:  # noqa: PLR1730 - as in fitctl.clock: max takes thrice as long
                self._now_s = deadline_s
            return
        self._push(max(deadline_s, self._now_s), getcurrent())
        self._switch()

    def sleep(self, duration_s: float) -> None:
        """Wait for a while."""
        self.sleep_until(self._now_s + duration_s)

    def call_at(self, time_s: float, function: Callable[[], None]) -> None:
        """Call a function, which must not wait, at a time."""
        self._push(max(time_s, self._now_s), function)

    def run_until(self, time_s: float) -> None:
        """Let all threads go on until a time; for whoever made this."""
        mine = self._push(time_s, self._hub)
        while not mine.fired:  # a thread that ends comes back here too
            self._switch()

    def end(self) -> None:
        """End all threads where they are."""
        self._over = True
        for thread in self._threads:
            if not thread.dead:
                thread.throw(GreenletExit)

    # ------------------------------------------------------------ threads

    def spawn(self, run: Callable[[], None], name: str, *, apart: bool = False) -> greenlet:
        """Start a thread, at this time but not before this one waits; `apart`, in another process."""

        def guarded() -> None:
            try:
                run()
            except Exception as error:
                self.escaped.append((name, error))

        thread = greenlet(guarded, self._hub)
        self._threads.append(thread)
        if not apart:
            self._process.append(thread)
        self._push(self._now_s, thread)
        return thread

    def new_process(self) -> None:
        """What is spawned from now on belongs to a new process."""
        self._process = []

    def kill_process(self) -> None:
        """No thread of the process ever goes on."""
        self._killed.update(self._process)

    def stall(self, duration_s: float, *, alone: bool = False) -> tuple[float, float]:
        """No thread goes on for a while, as on a machine that stands still; what is no thread does.

        If the process stands still `alone`, the threads of other processes go on.

        Returns
        -------
        tuple of float
            Until when the process stands still, and by how much that is longer than before.
        """
        before_s = max(self._stalled_until_s, self._now_s)
        until_s = self._now_s + duration_s
        self._stalled_until_s = max(before_s, until_s)
        if not alone:
            self._all_stalled_until_s = max(self._all_stalled_until_s, until_s)
        added_s = self._stalled_until_s - before_s
        self._stalled_s += added_s
        return self._stalled_until_s, added_s

    @property
    def goes_on_s(self) -> float:
        """When a machine that stands still goes on; now, if it does not."""
        return max(self._now_s, self._all_stalled_until_s)

    def awake_s(self) -> float:
        """For how long the process has not stood still."""
        still_s = max(0.0, self._stalled_until_s - self._now_s)
        return self._now_s - (self._stalled_s - still_s)

    def park(self, timeout_s: float | None) -> _Due:
        """Say until when this thread waits at most; :meth:`wait` waits."""
        if self._over:
            raise GreenletExit
        me = getcurrent()
        return _Due(me) if timeout_s is None else self._push(self._now_s + timeout_s, me)

    def wait(self) -> None:
        """Wait until the time limit that :meth:`park` was given, or until this thread is woken."""
        self._switch()

    def wake(self, parked: _Due) -> None:
        """Let a parked thread go on now, and not again at its time limit."""
        if not parked.fired:
            thread, parked.run = parked.run, None
            self._push(self._now_s, thread)

    def _push(self, time_s: float, run: Any) -> _Due:
        due = _Due(run)
        self._number += 1
        heapq.heappush(self._due, (time_s, self._number, due))
        return due

    def _switch(self) -> None:
        """Go on with what is due next, until this thread is."""
        me = getcurrent()
        while True:
            time_s, _, due = heapq.heappop(self._due)
            run = due.run
            if run is None or run in self._killed:
                continue
            if time_s < self._stalled_until_s and isinstance(run, greenlet):
                until_s = self._stands_still_until_s(run)
                if time_s < until_s:
                    self._number += 1
                    heapq.heappush(self._due, (until_s, self._number, due))
                    continue
            due.fired = True
            if time_s > self._now_s:  # noqa: PLR1730
                self._now_s = time_s
            if run is me:
                return
            if isinstance(run, greenlet):
                if run.dead:
                    continue
                run.switch()
                if self._over:
                    raise GreenletExit
                return
            self._call(run)

    def _stands_still_until_s(self, thread: greenlet) -> float:
        if thread is self._hub:
            return -math.inf
        return self._stalled_until_s if thread in self._process else self._all_stalled_until_s

    def _call(self, function: Callable[[], None]) -> None:
        """Call what was due. What it raises must not reach the thread that happens to switch."""
        try:
            function()
        except Exception as error:
            named = getattr(function, "func", function)  # that of a partial
            self.escaped.append((getattr(named, "__qualname__", repr(named)), error))


class _Waiters:
    """Threads that wait for one thing, in their order."""

    def __init__(self, time: VirtualTime) -> None:
        self.time = time
        self._waiting: deque[_Due] = deque()

    def wait(self, timeout_s: float | None) -> None:
        mine = self.time.park(timeout_s)
        self._waiting.append(mine)
        try:
            self.time.wait()
        finally:
            if mine in self._waiting:
                self._waiting.remove(mine)

    def wake(self, most: int = 1_000_000) -> None:
        while self._waiting and most > 0:
            self.time.wake(self._waiting.popleft())
            most -= 1


class VirtualEvent:
    """As `threading.Event`."""

    def __init__(self, time: VirtualTime) -> None:
        self._is_set = False
        self._waiters = _Waiters(time)

    def is_set(self) -> bool:
        """Whether it is set."""
        return self._is_set

    def set(self) -> None:
        """Set it, and wake whoever waits."""
        self._is_set = True
        self._waiters.wake()

    def clear(self) -> None:
        """Clear it."""
        self._is_set = False

    def wait(self, timeout: float | None = None) -> bool:
        """Wait until it is set, no longer than `timeout`."""
        if not self._is_set:
            self._waiters.wait(timeout)
        return self._is_set


class VirtualLock:
    """As `threading.Lock`, as a context manager."""

    def __init__(self, time: VirtualTime) -> None:
        self._held = False
        self._waiters = _Waiters(time)

    def __enter__(self) -> None:
        while self._held:
            self._waiters.wait(None)
        self._held = True

    def __exit__(self, *_: object) -> None:
        self._held = False
        self._waiters.wake(1)


class VirtualThread:
    """As `threading.Thread`."""

    def __init__(self, time: VirtualTime, target: Callable[[], None], name: str) -> None:
        self._time = time
        self._target = target
        self._name = name
        self._started = False
        self._ended = VirtualEvent(time)

    def start(self) -> None:
        """Start it."""
        self._started = True
        self._time.spawn(self._run, self._name)

    def join(self, timeout: float | None = None) -> None:
        """Wait for its end."""
        self._ended.wait(timeout)

    def is_alive(self) -> bool:
        """It was started, and has not ended."""
        return self._started and not self._ended.is_set()

    def _run(self) -> None:
        try:
            self._target()
        finally:
            self._ended.set()


class VirtualThreading:
    """As the module `threading`, as far as the supervisor uses it."""

    def __init__(self, time: VirtualTime) -> None:
        self._time = time

    def Thread(  # noqa: N802
        self, *, target: Callable[[], None], name: str, daemon: bool = True
    ) -> VirtualThread:
        """A thread."""
        return VirtualThread(self._time, target, name)

    def Event(self) -> VirtualEvent:  # noqa: N802
        """An event."""
        return VirtualEvent(self._time)

    def Lock(self) -> VirtualLock:  # noqa: N802
        """A lock."""
        return VirtualLock(self._time)


def future_on(time: VirtualTime) -> type[Future]:
    """As `concurrent.futures.Future`, waited for on virtual time."""

    class VirtualFuture(Future):
        def result(self, timeout: float | None = None) -> Any:
            self._wait(timeout)
            return super().result(0)

        def exception(self, timeout: float | None = None) -> BaseException | None:
            self._wait(timeout)
            return super().exception(0)

        def _wait(self, timeout: float | None) -> None:
            if not self.done():
                waiters = _Waiters(time)
                self.add_done_callback(lambda _: waiters.wake())
                waiters.wait(timeout)

    return VirtualFuture


class VirtualExecutor(Executor):
    """As a `ThreadPoolExecutor` of one thread."""

    def __init__(self, time: VirtualTime, name: str) -> None:
        self._time = time
        self._future = future_on(time)
        self._work: deque[tuple[Future, Callable[[], Any]]] = deque()
        self._some = VirtualEvent(time)
        self.thread = time.spawn(self._run, name)

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Have `fn` called by the thread, after what was submitted before."""
        future = self._future()
        self._work.append((future, lambda: fn(*args, **kwargs)))
        self._some.set()
        return future

    def _run(self) -> None:
        while True:
            self._some.wait()
            self._some.clear()
            while self._work:
                future, work = self._work.popleft()
                if not future.set_running_or_notify_cancel():
                    continue
                try:
                    future.set_result(work())
                except Exception as error:
                    future.set_exception(error)


def standing_for(module: ModuleType, **stand_ins: Any) -> SimpleNamespace:
    """The constants of a module, with stand-ins for what else of it is used."""
    constants = {name: getattr(module, name) for name in dir(module) if name.isupper()}
    return SimpleNamespace(**(constants | stand_ins))


@contextmanager
def installed(time: VirtualTime) -> Iterator[None]:
    """The supervisor's threads are virtual meanwhile."""
    with ExitStack() as stack:
        threading = VirtualThreading(time)
        for module in _WITH_THREADS:
            stack.enter_context(patch(f"{module}.threading", threading))
        runs = (SimpleNamespace(hex=f"{number:032x}") for number in count())
        # That module's name alone: numba names its files by uuid4, and two runs must not write the same one.
        ids = SimpleNamespace(uuid4=lambda: next(runs))
        stack.enter_context(patch("fitctl.sequences.contact.uuid", ids))
        stack.enter_context(patch("fitctl.stages.servo.Future", future_on(time)))
        stack.enter_context(patch("fitctl.stages.periodic.become_realtime", lambda **_: None))
        yield
