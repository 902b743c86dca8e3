"""The rig that a command is for."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from fitctl.config import ConfigError, Rig, default_rig_path, load_rig
from fitctl.messages.running import rig_of_environment


def rig_of(path: Path | None, overrides: list[str] | None) -> Rig:
    """The rig that the options name.

    Raises
    ------
    ConfigError
        If its file cannot be used.
    """
    return load_rig(path or default_rig_path(), overrides or ())


def named_rig(path: Path | None) -> Path | None:
    """The rig file that the options name, or else the one that ``FITCTL_RIG`` names."""
    return path or rig_of_environment()


def with_controller(
    path: Path | None, overrides: list[str] | None, controller: str | None
) -> list[str]:
    """The overrides, and with them one that gives every loop the named controller, if any."""
    if controller is None:
        return overrides or []
    loops = rig_of(path, overrides).stellar_loops
    changed = [*(overrides or []), *controller_overrides(loops, controller)]
    with blaming_controller():
        rig_of(path, changed)
    return changed


@contextmanager
def blaming_controller() -> Iterator[None]:
    """Read a rig inside that was well without its :func:`controller_overrides`: errors name the option."""
    try:
        yield
    except ConfigError as error:
        raise ConfigError(str(error).replace("--set: ", "--controller: ", 1)) from None


def controller_overrides(loops: Iterable[str], controller: str) -> list[str]:
    """Overrides that give loops a controller to begin with."""
    return [f"loops.{name}.vernier.controller={controller}" for name in loops]


def require_loop(command: str, rig: Rig, loop: str, loops: Iterable[str] | None = None) -> None:
    """Reject a loop that is none of `loops`; without these, one that is no stellar loop of the rig.

    Raises
    ------
    ConfigError
        If so.
    """
    possible = list(rig.stellar_loops if loops is None else loops)
    if loop not in possible:
        msg = f"{command}: --loop {loop!r}: rig {rig.name} has {', '.join(possible)}"
        raise ConfigError(msg)
