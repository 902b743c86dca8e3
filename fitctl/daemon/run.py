"""The supervisor process: real clock, real devices, threads for servos and service, a recorder beside it."""

from __future__ import annotations

import gc
import importlib.metadata
import os
import platform
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack, closing, contextmanager, suppress
from functools import partial
from pathlib import Path

import zmq

from fitctl.clock import MonotonicClock
from fitctl.config import ConfigError, Rig
from fitctl.controllers.dark import dark_bytes
from fitctl.controllers.design.document import design_json
from fitctl.controllers.design.own_process import design_in_own_process, end_designs
from fitctl.controllers.pair import Design
from fitctl.daemon.children import PATIENCE_S, Child
from fitctl.daemon.devices import rig_devices
from fitctl.daemon.last_records import finish_log
from fitctl.daemon.locks import only_master, only_supervisor
from fitctl.daemon.machine import Machine
from fitctl.daemon.places import Places
from fitctl.daemon.service_manager import (
    ALIVE,
    ENDING,
    READY,
    status_line,
    tell_service_manager,
)
from fitctl.logging.queue import RecordQueue
from fitctl.logging.records import AnyRecord, RunInfo, Severity
from fitctl.messages.endpoints import (
    COMMAND_SOCKET,
    GATEWAY_SOCKET,
    RECORDS_SOCKET,
    TELEMETRY_SOCKET,
    file_identity,
    make_service_folder,
    service_folder,
)
from fitctl.messages.running import RUNNING_FILE, write_running
from fitctl.processes import ended_by_signals, rig_arguments
from fitctl.service.keyed_door import check_keyed_door
from fitctl.service.service import Service
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.stages.periodic import PeriodicThread
from fitctl.stages.realtime import (
    GarbageCollector,
    become_realtime,
    lock_memory,
    quiet_interpreter,
)
from fitctl.supervisor.supervisor import Supervisor

_LEFT = (COMMAND_SOCKET, TELEMETRY_SOCKET, RECORDS_SOCKET, GATEWAY_SOCKET, RUNNING_FILE)
_GATEWAY_PATIENCE_S = 2.0  # without it nobody elsewhere can give a stop
_HOUSEKEEPING_S = 1.0
_WIND_DOWN_S = 1.0
_DEAF = "the service thread has died, so no command could stop the rig any more; see the traceback above"
_STILL = "a thread that drives stages has died, so they would follow no command any more"
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
        reason = getattr(error, "strerror", None) or error
        msg = f"logging.folder: {folder}: nothing can be written there: {reason}; choose another"
        raise ConfigError(msg) from None


def run_supervisor(
    rig: Rig, rig_file: Path, settings: Sequence[str], on_ready: Callable[[Path], None]
) -> None:
    """Supervise a rig until told to shut down, by a command or a signal.

    Parameters
    ----------
    rig : Rig
    rig_file : Path
    settings : sequence of str
        ``key.path=value`` texts that replaced values of the file.
    on_ready : callable
        Called with the socket folder once commands are answered.

    Raises
    ------
    ConfigError
        If the socket folder, the TCP ports or the keys cannot be used, or another supervisor has this rig or
        one of its devices.
    """
    service_folder(rig)  # refused before anything is made
    log_folder = rig.logging.folder_path
    check_log_folder(log_folder)
    folder = make_service_folder(rig)
    with ExitStack() as stack:
        ending = threading.Event()
        stack.enter_context(ended_by_signals(ending.set))
        stack.enter_context(only_supervisor(folder))
        stack.enter_context(only_master(rig))
        check_keyed_door(rig)  # what the gateway will need
        stack.callback(_remove_left, folder)
        clock = MonotonicClock()
        queue = stack.enter_context(  # closed where what follows fails
            closing(RecordQueue(f"ipc://{folder / RECORDS_SOCKET}", rig.logging.queue_records))
        )
        buffer = TelemetryBuffer()

        def record(record: AnyRecord) -> None:
            queue.offer(record)
            buffer.add(record)

        executor = stack.enter_context(ThreadPoolExecutor(1, thread_name_prefix="devices"))
        supervisor = Supervisor(
            rig,
            rig_devices(rig),
            clock,
            executor,
            record,
            design_in_own_process,
            design_executor=stack.enter_context(_designer()),
        )
        children = _children(
            stack, rig, rig_arguments(rig_file, settings), folder, supervisor.report_event
        )
        machine = Machine(
            log_folder,
            lambda: queue.waiting / rig.logging.queue_records,
            supervisor.report_quantity,
            supervisor.report_event,
        )
        scheduling = f"{become_realtime(priority=50)}; {lock_memory()}"
        info = run_info(
            rig,
            scheduling,
            clock.now_s(),
            {name: loop.pointing.design for name, loop in supervisor.stellar_loops.items()},
        )
        record(info)
        state = ServiceState(
            pid=os.getpid(),
            wall_minus_monotonic_s=info.wall_minus_monotonic_s,
            scheduling=scheduling,
            records_lost=lambda: queue.lost,
            records_offered=lambda: queue.offered,
            recorder_started_s=lambda: children[0].started_s,
        )

        keep_bound = _keeps_bound(
            rig, queue, folder, partial(write_running, folder, rig.name, rig_file, settings)
        )

        places = stack.enter_context(_places(folder, supervisor))

        def housekeep() -> None:
            keep_bound()
            places.write(supervisor.places)
            queue.pump()
            record(buffer.losses(state, clock.now_s()))
            collector.collect(pointing=supervisor.pointing)

        service = Service(supervisor, buffer, folder, state, clock)
        threads = [PeriodicThread(work, clock) for work in supervisor.periodic]
        quiet_interpreter()
        collector = GarbageCollector()
        service.start()
        for thread in threads:
            thread.start()
        on_ready(folder)
        tell_service_manager(READY)
        try:
            _loop(supervisor, service, threads, housekeep, children, machine, clock, ending)
        finally:
            gc.enable()
            for thread in threads:
                thread.stop()
            service.stop()
            finish_log(queue, children[0], partial(print, file=sys.stderr, flush=True))


def _children(
    ends: ExitStack,
    rig: Rig,
    same_rig: Sequence[str],
    folder: Path,
    note: Callable[[Severity, str, str], None],
) -> list[Child]:
    """The recorder, and then what else the rig asks for."""
    beside = (
        (True, "recorder", "record", "a new recorder begins a new file", PATIENCE_S),
        (rig.service.metrics_port, "metrics server", "metrics", "a new one is started", PATIENCE_S),
        (
            rig.service.tcp_address,
            "gateway",
            "gateway",
            "a new one is started",
            _GATEWAY_PATIENCE_S,
        ),
        (
            any(loop.learn != "off" for loop in rig.stellar_loops.values()),
            "learner",
            "learner",
            "a new one is started, and learns from the beginning",
            PATIENCE_S,
        ),
    )
    children = [
        Child(name, [command, *same_rig], folder / f"{command}.err", again, note, patience_s)
        for wanted, name, command, again, patience_s in beside
        if wanted
    ]
    for child in children:
        ends.callback(child.end)
    return children


def _remove_left(folder: Path) -> None:
    for name in _LEFT:
        (folder / name).unlink(missing_ok=True)


def _places(folder: Path, supervisor: Supervisor) -> Places:
    """The file of the places of stars and beams; the supervisor knows what is in it."""
    places = Places(folder)
    supervisor.recall(places.read())
    return places


@contextmanager
def _designer() -> Iterator[ThreadPoolExecutor]:
    """A thread for designs alone: one may take a minute, in which devices must be read, and closed if asked."""
    designer = ThreadPoolExecutor(1, thread_name_prefix="design")
    try:
        yield designer
    finally:
        designer.shutdown(wait=False, cancel_futures=True)
        end_designs()  # the process waits for its threads when it ends


def _loop(
    supervisor: Supervisor,
    service: Service,
    threads: Sequence[PeriodicThread],
    housekeep: Callable[[], None],
    children: Sequence[Child],
    machine: Machine,
    clock: MonotonicClock,
    ending: threading.Event,
) -> None:
    housekeeping_s = clock.now_s() + _HOUSEKEEPING_S
    report = supervisor.report_event
    # A thread for the children alone: that of the devices may wait for a silent one for seconds.
    watcher = ThreadPoolExecutor(1, thread_name_prefix="children")
    try:
        while not (supervisor.shutdown_wanted or ending.is_set()):
            supervisor.step()
            if clock.now_s() >= housekeeping_s:
                housekeeping_s += _HOUSEKEEPING_S
                housekeep()
                for child in children:
                    checked = watcher.submit(child.check)
                    checked.add_done_callback(partial(_report_failure, child.name, report))
                machine.look()
                if not service.is_alive():
                    raise RuntimeError(_DEAF)
                for thread in threads:
                    if thread.error is not None:
                        raise RuntimeError(_STILL) from thread.error
                tell_service_manager(ALIVE, status_line(supervisor.modes_of(supervisor.loops)))
        tell_service_manager(ENDING)
        supervisor.shutdown_wanted = True
        supervisor.stop("shutting down")
        end_s = clock.now_s() + _WIND_DOWN_S
        while clock.now_s() < end_s and not supervisor.at_rest():
            supervisor.step()
    finally:
        try:
            supervisor.close()
        finally:
            watcher.shutdown(cancel_futures=True)


def _keeps_bound(
    rig: Rig, queue: RecordQueue, folder: Path, describe: Callable[[], None]
) -> Callable[[], None]:
    """What makes the recorder's socket, and the description of the rig, anew where they have vanished."""
    path = folder / RECORDS_SOCKET
    file = file_identity(path)
    describe()

    def keep_bound() -> None:
        nonlocal file
        if file_identity(path) != file:
            # Where it cannot be done, the service reports it; the next second may do.
            with suppress(ConfigError, OSError, zmq.ZMQError):
                make_service_folder(rig)
                describe()
                queue.bind_again()
                file = file_identity(path)

    return keep_bound


def _report_failure(
    name: str, report: Callable[[Severity, str, str], None], checked: Future[None]
) -> None:
    error = None if checked.cancelled() else checked.exception()
    if error is not None:
        report("error", name, f"the {name} could not be checked: {type(error).__name__}: {error}")


def run_info(rig: Rig, scheduling: str, now_s: float, designs: Mapping[str, Design]) -> RunInfo:
    """What is needed to understand this run's records; a dark frame's file is read (ConfigError)."""
    dark_file = rig.camera.dark_file
    versions = {name: importlib.metadata.version(name) for name in _VERSIONED}
    return RunInfo(
        time_s=now_s,
        wall_minus_monotonic_s=time.time() - time.monotonic(),
        rig_name=rig.name,
        rig_json=rig.model_dump_json(indent=1),
        versions=versions | {"python": platform.python_version()},
        designs={name: design_json(design) for name, design in designs.items()},
        scheduling=scheduling,
        dark_npy=None if dark_file is None else dark_bytes(Path(dark_file)),
    )
