"""Options that many commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.shared import completion

RigOption = Annotated[
    Path | None,
    typer.Option(
        "--rig",
        metavar="FILE",
        help="Rig file. [default: FITCTL_RIG, the running rig, or fit-mock.toml]",
        autocompletion=completion.rigs,
    ),
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Replace a value of the rig file; may be repeated."
    ),
]
RemoteOption = Annotated[
    Path | None,
    typer.Option("--remote", metavar="FILE", help="Key file of a rig on another machine."),
]
SeedOption = Annotated[
    int, typer.Option(min=0, help="Seed of the plant's noise and the star's position.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
LoopOption = Annotated[
    str, typer.Option("--loop", help="Name of one loop.", autocompletion=completion.loops)
]
ControllerOption = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="eq20, lqg-ltr, minimum-variance, fslq, or a file (*.json, *.py).",
        autocompletion=completion.controllers,
    ),
]
ParentOption = Annotated[
    int | None,
    typer.Option(
        "--parent-pid", hidden=True, help="End when this process is no longer the parent."
    ),
]
