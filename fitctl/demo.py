"""``fitctl demo``: mock testbed, supervisor and recorder as processes, and how it went."""

from __future__ import annotations

import json
import math
import selectors
import shutil
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from fitctl.config import ConfigError, Rig, load_rig
from fitctl.daemon.last_records import HELLO_S
from fitctl.daemon.locks import only_supervisor
from fitctl.logging.records import LoopTiming, MetrologyTick, Tick
from fitctl.messages.client import Client
from fitctl.messages.commands import Acquire, AnyCommand, MoveCollector, Reply, Standby
from fitctl.messages.endpoints import make_service_folder
from fitctl.messages.modes import HOLDING, Mode
from fitctl.messages.telemetry import Telemetry
from fitctl.messages.waiting import wait_for_outcomes
from fitctl.mocks.bench import (
    Beam,
    BeamQuestion,
    Residual,
    ResidualQuestion,
    Visibility,
    VisibilityQuestion,
    ask_bench,
)
from fitctl.model.optics import scales
from fitctl.processes import (
    end_process,
    last_line,
    lock_held,
    rig_arguments,
    signals_ignored,
    start_process,
)
from fitctl.simulation.statistics import pair, rms

JUDGED_S = 30.0
_HELD = {mode.name for mode in HOLDING}
_START_TIMEOUT_S = 60.0
_END_TIMEOUT_S = HELLO_S + 15.0  # longer than the supervisor waits for its recorder


class DemoError(Exception):
    """The demo could not run; the text says which part failed and what to do."""


@dataclass
class Instrument:
    """A running mock instrument."""

    client: Client
    rig: Rig
    sockets: Path
    errors: Path
    bench_port: int
    started_s: float
    supervisor: subprocess.Popen[bytes]
    mocks: subprocess.Popen[bytes]
    log: str = ""  # the first log file, once `acquire_in_background` has heard of it

    def check(self) -> None:
        """Raise DemoError if a part of it has ended."""
        for name, process in (("mocks", self.mocks), ("supervisor", self.supervisor)):
            if process.poll() is not None:
                why = last_line(self.errors / f"{name}.err") or "it left no message"
                msg = f"{name} ended with status {process.returncode}: {why}"
                raise DemoError(msg)


@contextmanager
def moving_collector(running: Instrument) -> Iterator[None]:
    """Move the collector, where the rig has one, as its rig file says: from when all loops hold.

    A thread of its own sends the commands; what goes wrong shows as events of the supervisor.
    """
    collector = running.rig.collector
    if collector is None or collector.motion.kind == "still":
        yield
        return
    ending = threading.Event()
    thread = threading.Thread(
        target=_move_collector, args=(running.sockets, ending), name="demo-collector"
    )
    thread.start()
    try:
        yield
    finally:
        ending.set()
        thread.join()


def _move_collector(sockets: Path, ending: threading.Event) -> None:
    beside = Client(sockets)
    try:
        beside.send(MoveCollector(action="reference"))
        while not ending.is_set():
            telemetry = beside.receive(0.5)
            holds = telemetry and all(loop.mode in _HELD for loop in telemetry.loops)
            # Refused while the hexapod is still being referenced.
            if holds and beside.send(MoveCollector(action="start")).accepted:
                return
    except ConnectionError:
        return  # the supervisor has ended, which the demo reports
    finally:
        beside.close()


@contextmanager
def instrument(rig_path: Path, overrides: Sequence[str], seed: int) -> Iterator[Instrument]:
    """Start everything on free ports; end everything, whatever happens.

    Its sockets are where the rig file has them, so that other commands find the demo; where another
    supervisor or demo has that rig, they are in a folder of the demo's own.

    Raises
    ------
    DemoError
        If a part does not start.
    """
    started_s = time.monotonic()
    processes: list[subprocess.Popen[bytes]] = []
    folder = Path(tempfile.mkdtemp(prefix="fitctl-demo-"))
    stack = ExitStack()
    try:
        options = ["--seed", str(seed), "--free-ports", "--json"]
        mocks = _start(folder, "mocks", ["mocks", *rig_arguments(rig_path, overrides), *options])
        processes.append(mocks)
        endpoints = _first_line(mocks, folder)
        # With the bench's port among them, so that `fitctl fault` finds these mocks by their supervisor.
        devices = [
            f"{key}={value}"
            for key, value in endpoints.items()
            if key == "mocks.bench_port" or not key.startswith("mocks.")
        ]
        rig = load_rig(rig_path, [*overrides, *devices])
        sockets = stack.enter_context(_socket_folder(rig, folder))
        settings = [*overrides, *devices, f"service.folder={sockets}"]
        supervisor = _start(folder, "supervisor", ["run", *rig_arguments(rig_path, settings)])
        processes.append(supervisor)
        bench_port = int(endpoints["mocks.bench_port"])
        running = Instrument(
            Client(sockets), rig, sockets, folder, bench_port, started_s, supervisor, mocks
        )
        try:
            _wait_for_telemetry(running)
            yield running
        finally:
            running.client.close()
    finally:
        with signals_ignored():
            _end(processes)
            stack.close()
            shutil.rmtree(folder, ignore_errors=True)


def acquire(running: Instrument) -> None:
    """Power up, then search.

    Raises
    ------
    DemoError
        If the supervisor refuses or a device fails.
    """
    reply = _command(running, Standby())
    try:
        outcomes = wait_for_outcomes(running.client, reply, _START_TIMEOUT_S)
    except ConnectionError:
        running.check()
        raise
    for outcome in outcomes.values():
        if outcome.state != "done":
            msg = f"standby {outcome.state}: {outcome.text or 'give it more time'}"
            raise DemoError(msg)
    _command(running, Acquire())


def acquire_in_background(running: Instrument) -> threading.Thread:
    """The same beside a console, with a telemetry connection of its own; failures show as events there."""

    def work() -> None:
        # The console shows the supervisor's own event, or that it does not answer.
        with suppress(DemoError, ConnectionError), closing(Client(running.sockets)) as beside:
            acquire(replace(running, client=beside))
        with suppress(ConnectionError):
            running.log = log_path(running)

    thread = threading.Thread(target=work, name="demo-acquire", daemon=True)
    thread.start()
    return thread


@dataclass
class Course:
    """What was seen of a run; grows with telemetry."""

    ticks: dict[str, list[Tick]] = field(default_factory=dict)
    beams: dict[str, list[MetrologyTick]] = field(default_factory=dict)
    reached_s: dict[tuple[str, str], float] = field(default_factory=dict)
    held_since_s: dict[str, float] = field(default_factory=dict)
    timing: dict[tuple[str, float], LoopTiming] = field(default_factory=dict)
    last: Telemetry | None = None

    @property
    def log(self) -> str:
        """What the recorder writes now; empty until it has named it."""
        return "" if self.last is None or self.last.recorder is None else self.last.recorder.path

    def add(self, telemetry: Telemetry) -> None:
        """Take one telemetry message."""
        self.last = telemetry
        for tick in telemetry.ticks:
            if tick.number >= 0:
                self.ticks.setdefault(tick.loop, []).append(tick)
        for beam in telemetry.metrology_ticks:
            if beam.number >= 0:
                self.beams.setdefault(beam.loop, []).append(beam)
        for change in telemetry.mode_changes:
            self.reached_s.setdefault((change.loop, change.target), change.time_s)
            if change.target in _HELD:
                self.held_since_s[change.loop] = change.time_s
            else:
                self.held_since_s.pop(change.loop, None)
        for timing in telemetry.timing:
            self.timing[timing.loop, timing.time_s] = timing


def watch(
    running: Instrument, duration_s: float, on_progress: Callable[[float, Telemetry], None]
) -> Course:
    """Follow a run for `duration_s`; `on_progress` gets the seconds gone by and the newest telemetry.

    Raises
    ------
    DemoError
        If a part of the instrument ends meanwhile.
    """
    course = Course()
    begun_s = time.monotonic()
    while (gone_s := time.monotonic() - begun_s) < duration_s:
        telemetry = running.client.receive(0.5)
        running.check()
        if telemetry is not None:
            course.add(telemetry)
            on_progress(gone_s, telemetry)
    return course


def summary(rig: Rig, running: Instrument, course: Course, loop_name: str) -> dict[str, Any]:
    """How one loop did: the keys of ``fitctl demo --json``, but for ``log``.

    ``judged_s`` is zero unless the loop holds its star or its beam at the end.
    """
    ticks = _all_ticks(course, loop_name)
    how_well = _star if loop_name in rig.stellar_loops else _beam
    timing = [t for (name, _), t in course.timing.items() if name == loop_name]
    last = course.last
    return how_well(rig, running, course, loop_name) | {
        "frames": len(ticks),
        "frames_lost": ticks[-1].frames_lost if ticks else 0,
        "late_ticks": sum(tick.late for tick in ticks),
        "machine_stalls": sum(t.stalls for t in timing),
        "worst_stall_s": max((t.worst_stall_s for t in timing), default=0.0),
        "records_lost": 0 if last is None else last.records_lost,
    }


def _star(rig: Rig, running: Instrument, course: Course, loop_name: str) -> dict[str, Any]:
    ticks = course.ticks.get(loop_name, [])
    start_s, end_s = _judged(course, loop_name)
    judged = [t for t in ticks if t.mid_exposure_s >= start_s and t.star_visible]
    errors = np.array([[t.error_az_px, t.error_el_px] for t in judged]).reshape(-1, 2)
    truth = _truth(rig, running, loop_name, start_s, end_s)
    arcsec = scales(rig, rig.stellar_loops[loop_name]).sky_arcsec_per_px
    return {
        "acquired_s": _since(running, course, loop_name, Mode.COARSE),
        "vernier_s": _since(running, course, loop_name, Mode.VERNIER),
        "rms_px": {"az": truth.az_rms_px, "el": truth.el_rms_px},
        "measured_rms_px": pair(rms(errors)),
        "rms_arcsec": {"az": truth.az_rms_px * arcsec, "el": truth.el_rms_px * arcsec},
        "judged_s": truth.samples * rig.mock_parts()[0].step_s,
    }


def _beam(rig: Rig, running: Instrument, course: Course, loop_name: str) -> dict[str, Any]:
    start_s, end_s = _judged(course, loop_name)
    truth = Beam(math.nan, math.nan, 0)
    if start_s < end_s:
        truth = ask_bench(running.bench_port, BeamQuestion(loop_name, start_s, end_s), Beam)
    return {
        "acquired_s": _since(running, course, loop_name, Mode.COARSE),
        "locked_s": _since(running, course, loop_name, Mode.LOCKED),
        "rms_arcsec": {"az": truth.az_rms_arcsec, "el": truth.el_rms_arcsec},
        "judged_s": truth.samples * rig.mock_parts()[0].step_s,
    }


def visibility(rig: Rig, running: Instrument, course: Course) -> float:
    """The mean visibility that the true tilt of the two stars left while both were judged, or nan."""
    if rig.fringes is None:
        return math.nan
    one, other = rig.fringes.loops
    spans = [_judged(course, name) for name in (one, other)]
    if not all(start_s < end_s for start_s, end_s in spans):
        return math.nan
    start_s, end_s = max(start for start, _ in spans), min(end for _, end in spans)
    targets = [rig.stellar_loops[name].target_px for name in (one, other)]
    question = VisibilityQuestion(
        loops=(one, other),
        targets_px=((targets[0].az, targets[0].el), (targets[1].az, targets[1].el)),
        aperture_m=rig.fringes.aperture_m,
        wavelength_m=rig.fringes.wavelength_m,
        start_s=start_s,
        end_s=end_s,
    )
    return ask_bench(running.bench_port, question, Visibility).mean


def _judged(course: Course, loop_name: str) -> tuple[float, float]:
    """From when to when a loop is judged, in the host's time; nan where it does not hold at the end."""
    ticks = _all_ticks(course, loop_name)
    end_s = _paced_s(ticks[-1]) if ticks else math.nan
    return max(course.held_since_s.get(loop_name, math.nan), end_s - JUDGED_S), end_s


def _all_ticks(course: Course, loop_name: str) -> Sequence[Tick | MetrologyTick]:
    """A loop's ticks, whatever its kind."""
    return course.ticks.get(loop_name) or course.beams.get(loop_name, [])


def _paced_s(tick: Tick | MetrologyTick) -> float:
    return tick.mid_exposure_s if isinstance(tick, Tick) else tick.time_s


def _truth(rig: Rig, running: Instrument, name: str, start_s: float, end_s: float) -> Residual:
    if not start_s < end_s:
        return Residual(math.nan, math.nan, 0)
    target = rig.stellar_loops[name].target_px
    return ask_bench(
        running.bench_port, ResidualQuestion(name, start_s, end_s, target.az, target.el), Residual
    )


def _since(running: Instrument, course: Course, loop_name: str, mode: Mode) -> float:
    """Seconds from the demo's start to the first time in `mode`, nan if never."""
    return course.reached_s.get((loop_name, mode.name), math.nan) - running.started_s


def log_path(running: Instrument) -> str:
    """The file that the recorder writes; empty if the supervisor ends, or a minute passes, before it names one.

    A demo can be over before the recorder, a process of its own, has begun its file.

    Raises
    ------
    ConnectionError
        If what the supervisor says cannot be read.
    """
    deadline_s = time.monotonic() + HELLO_S
    with closing(Client(running.sockets)) as client:
        while time.monotonic() < deadline_s and running.supervisor.poll() is None:
            telemetry = client.receive(0.5)
            if telemetry is not None and telemetry.recorder is not None:
                return telemetry.recorder.path
    return ""


# ---------------------------------------------------------------- parts


@contextmanager
def _socket_folder(rig: Rig, other: Path) -> Iterator[Path]:
    """The rig's own, or the other where a supervisor or a demo has that.

    A lock says that a demo has it: until its supervisor is up, nothing else does.
    """
    with ExitStack() as stack:
        try:
            folder = make_service_folder(rig)
            stack.enter_context(lock_held(folder / "demo"))
            with only_supervisor(folder):
                pass
        except (ConfigError, BlockingIOError):
            folder = other
        yield folder


def _start(folder: Path, name: str, arguments: Sequence[str]) -> subprocess.Popen[bytes]:
    """Start a part; its error output goes to a file, because the terminal may be the console's."""
    with (folder / f"{name}.err").open("wb") as errors:
        return start_process(arguments, stdout=subprocess.PIPE, stderr=errors)


def _first_line(mocks: subprocess.Popen[bytes], folder: Path) -> dict[str, Any]:
    """The endpoints that the mock testbed prints once it listens."""
    line = b""
    if mocks.stdout is not None:
        with selectors.DefaultSelector() as selector:
            selector.register(mocks.stdout, selectors.EVENT_READ)
            line = mocks.stdout.readline() if selector.select(_START_TIMEOUT_S) else b""
    if not line:
        why = last_line(folder / "mocks.err") or f"no answer in {_START_TIMEOUT_S:g} s"
        msg = f"mocks did not start: {why}"
        raise DemoError(msg)
    return json.loads(line)


def _command(running: Instrument, command: AnyCommand) -> Reply:
    reply = running.client.send(command)
    if not reply.accepted:
        msg = f"{type(command).__name__.lower()} was refused: {reply.text}"
        raise DemoError(msg)
    return reply


def _wait_for_telemetry(running: Instrument) -> None:
    deadline_s = time.monotonic() + _START_TIMEOUT_S
    while time.monotonic() < deadline_s:
        telemetry = running.client.receive(0.5)
        running.check()
        if telemetry is not None:
            return
    msg = f"the supervisor's first telemetry did not come within {_START_TIMEOUT_S:g} s"
    raise DemoError(msg)


def _end(processes: list[subprocess.Popen[bytes]]) -> None:
    """Supervisor first, so that it can still bring the mirror to its bias; then the mocks."""
    for process in reversed(processes):
        end_process(process, _END_TIMEOUT_S)
