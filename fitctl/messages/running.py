"""Which supervisors of this user run on this machine, and with which rigs."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path

import msgspec

from fitctl.config import ConfigError
from fitctl.messages.endpoints import open_folder, supervisor_name, supervisor_names
from fitctl.processes import names_held
from fitctl.text import UNDECODABLE

RUNNING_FILE = "rig.json"  # in the socket folder
_MOST_BYTES = 65536


class RunningRig(msgspec.Struct, frozen=True, kw_only=True):
    """A running supervisor.

    Attributes
    ----------
    name : str
        Of the rig.
    file : str
        The rig file.
    settings : list of str
        ``key.path=value`` texts that replaced values of the file.
    pid : int
    folder : str
        Where its sockets are.
    """

    name: str
    file: str
    settings: list[str]
    pid: int
    folder: str = ""

    @property
    def where(self) -> str:
        """How to address it, and its process, for people."""
        return f"{self.name} (process {self.pid}): --rig {self.file} --set service.folder={self.folder}"


def rig_of_environment() -> Path | None:
    """The rig file that ``FITCTL_RIG`` names, if any."""
    named = os.environ.get("FITCTL_RIG")
    return Path(named) if named else None


def write_running(folder: Path, name: str, file: Path, settings: Sequence[str]) -> None:
    """Leave in the socket folder what runs there; a reader finds all of it or nothing.

    Raises
    ------
    OSError
    """
    running = RunningRig(
        name=name, file=str(file.absolute()), settings=list(settings), pid=os.getpid()
    )
    new = folder / f"{RUNNING_FILE}.new"
    new.write_bytes(msgspec.json.encode(running))
    new.replace(folder / RUNNING_FILE)


def running_rigs() -> list[RunningRig]:
    """Every supervisor of this user that runs, in whatever session and folder.

    A name that another user holds to deceive leads to a folder of ours where one runs, or to none.
    """
    prefix = supervisor_names()
    found = []
    for name in names_held(prefix):
        folder = Path(name.removeprefix(prefix))
        if folder.is_absolute() and (running := _read(folder)) is not None:
            found.append(running)
    return found


def only_running_rig(asking: str) -> RunningRig | None:
    """The one supervisor of this user that runs, None if none does.

    Parameters
    ----------
    asking : str
        Who asks, for the error.

    Raises
    ------
    ConfigError
        If several run; the text names them.
    """
    running = running_rigs()
    if len(running) > 1:
        lines = "".join(f"\n  {rig.where}" for rig in running)
        msg = f"{asking}: {len(running)} supervisors run; nothing was done. Name one:{lines}"
        raise ConfigError(msg)
    return running[0] if running else None


def supervisor_runs(folder: Path) -> bool:
    """Whether a supervisor of this user runs with its sockets in this folder, as its lock says."""
    return supervisor_name(folder) in names_held(supervisor_names())


def running_rig(folder: Path) -> RunningRig | None:
    """The supervisor of this user that runs with its sockets in this folder; None if none does."""
    return _read(folder) if supervisor_runs(folder) else None


def _read(folder: Path) -> RunningRig | None:
    """What runs in a folder; None if the folder is not ours, or what was left there is of a dead process."""
    try:
        opened = open_folder(folder)
    except (OSError, ConfigError):
        return None
    try:
        file = os.open(RUNNING_FILE, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC, dir_fd=opened)
        with open(file, "rb") as reading:
            running = msgspec.json.decode(reading.read(_MOST_BYTES), type=RunningRig)
        os.kill(running.pid, 0)
    except (OSError, *UNDECODABLE):
        return None
    finally:
        os.close(opened)
    return msgspec.structs.replace(running, folder=str(folder))
