"""How a command finds the supervisor that it is for."""

from __future__ import annotations

from pathlib import Path

from fitctl.commands.options import rig_of
from fitctl.config import ConfigError
from fitctl.supervisor.client import Client
from fitctl.supervisor.endpoints import service_folder
from fitctl.supervisor.keys import read_remote


def connect(path: Path | None, overrides: list[str] | None, remote: Path | None) -> Client:
    """A client of the rig's supervisor on this machine, or of the one that a key file is for.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used.
    """
    if remote is None:
        return Client(service_folder(rig_of(path, overrides)))
    if path is not None or overrides:
        msg = f"--remote {remote}: the key file says which rig; leave out --rig and --set"
        raise ConfigError(msg)
    return Client(read_remote(remote))
