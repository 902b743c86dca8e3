"""Which logs a command reads: those it is given, or with ``--latest`` the newest run of the rig."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from fitctl.commands.shared.printing import say
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address_or_shipped
from fitctl.config import ConfigError, Rig
from fitctl.logging.listing import find_newest

if TYPE_CHECKING:
    from fitctl.report.gather import Gathered

LatestOption = Annotated[
    bool, typer.Option("--latest", help="Use the newest log of the rig, in place of LOG.")
]


def logging_rig(command: str, rig: Path | None, overrides: list[str] | None = None) -> Rig:
    """The rig whose logs a command reads: ``--rig``, ``FITCTL_RIG``, the running rig, or the shipped one."""
    found = address_or_shipped(command, rig, overrides)
    return rig_of(found.file, found.settings)


def chosen_logs(
    command: str, logs: Sequence[Path] | None, rig: Path | None, *, latest: bool
) -> list[Path]:
    """The logs that a command line names, or with ``--latest`` all files of the newest run of the rig.

    What cannot be read in the rig's folder of logs is named on the error output.

    Raises
    ------
    ConfigError
        If there are both, or neither, or the rig has no log.
    LogError
        If the newest run may be in a log that cannot be read.
    """
    if logs and latest:
        msg = f"{command}: --latest chooses the log; leave out --latest, or {logs[0]}"
        raise ConfigError(msg)
    if logs:
        return list(logs)
    if not latest:
        msg = f"{command}: expected a LOG; name one, or give --latest for the newest log of the rig"
        raise ConfigError(msg)
    settings = logging_rig(command, rig)
    folder = settings.logging.folder_path
    newest = find_newest(folder, settings.name)
    say_unreadable(newest.unreadable)
    if not newest.files:
        msg = (
            f"{command}: --latest: {folder} has no log of rig {settings.name}; name a LOG, or another rig "
            "with --rig"
        )
        raise ConfigError(msg)
    return newest.files


def logs_alone(
    command: str, logs: Sequence[Path] | None, rig: Path | None, *, latest: bool
) -> list[Path]:
    """As :func:`chosen_logs`, for a command that uses a rig only to find its newest log.

    Raises
    ------
    ConfigError
        As there, or if there are a log and a rig.
    """
    if logs and rig is not None:
        msg = f"{command}: --rig is for --latest; leave it out, or {logs[0]}"
        raise ConfigError(msg)
    return chosen_logs(command, logs, rig, latest=latest)


def log_alone(command: str, log: Path | None, rig: Path | None, *, latest: bool) -> Path:
    """As :func:`logs_alone`, for a command that reads one file: with ``--latest`` the newest."""
    return logs_alone(command, None if log is None else [log], rig, latest=latest)[-1]


def say_unreadable(problems: Iterable[str]) -> None:
    """Name the files that could not be read where the newest run was chosen, a line each."""
    for problem in problems:
        say(problem, err=True)


def say_left_out(gathered: Gathered) -> None:
    """Say how many records of a run were not read, because their times are not of it."""
    if gathered.misdated:
        say(
            f"{gathered.run.name}: {gathered.misdated} records are left out: their own time is more than a day "
            "outside the run's; see fitctl log verify",
            err=True,
        )


def chosen_log(command: str, log: Path | None, rig: Path | None, *, latest: bool) -> Path:
    """As :func:`chosen_logs`, for a command that reads one file: with ``--latest`` the newest."""
    return chosen_logs(command, None if log is None else [log], rig, latest=latest)[-1]
