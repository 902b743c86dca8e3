"""A soak: the instrument of the default rig, struck again and again, and brought back each time."""

from __future__ import annotations

import os
import random
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from benchmarks.soak.consoles import Console
from benchmarks.soak.course import Course, Struck
from benchmarks.soak.growth import SAMPLE_S, Samples
from benchmarks.soak.logs import Audit
from benchmarks.soak.strikes import Bench, shuffled
from fitctl.config import default_rig_path
from fitctl.demo import Instrument, instrument
from fitctl.messages.commands import Acquire, AnyCommand, Recover, Shutdown, Standby

_LOGGING = (  # files end and go within the soak, so that disk use is bounded and both are tried
    "logging.rotate_bytes=10000000",
    "logging.rotate_s=300.0",
    "logging.retain_bytes=100000000",
)
_QUIET_S = (3.0, 15.0)
_SHORTEST_S = 1.0  # of a strike
BACK_WITHIN_S = 90.0
_GIVE_UP_S = 300.0
_STEADY_S = 4.0  # in VERNIER, before the loop counts as back
_ASK_AGAIN_S = 2.0
_SILENT_S = 10.0
_END_S = 30.0
_WAYS_BACK: dict[str, Callable[[], AnyCommand]] = {
    "SAFE": Recover,
    "OFF": Standby,
    "STANDBY": Acquire,
}


class Failed(Exception):
    """The soak cannot go on; the text says why."""


class Soak:
    """One soak in progress.

    Parameters
    ----------
    running : Instrument
    bench : Bench
    audit : Audit
    stop : threading.Event
        Set by whoever ends it early.
    """

    def __init__(
        self, running: Instrument, bench: Bench, audit: Audit, stop: threading.Event
    ) -> None:
        self.course = Course()
        self.samples = Samples()
        self.started_s = time.monotonic()
        self.most_disk_bytes = 0
        self.load: list[float] = []  # the machine's, of the last minute
        self._running = running
        self._bench = bench
        self._audit = audit
        self._stop = stop
        self._sample_s = 0.0
        self._heard_s = self.started_s

    def run(
        self, duration_s: float, chance: random.Random, tell: Callable[[Soak, str], None]
    ) -> None:
        """Strike until `duration_s` is over; `tell` gets a line after each strike.

        Raises
        ------
        Failed
            If the loop does not come back at all, or telemetry has ended.
        DemoError
            If mocks or supervisor have ended.
        """
        end_s = self.started_s + duration_s
        self._come_back("start")
        tell(self, "started")
        for strike in shuffled(chance):
            self._follow(chance.uniform(*_QUIET_S))
            if time.monotonic() >= end_s or self._stop.is_set():
                return
            self.course.quiet = False
            at_s = time.monotonic()
            over = strike.begin(self._bench, chance)
            self._follow(chance.uniform(_SHORTEST_S, strike.longest_s))
            over()
            ended_s = time.monotonic()
            back_s = self._come_back(strike.name)
            if self._stop.is_set():
                return
            told = self.course.told_since(at_s) if back_s > BACK_WITHIN_S else ()
            self.course.struck.append(
                Struck(at_s - self.started_s, strike.name, ended_s - at_s, back_s, told)
            )
            tell(self, f"{strike.name}, back after {back_s:.1f} s")

    def shut_down(self) -> None:
        """Have the supervisor end, and hear it until it has."""
        self.course.quiet = False
        self._running.client.send(Shutdown())
        end_s = time.monotonic() + _END_S
        while self._running.supervisor.poll() is None and time.monotonic() < end_s:
            self._hear(0.1)
        while self._hear(0.2):
            pass

    def _come_back(self, what: str) -> float:
        """Recover and acquire until VERNIER lasts, or the soak is ended; the time that took, in s.

        Raises
        ------
        Failed
            If it has not come to that after `_GIVE_UP_S`.
        """
        began_s = asked_s = since_s = time.monotonic()
        while (now_s := time.monotonic()) < began_s + _GIVE_UP_S:
            self._follow(0.0)
            if self._stop.is_set():
                return now_s - began_s
            mode = self.course.mode
            if mode != "VERNIER":
                since_s = now_s
            elif now_s - since_s >= _STEADY_S:
                self.course.quiet = True
                return since_s - began_s
            if mode in _WAYS_BACK and now_s >= asked_s:
                asked_s = now_s + _ASK_AGAIN_S
                self._running.client.send(_WAYS_BACK[mode]())
        told = "; ".join(self.course.told_since(began_s))
        msg = f"{what}: not back after {_GIVE_UP_S:g} s, but in {self.course.mode}: {told}"
        raise Failed(msg)

    def _follow(self, lasting_s: float) -> None:
        """Hear telemetry for a time, one message at the least, and sample what is due."""
        end_s = time.monotonic() + lasting_s
        while True:
            self._hear(0.5)
            now_s = time.monotonic()
            if now_s >= self._sample_s:
                self._sample_s = now_s + SAMPLE_S
                self._look(now_s)
            if now_s >= end_s or self._stop.is_set():
                return

    def _hear(self, timeout_s: float) -> bool:
        telemetry = self._running.client.receive(timeout_s)
        if telemetry is not None:
            self._heard_s = time.monotonic()
            self.course.add(telemetry)
        return telemetry is not None

    def _look(self, now_s: float) -> None:
        self._running.check()
        if now_s - self._heard_s > _SILENT_S:
            msg = f"no telemetry for {now_s - self._heard_s:.0f} s"
            raise Failed(msg)
        if not self._bench.console.alive:
            msg = "the console has ended"
            raise Failed(msg)
        pids = {
            "mocks": self._running.mocks.pid,
            "supervisor": self._running.supervisor.pid,
            "console": self._bench.console.pid,
        }
        recorder = self._bench.recorder
        if recorder is not None:
            pids["recorder"] = recorder.pid
        self.samples.take(now_s, pids)
        self._audit.look()
        self.load.append(os.getloadavg()[0])
        self.most_disk_bytes = max(self.most_disk_bytes, self._audit.disk_bytes)


@contextmanager
def soaking(
    folder: Path, overrides: Sequence[str], seed: int, stop: threading.Event
) -> Iterator[tuple[Soak, Audit]]:
    """Start everything, with logs in `folder`/logs; end everything, whatever happens."""
    logs = folder / "logs"
    where = [f"logging.folder={logs}", f"service.folder={folder / 'sockets'}"]
    rig = default_rig_path()
    audit = Audit(logs)
    consoles: list[Console] = []

    def new_console() -> Console:
        settings = [part for key in where for part in ("--set", key)]
        consoles.append(Console(["--rig", str(rig), *settings]))
        return consoles[-1]

    try:
        with instrument(rig, [*where, *_LOGGING, *overrides], seed) as running:
            yield Soak(running, Bench(running, new_console(), new_console), audit, stop), audit
    finally:
        for console in consoles:
            if console.alive:
                console.kill()
