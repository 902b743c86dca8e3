"""The supervisor process: real clock, real devices, threads for servos and service, a recorder beside it."""

from __future__ import annotations

import fcntl
import gc
import importlib.metadata
import math
import os
import platform
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path

from fitctl.clock import MonotonicClock
from fitctl.config import ConfigError, Rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.files import design_json
from fitctl.logging.queue import RecordQueue
from fitctl.logging.records import AnyRecord, RunInfo, Severity
from fitctl.processes import end_process, ended_by_signals, last_line, start_process
from fitctl.supervisor.devices import rig_devices
from fitctl.supervisor.endpoints import (
    COMMAND_SOCKET,
    RECORDS_SOCKET,
    TELEMETRY_SOCKET,
    make_service_folder,
    service_folder,
)
from fitctl.supervisor.machine import Machine
from fitctl.supervisor.realtime import (
    become_realtime,
    collect_young,
    lock_memory,
    quiet_interpreter,
)
from fitctl.supervisor.service import Service, ServiceState, TelemetryBuffer
from fitctl.supervisor.servo import PeriodicThread
from fitctl.supervisor.supervisor import Supervisor

_RECORDER_ERRORS = "recorder.err"
_HOUSEKEEPING_S = 1.0
_WIND_DOWN_S = 1.0
_RECORDER_END_S = 5.0
_RECORDER_WELL_S = 10.0  # a recorder that lived this long is started again at once
_RECORDER_PATIENCE_S = 60.0
_CUT = (
    f"recorder: it did not end within {_RECORDER_END_S:g} s and was killed; the last records, up to {{}}, "
    "are not in the log; mend it with: fitctl log recover"
)
_DEAF = "the service thread has died, nobody could stop us any more; see the traceback above"
_VERSIONED = (
    "fitctl",
    "numpy",
    "scipy",
    "control",
    "pyzmq",
    "mcap",
    "python-can",
    "pymodbus",
    "genicam",
)


class Recorder:
    """The recorder process, started again when it dies: at once, then ever more patiently.

    Parameters
    ----------
    arguments : sequence of str
        ``fitctl`` arguments that start it.
    errors : Path
        Where its error output goes.
    note : callable
        Takes events.
    """

    def __init__(
        self, arguments: Sequence[str], errors: Path, note: Callable[[Severity, str, str], None]
    ) -> None:
        self._arguments = arguments
        self._errors = errors
        self._note = note
        self._patience_s = 0.0
        self._again_s = math.inf
        self._start()

    def check(self) -> None:
        """Start it again if it has died and its time has come; called about once a second."""
        now_s = time.monotonic()
        code = self._process.poll()
        if code is None:
            if now_s - self._started_s > _RECORDER_WELL_S:
                self._patience_s = 0.0
        elif self._again_s == math.inf:
            how = f"was killed by signal {-code}" if code < 0 else f"ended with status {code}"
            why = last_line(self._errors)
            self._again_s = now_s + self._patience_s
            self._note(
                "error",
                "recorder",
                f"the recorder {how}{': ' + why if why else ''}; a new one begins a new file"
                + (f" in {self._patience_s:.0f} s" if self._patience_s else ""),
            )
            self._patience_s = min(max(1.0, 2 * self._patience_s), _RECORDER_PATIENCE_S)
        if now_s >= self._again_s:
            self._start()

    def end(self) -> bool:
        """Let it write what it has and end; False if it had to be killed."""
        end_process(self._process, _RECORDER_END_S)
        return self._process.returncode != -signal.SIGKILL

    def _start(self) -> None:
        with self._errors.open("wb") as errors:
            self._process = start_process(self._arguments, stderr=errors)
        self._started_s = time.monotonic()
        self._again_s = math.inf


def check_log_folder(folder: Path) -> None:
    """Make the log folder.

    Raises
    ------
    ConfigError
        If nothing can be written there.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
    except (OSError, ValueError) as error:
        msg = f"logging.folder: {folder}: nothing can be written there: {error}; choose another"
        raise ConfigError(msg) from None


@contextmanager
def only_supervisor(folder: Path) -> Iterator[None]:
    """Hold the rig's lock; a second supervisor on the same rig is refused.

    Raises
    ------
    ConfigError
        If another holds it; the text names its process.
    """
    path = folder / "lock"
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            owner = os.read(descriptor, 32).decode(errors="replace").strip() or "unknown"
            msg = (
                f"{folder}: another supervisor (process {owner}) has this rig; attach to it with "
                "`fitctl console`, or end it first"
            )
            raise ConfigError(msg) from None
        os.ftruncate(descriptor, 0)
        os.write(descriptor, str(os.getpid()).encode())
        yield
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def run_supervisor(
    rig: Rig, recorder_arguments: Sequence[str], on_ready: Callable[[Path], None]
) -> None:
    """Supervise a rig until told to shut down, by a command or a signal.

    Parameters
    ----------
    rig : Rig
    recorder_arguments : sequence of str
        How to start the recorder: ``fitctl`` arguments that describe the same rig.
    on_ready : callable
        Called with the socket folder once commands are answered.

    Raises
    ------
    ConfigError
        If the socket folder cannot be used, or another supervisor has this rig.
    """
    service_folder(rig)  # refused before anything is made
    log_folder = Path(rig.logging.folder).expanduser()
    check_log_folder(log_folder)
    folder = make_service_folder(rig)
    with ExitStack() as stack:
        ending = threading.Event()
        stack.enter_context(ended_by_signals(ending.set))
        stack.enter_context(only_supervisor(folder))
        for name in (COMMAND_SOCKET, TELEMETRY_SOCKET, RECORDS_SOCKET, _RECORDER_ERRORS):
            stack.callback((folder / name).unlink, missing_ok=True)
        clock = MonotonicClock()
        queue = RecordQueue(f"ipc://{folder / RECORDS_SOCKET}", rig.logging.queue_records)
        stack.callback(queue.close)  # in case what follows fails
        buffer = TelemetryBuffer()

        def record(record: AnyRecord) -> None:
            queue.offer(record)
            buffer.add(record)

        executor = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="devices"))
        supervisor = Supervisor(rig, rig_devices(rig), clock, executor, record)
        recorder = Recorder(recorder_arguments, folder / _RECORDER_ERRORS, supervisor.note)
        stack.callback(recorder.end)
        machine = Machine(
            log_folder, lambda: queue.waiting / rig.logging.queue_records, supervisor.measured
        )
        scheduling = f"{become_realtime(priority=50)}; {lock_memory()}"
        info = run_info(rig, scheduling, clock.now_s())
        record(info)
        state = ServiceState(
            pid=os.getpid(),
            wall_minus_monotonic_s=info.wall_minus_monotonic_s,
            scheduling=scheduling,
            records_lost=lambda: queue.lost,
        )
        service = Service(supervisor, buffer, folder, state, clock)
        threads = [PeriodicThread(work, clock) for work in supervisor.periodic]
        quiet_interpreter()
        service.start()
        for thread in threads:
            thread.start()
        on_ready(folder)
        try:
            _loop(supervisor, service, queue, recorder, machine, executor, clock, ending)
        finally:
            gc.enable()
            for thread in threads:
                thread.stop()
            service.stop()
            unconfirmed = queue.waiting
            queue.close()  # while the recorder still listens
            if not recorder.end():
                print(_CUT.format(unconfirmed), file=sys.stderr)


def _loop(
    supervisor: Supervisor,
    service: Service,
    queue: RecordQueue,
    recorder: Recorder,
    machine: Machine,
    executor: ThreadPoolExecutor,
    clock: MonotonicClock,
    ending: threading.Event,
) -> None:
    housekeeping_s = clock.now_s() + _HOUSEKEEPING_S
    try:
        while not (supervisor.shutdown_wanted or ending.is_set()):
            supervisor.step()
            if clock.now_s() >= housekeeping_s:
                housekeeping_s += _HOUSEKEEPING_S
                queue.pump()
                collect_young()
                executor.submit(recorder.check)
                executor.submit(machine.look)
                if not service.is_alive():
                    raise RuntimeError(_DEAF)
        supervisor.shutdown_wanted = True
        supervisor.stop("shutting down")
        end_s = clock.now_s() + _WIND_DOWN_S
        while clock.now_s() < end_s and not supervisor.at_rest():
            supervisor.step()
    finally:
        supervisor.close()


def run_info(rig: Rig, scheduling: str, now_s: float) -> RunInfo:
    """What is needed to understand this run's records."""
    versions = {name: importlib.metadata.version(name) for name in _VERSIONED}
    return RunInfo(
        time_s=now_s,
        wall_minus_monotonic_s=time.time() - time.monotonic(),
        rig_name=rig.name,
        rig_json=rig.model_dump_json(indent=1),
        versions=versions | {"python": platform.python_version()},
        designs={name: design_json(design_for(rig, name)) for name in rig.loops},
        scheduling=scheduling,
    )
