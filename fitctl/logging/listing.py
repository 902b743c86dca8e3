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


def newest_run(folder: Path, rig: str) -> list[Path]:
    """All files of the newest run of a rig, oldest first, as ``--latest`` chooses them.

    Names are not compared: a log counts by its first record, whatever its file is called. What `fitctl log`
    cut, merged or recovered counts only where none of the run's own files is left.

    Parameters
    ----------
    folder : Path
        Folder of logs, `logging.folder` of the rig file.
    rig : str
        Name of the rig.

    Returns
    -------
    list of Path
        Empty if the folder has no log of this rig.
    """
    of_rig = [log for log in logs_in(folder)[0] if log.counts and rig_name(log) == rig]
    if not of_rig:
        return []
    clock = of_rig[-1].metadata.get("clock")
    run = [log for log in of_rig if log.metadata.get("clock") == clock]
    return [log.path for log in recorded(run)]


def recorded(run: list[LogInfo]) -> list[LogInfo]:
    """The logs of a run that its recorders wrote; where only copies are left that `fitctl log` made, these."""
    return [log for log in run if COPY not in log.metadata] or run
