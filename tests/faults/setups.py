"""The rigs on which entries run: which file, and what differs from it."""

from contextlib import ExitStack
from typing import NamedTuple

from system.conftest import NEAR, running

from fitctl.config import default_rig_path

from .watched import WatchedRig


class Setup(NamedTuple):
    """One rig; `home` is the mode to which it comes back."""

    file: str = "fit-mock"
    settings: tuple[str, ...] = ()
    home: str = "VERNIER"


SETUPS = {
    "fit-mock": Setup(),
    "never in reach": Setup(
        settings=("loops.right.coarse.reach_frames=1000000",), home="COARSE"
    ),
    "ensemble": Setup(file="ensemble"),
    "fit-bal-analog": Setup(file="fit-bal-analog"),
}


def start(stack: ExitStack, name, folder):
    """The rig of a name, until the stack is closed."""
    setup = SETUPS[name]
    file = default_rig_path().parent / f"{setup.file}.toml"
    return stack.enter_context(
        running(folder, NEAR, *setup.settings, file=file, kind=WatchedRig)
    )
