"""The logs in a folder, by their start, and the newest run of a rig."""

from __future__ import annotations

import math
import os
from pathlib import Path
from typing import NamedTuple

from fitctl.logging.errors import LogError, NoLogError
from fitctl.logging.files import COPY, RECOVERED
from fitctl.logging.reading import LogInfo, log_info
from fitctl.text import plain


def logs_in(folder: Path) -> tuple[list[LogInfo], dict[Path, LogError]]:
    """The logs in a folder that can be read, oldest first, and for each other one what is wrong."""
    logs, problems = [], {}
    for path in sorted(folder.glob("*.mcap")):
        try:
            logs.append(log_info(path))
        except LogError as error:
            if os.path.lexists(path):  # else deleted a moment ago
                problems[path] = error
    return sorted(logs, key=lambda log: log.start_s if log.counts else 0.0), problems


def rig_name(log: LogInfo) -> str:
    """The name of the rig that a log is of; empty for a log that fitctl did not record."""
    return log.metadata.get("rig", {}).get("name", "")


def run_of(log: LogInfo) -> tuple[str, ...]:
    """The same for all files of a run: rig, and the two clocks at its start."""
    return rig_name(log), *log.metadata.get("clock", {}).values()


class NewestRun(NamedTuple):
    """The newest run in a folder.

    Attributes
    ----------
    files : list of Path
        Oldest first; empty if the folder has no log of the rig.
    unreadable : tuple of str
        What is wrong with each file of the folder that cannot be read, of whichever run it is.
    """

    files: list[Path]
    unreadable: tuple[str, ...]


def newest_run(folder: Path, rig: str | None = None) -> list[Path]:
    """All files of the newest run of a rig, oldest first; arguments and error as of :func:`find_newest`."""
    return find_newest(folder, rig).files


def find_newest(folder: Path, rig: str | None = None) -> NewestRun:
    """The newest run of a rig, as ``--latest`` chooses it, and what cannot be read beside it.

    Names are not compared: a log counts by its first record, whatever its file is called. A file that cannot
    be read does not count; what `fitctl log recover` saved of it counts in its place. Otherwise, what
    `fitctl log` cut or recovered counts only where none of the run's own files is left, and a log that it
    merged from several runs does not count.

    Parameters
    ----------
    folder : Path
        Folder of logs, `logging.folder` of the rig file.
    rig : str, optional
        Name of the rig; without it, of whichever rig the newest run is.

    Returns
    -------
    NewestRun

    Raises
    ------
    LogError
        If a log that cannot be read was written after this run: the newest run may be in it.
    """
    readable, problems = logs_in(folder)
    logs = [
        log
        for log in readable
        if log.counts and log.runs <= 1 and "rig" in log.metadata and rig in {None, rig_name(log)}
    ]
    saved = {_recovered_from(log) for log in readable} & {plain(path.name) for path in problems}
    run = [log for log in logs if run_of(log) == run_of(logs[-1])]
    files = [log.path for log in _without_copies(run, saved)]
    last_s = max(map(_written_s, files), default=math.inf)
    for path, problem in problems.items():
        may_be_newest = _written_s(path) > last_s and plain(path.name) not in saved
        if may_be_newest and not isinstance(problem, NoLogError):
            msg = f"{problem}. It was written after {files[-1]}, so the newest run may be in it; name a LOG"
            raise LogError(msg)
    return NewestRun(files, tuple(map(str, problems.values())))


def _written_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # deleted a moment ago
        return -math.inf


def _without_copies(run: list[LogInfo], saved: set[str]) -> list[LogInfo]:
    """The logs of a run that its recorders wrote, and what was recovered of files that cannot be read.

    Where only other copies are left that `fitctl log` made, these.
    """
    kept = [log for log in run if COPY not in log.metadata or _recovered_from(log) in saved]
    return kept or run


def _recovered_from(log: LogInfo) -> str:
    return plain(log.metadata.get(COPY, {}).get(RECOVERED, ""))
