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
        help="Rig file. Without it: FITCTL_RIG, the rig that runs, or fit-mock.toml.",
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
    typer.Option(
        "--remote", metavar="FILE", help="A key file: the rig is on another machine that knows it."
    ),
]
SeedOption = Annotated[
    int, typer.Option(min=0, help="Of the plant's randomness and the star's place.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
LoopOption = Annotated[
    str, typer.Option("--loop", help="One loop by name.", autocompletion=completion.loops)
]
ControllerOption = Annotated[
    str | None,
    typer.Option(
        "--controller",
        metavar="NAME",
        help="eq20, lqg-ltr, minimum-variance, fslq, or a saved file.",
        autocompletion=completion.controllers,
    ),
]
ParentOption = Annotated[
    int | None,
    typer.Option(
        "--parent-pid", hidden=True, help="End when this process is no longer the parent."
    ),
]
