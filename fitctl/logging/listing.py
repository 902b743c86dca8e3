"""The logs in a folder, by their start, and the newest run of a rig."""

from __future__ import annotations

import math
from pathlib import Path
from typing import NamedTuple

from fitctl.logging.errors import LogError, NoLogError
from fitctl.logging.files import COPY
from fitctl.logging.reading import LogInfo, log_info


def logs_in(folder: Path) -> tuple[list[LogInfo], dict[Path, LogError]]:
    """The logs in a folder that can be read, oldest first, and for each other one what is wrong."""
    logs, problems = [], {}
    for path in sorted(folder.glob("*.mcap")):
        try:
            logs.append(log_info(path))
        except LogError as error:
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

    Names are not compared: a log counts by its first record, whatever its file is called. What `fitctl log`
    cut or recovered counts only where none of the run's own files is left; a log that it merged from several
    runs does not count, nor does a file that cannot be read.

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
    run = [log for log in logs if run_of(log) == run_of(logs[-1])]
    files = [log.path for log in recorded(run)]
    last_s = max(map(_written_s, files), default=math.inf)
    for path, problem in problems.items():
        if not isinstance(problem, NoLogError) and _written_s(path) > last_s:
            msg = f"{problem}. It was written after {files[-1]}, so the newest run may be in it; name a LOG"
            raise LogError(msg)
    return NewestRun(files, tuple(map(str, problems.values())))


def _written_s(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:  # deleted a moment ago
        return -math.inf


def recorded(run: list[LogInfo]) -> list[LogInfo]:
    """The logs of a run that its recorders wrote; where only copies are left that `fitctl log` made, these."""
    return [log for log in run if COPY not in log.metadata] or run
