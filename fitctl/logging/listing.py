"""The logs in a folder, by their start, and the newest run of a rig."""

from __future__ import annotations

from pathlib import Path

from fitctl.logging.errors import LogError
from fitctl.logging.files import COPY
from fitctl.logging.reading import LogInfo, log_info


def logs_in(folder: Path) -> tuple[list[LogInfo], list[str]]:
    """The logs in a folder that can be read, oldest first, and for each other one what is wrong."""
    logs, problems = [], []
    for path in sorted(folder.glob("*.mcap")):
        try:
            logs.append(log_info(path))
        except LogError as error:
            problems.append(str(error))
    return sorted(logs, key=lambda log: log.start_s if log.counts else 0.0), problems


def rig_name(log: LogInfo) -> str:
    """The name of the rig that a log is of; empty for a log that fitctl did not record."""
    return log.metadata.get("rig", {}).get("name", "")


def run_of(log: LogInfo) -> tuple[str, ...]:
    """The same for all files of a run: rig, and the two clocks at its start."""
    return rig_name(log), *log.metadata.get("clock", {}).values()


def newest_run(folder: Path, rig: str | None = None) -> list[Path]:
    """All files of the newest run of a rig, oldest first, as ``--latest`` chooses them.

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
    list of Path
        Empty if the folder has no log of this rig.
    """
    logs = [
        log
        for log in logs_in(folder)[0]
        if log.counts and log.runs <= 1 and "rig" in log.metadata and rig in {None, rig_name(log)}
    ]
    run = [log for log in logs if run_of(log) == run_of(logs[-1])]
    return [log.path for log in recorded(run)]


def recorded(run: list[LogInfo]) -> list[LogInfo]:
    """The logs of a run that its recorders wrote; where only copies are left that `fitctl log` made, these."""
    return [log for log in run if COPY not in log.metadata] or run
