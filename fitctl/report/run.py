"""Which files are one run, and the rig that it was."""

from __future__ import annotations

import json
import os
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from fitctl.config import CONTROLLERS, ConfigError, Rig, is_name, rig_from_log
from fitctl.logging.errors import LogError
from fitctl.logging.listing import find_newest, run_of
from fitctl.logging.reading import LogInfo, logs_of_one_run_each
from fitctl.logging.schemas import designs_of


class Run(NamedTuple):
    """The log of one start of a supervisor, in one file or several.

    Attributes
    ----------
    logs : tuple of LogInfo
        In order of time.
    rig : Rig
        As it was in force.
    start_ns, end_ns : int
        UTC of the first and the last record, nanoseconds since 1970; 0 without records.
    unreadable : tuple of str
        What is wrong with each file that cannot be read in the folder of which this is the newest run.
    """

    logs: tuple[LogInfo, ...]
    rig: Rig
    start_ns: int
    end_ns: int
    unreadable: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """By which people know it: its first file's."""
        return self.logs[0].path.stem

    @property
    def duration_s(self) -> float:
        """From the first record to the last."""
        return (self.end_ns - self.start_ns) / 1e9

    @property
    def metadata(self) -> dict[str, dict[str, str]]:
        """Of the last file."""
        return self.logs[-1].metadata


def find_run(paths: Sequence[Path], rig: Rig | None = None, overrides: Sequence[str] = ()) -> Run:
    """The run that files, or the newest run that a folder holds.

    Parameters
    ----------
    paths : sequence of Path
        Files of one run in any order, or one folder.
    rig : Rig, optional
        In place of the one in the log.
    overrides : sequence of str
        Values to replace in the log's rig, as `--set` takes them; not used with a rig.

    Raises
    ------
    LogError
        If there is no log, one cannot be read or is none of fitctl's, they are of several runs, or the newest
        run of the folder may be in a log that cannot be read.
    ConfigError
        If the rig in the log is none that this fitctl understands, or the given one has other loops or frames.
    """
    unreadable: tuple[str, ...] = ()
    if len(paths) == 1 and os.path.isdir(paths[0]):  # and can be examined
        folder = paths[0]
        paths, unreadable = find_newest(folder)
        if not paths:
            msg = f"{folder}: holds no log of fitctl (*.mcap); name a file, or the rig's logging.folder"
            raise LogError(msg)
    logs = logs_of_one_run_each(paths)
    for log in logs[1:]:
        if _identity(log) != _identity(logs[0]):
            msg = (
                f"{log.path}: is of another run than {logs[0].path}; give the files of one run (fitctl report "
                "--compare puts nights side by side)"
            )
            raise LogError(msg)
    with_records = sorted((log for log in logs if log.counts), key=lambda log: log.start_s)
    logs = with_records or logs[:1]
    if rig is not None:
        _insist_on_loops(rig, logs[-1])
    return Run(
        logs=tuple(logs),
        rig=rig or _rig_of(logs[-1], overrides),
        start_ns=round(logs[0].start_s * 1e9) if with_records else 0,
        end_ns=round(max(log.end_s for log in logs) * 1e9) if with_records else 0,
        unreadable=unreadable,
    )


NO_RIG = (ValueError, TypeError, KeyError, RecursionError)
"""What :func:`unlike_the_log` raises where a log's text is no rig."""


def unlike_the_log(rig: Rig, in_log: str) -> str:
    """Why a rig cannot have recorded a log that has this one, as JSON; empty if it can."""
    then = json.loads(in_log)
    needed = (sorted(then["loops"]), then["camera"]["width_px"], then["camera"]["height_px"])
    given = (sorted(rig.loops), rig.camera.width_px, rig.camera.height_px)
    if given == needed:
        return ""
    return (
        "loops, camera.width_px and camera.height_px must be those of the log, "
        f"{needed}, are {given}"
    )


def _insist_on_loops(rig: Rig, log: LogInfo) -> None:
    try:
        unlike = unlike_the_log(rig, log.metadata["rig"]["json"])
    except NO_RIG:  # the rig that is given stands in for it
        return
    if unlike:
        msg = f"{log.path}: --rig {rig.name}: {unlike}; give the log's own rig file, or leave out --rig"
        raise ConfigError(msg)


def _identity(log: LogInfo) -> tuple[str, ...]:
    if "rig" not in log.metadata:
        msg = f"{log.path}: has no rig in it; name a log that fitctl recorded"
        raise LogError(msg)
    return run_of(log)


def _controllers_of(log: LogInfo) -> list[str]:
    """Overrides that name each logged design by what it is; the file that it came from is never read."""
    overrides = []
    for loop, design in designs_of(log.metadata).items():
        if is_name(loop):
            # A design of the user's own has a name that no rig file may have; the log has its matrices.
            known = design["name"] if design.get("name") in CONTROLLERS else CONTROLLERS[0]
            overrides.append(f"loops.{loop}.vernier.controller={known}")
    return overrides


def _rig_of(log: LogInfo, overrides: Sequence[str]) -> Rig:
    _identity(log)
    try:
        text = log.metadata["rig"]["json"]
        changes = [*_controllers_of(log), *overrides]
        return rig_from_log(text, f"{log.path}: rig file in it", changes)
    except KeyError:
        msg = f"{log.path}: has no rig file in it; give one with --rig"
        raise LogError(msg) from None
