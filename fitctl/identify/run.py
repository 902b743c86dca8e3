"""Experiments carried out: by a running supervisor, or on the virtual clock."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from pathlib import Path

from fitctl.config import Rig
from fitctl.files import open_regular
from fitctl.identify.errors import IdentifyError
from fitctl.logging.folder import log_name
from fitctl.logging.records import AnyRecord
from fitctl.messages.client import Client
from fitctl.messages.commands import AnyCommand, Experiment, Release, Reply, Status
from fitctl.messages.modes import Mode
from fitctl.messages.telemetry import Telemetry
from fitctl.model.drives import Drive, experiment_s
from fitctl.simulation.simulation import Simulation
from fitctl.text import plain

_ACQUIRE_LIMIT_S = 120.0
_SETTLE_S = 5.0  # in vernier, before the loop is opened: what the search left behind decays
_SILENCE_S = 5.0
_FLUSH_SLACK_S = 2.0

Progress = Callable[[float], None]


def hold_on_simulation(simulation: Simulation, loop_name: str, settle_s: float) -> None:
    """Acquire on the virtual clock, and hold the star in VERNIER for `settle_s`.

    Raises
    ------
    IdentifyError
        If the star is not found in time.
    """
    loop = simulation.supervisor.loops[loop_name]
    simulation.acquire()
    while loop.mode is not Mode.VERNIER:
        if simulation.clock.now_s() > _ACQUIRE_LIMIT_S:
            msg = (
                f"the star was not in vernier within {_ACQUIRE_LIMIT_S:g} s; mode {loop.mode.name}"
            )
            raise IdentifyError(msg)
        simulation.run(0.5)
    simulation.run(settle_s)


def on_simulation(
    rig: Rig, loop_name: str, name: str, drives: list[Drive], seed: int, on_progress: Progress
) -> list[AnyRecord]:
    """Acquire on the virtual clock and carry an experiment out; its records.

    Raises
    ------
    IdentifyError
        If the star is not found, or is lost on the way.
    """
    records: list[AnyRecord] = []
    simulation = Simulation(rig, seed, record=records.append, history_s=1.0)
    hold_on_simulation(simulation, loop_name, _SETTLE_S)
    loop = simulation.supervisor.loops[loop_name]
    records.clear()
    reply = simulation.command(Experiment(loop=loop_name, name=name, drives=drives))
    if not reply.accepted:
        raise IdentifyError(reply.text)
    start_s, duration_s = simulation.clock.now_s(), experiment_s(drives)
    while loop.mode is Mode.EXPERIMENT:
        simulation.run(0.5)
        on_progress(min(1.0, (simulation.clock.now_s() - start_s) / duration_s))
    _require_end(loop.mode.name, loop.last_change.reason if loop.last_change else "")
    return records


def on_rig(
    client: Client, rig: Rig, loop_name: str, name: str, drives: list[Drive], on_progress: Progress
) -> list[Path]:
    """Have a running supervisor carry an experiment out; the logs that have it, in their order.

    Raises
    ------
    IdentifyError
        If the supervisor refuses, falls silent, or the star is lost on the way; or if what it names as its
        log is none of this rig and this user.
    ConnectionError
        If no supervisor answers.
    """
    accepted_s = _command(client, Experiment(loop=loop_name, name=name, drives=drives)).time_s
    paths: dict[Path, None] = {}  # in the order in which they were begun
    try:
        telemetry = _followed(
            client, loop_name, accepted_s, experiment_s(drives), on_progress, paths
        )
    except KeyboardInterrupt:
        client.send(Release(loop=loop_name))  # nobody waits for it any more
        raise
    change = next(loop.last_change for loop in telemetry.loops if loop.name == loop_name)
    _require_end(_mode(telemetry, loop_name), change.reason if change else "")
    return written_logs(client, rig, paths)


def written_logs(client: Client, rig: Rig, paths: dict[Path, None]) -> list[Path]:
    """A running supervisor's logs, in their order, once the newest second is on disk.

    `paths` has those of which it was heard before.

    Raises
    ------
    IdentifyError
        If it has no recorder, or if what it names as its log is none of this rig and this user.
    """
    end_s = time.monotonic() + rig.logging.flush_s + _FLUSH_SLACK_S
    while time.monotonic() < end_s:
        hear(client, paths)
    if not paths:
        msg = "the supervisor has no recorder, so there is no log to learn from; see its events"
        raise IdentifyError(msg)
    for path in paths:
        _require_own_log(path, rig.name)
    return list(paths)


def _require_own_log(path: Path, rig_name: str) -> None:
    """Check that what a message names is a log of this rig, and a regular file of this user's."""
    why = ""
    if not log_name(rig_name).fullmatch(path.name):
        why = f"its name is not that of a log of rig {rig_name}"
    else:
        try:
            with open_regular(path) as file:
                owner = os.fstat(file.fileno()).st_uid
            if owner != os.getuid():
                why = f"it belongs to user {owner}"
        except OSError as error:
            why = error.strerror or str(error)
    if why:
        msg = (
            f"the supervisor records to {plain(str(path))}, which is not read: {why}; if you trust the log, "
            "name it with --log"
        )
        raise IdentifyError(msg)


def hear(client: Client, paths: dict[Path, None]) -> Telemetry | None:
    """The next message of a supervisor; which log it writes just now goes to `paths`."""
    telemetry = client.receive(0.5)
    if telemetry is not None and telemetry.recorder is not None:
        paths[Path(telemetry.recorder.path)] = None
    return telemetry


def _followed(
    client: Client,
    loop_name: str,
    accepted_s: float,
    duration_s: float,
    on_progress: Progress,
    paths: dict[Path, None],
) -> Telemetry:
    """Wait until the loop is out of the experiment that the supervisor accepted; the message that says so."""
    start_s = heard_s = time.monotonic()
    while True:
        telemetry = hear(client, paths)
        now_s = time.monotonic()
        if telemetry is None:
            if now_s - heard_s > _SILENCE_S:
                msg = (
                    f"the supervisor has been silent for {_SILENCE_S:g} s; check it, then try again"
                )
                raise IdentifyError(msg)
            continue
        heard_s = now_s
        on_progress(min(1.0, (now_s - start_s) / duration_s))
        # Messages from before the experiment may still be under way.
        since_s = telemetry.time_s - accepted_s
        if since_s >= 0.0 and _mode(telemetry, loop_name) != Mode.EXPERIMENT.name:
            return telemetry


def require_vernier(client: Client, loop_name: str) -> None:
    """Refuse to begin without a star that is held.

    Raises
    ------
    IdentifyError
        If the loop is in another mode.
    ConnectionError
        If no supervisor answers.
    """
    client.send(Status())
    telemetry = client.receive(2.0)
    mode = "unknown" if telemetry is None else _mode(telemetry, loop_name)
    if mode != Mode.VERNIER.name:
        msg = f"loop {loop_name} is in {mode}; an experiment begins in VERNIER: fitctl send acquire"
        raise IdentifyError(msg)


def _command(client: Client, command: AnyCommand) -> Reply:
    reply = client.send(command)
    if not reply.accepted:
        raise IdentifyError(reply.text)
    return reply


def _mode(telemetry: Telemetry, loop_name: str) -> str:
    return next((loop.mode for loop in telemetry.loops if loop.name == loop_name), "unknown")


def _require_end(mode: str, reason: str) -> None:
    if mode not in {Mode.COARSE.name, Mode.VERNIER.name}:
        msg = f"the experiment did not come to its end; mode {mode}: {reason}"
        raise IdentifyError(msg)
