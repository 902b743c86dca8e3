"""Which rig a command is for, and the supervisor that has it."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING

from fitctl.config import ConfigError, Rig, default_rig_path, load_rig

if TYPE_CHECKING:
    from fitctl.messages.client import Client


def rig_of(path: Path | None, overrides: list[str] | None) -> Rig:
    """The rig that the options name.

    Raises
    ------
    ConfigError
        If its file cannot be used.
    """
    return load_rig(path or default_rig_path(), overrides or ())


def with_controller(
    path: Path | None, overrides: list[str] | None, controller: str | None
) -> list[str]:
    """The overrides, and with them one that gives every loop the named controller, if any."""
    if controller is None:
        return overrides or []
    return [*(overrides or []), *of_controller(rig_of(path, overrides).loops, controller)]


def of_controller(loops: Iterable[str], controller: str) -> list[str]:
    """Overrides that give loops a controller to begin with."""
    return [f"loops.{name}.vernier.controller={controller}" for name in loops]


def insist_on_loop(command: str, rig: Rig, loop: str) -> None:
    """Refuse a loop that the rig has not.

    Raises
    ------
    ConfigError
        If so.
    """
    if loop not in rig.loops:
        msg = f"{command}: --loop {loop!r}: rig {rig.name} has {', '.join(rig.loops)}"
        raise ConfigError(msg)


def insist_on_plant(rig: Rig) -> None:
    """Refuse a rig without simulated hardware, or with some that cannot be.

    Raises
    ------
    ConfigError
        If so.
    """
    rig.mock_parts()
    check_plant(rig)


def check_plant(rig: Rig) -> None:
    """See that the rig's simulated hardware, if it has any, can be.

    Raises
    ------
    ConfigError
        If not.
    """
    import numpy as np

    from fitctl.model.plant_constants import plant_constants

    if rig.plant is not None:
        for name in rig.loops:
            plant_constants(rig, name, np.zeros((1, 2)))


def client_of(rig: Rig, remote: Path | None = None) -> Client:
    """A client of the rig's supervisor: on this machine, or where a key file for that rig leads.

    Raises
    ------
    ConfigError
        If no supervisor can be there, or the key file cannot be used or is for another rig.
    """
    from fitctl.messages.client import Client
    from fitctl.messages.endpoints import service_folder
    from fitctl.messages.keys import read_key_of

    return Client(service_folder(rig) if remote is None else read_key_of(rig, remote))


def connect(path: Path | None, overrides: list[str] | None, remote: Path | None) -> Client:
    """A client of the rig's supervisor on this machine, or of the one that a key file is for.

    A key file is enough by itself, and no rig file is read then; one that is given must be for the same rig.

    Raises
    ------
    ConfigError
        If the rig file or the key file cannot be used, or they are for different rigs.
    """
    if remote is None or path is not None:
        return client_of(rig_of(path, overrides), remote)
    if overrides:
        msg = f"--remote {remote}: --set changes a rig file; give that too, with --rig, or leave out --set"
        raise ConfigError(msg)
    from fitctl.messages.client import Client
    from fitctl.messages.keys import read_remote

    return Client(read_remote(remote))
