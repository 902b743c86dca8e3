"""Options that many commands have."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from fitctl.commands.shared import completion


def _rig_option(default: str) -> Any:
    """Which rig, and which one without the option: see "Which rig a command addresses" in docs/operating.md."""
    return typer.Option(
        "--rig",
        metavar="FILE",
        help=f"Rig file. [default: {default}]",
        autocompletion=completion.rigs,
    )


RigOption = Annotated[
    Path | None, _rig_option("FITCTL_RIG, the running rig, or with --set fit-mock.toml")
]
OwnRigOption = Annotated[Path | None, _rig_option("FITCTL_RIG, or fit-mock.toml")]
ShippedRigOption = Annotated[Path | None, _rig_option("fit-mock.toml")]
DesignedRigOption = Annotated[
    Path | None, _rig_option("fit-mock.toml, or for learn the rig in the log")
]
SetOption = Annotated[
    list[str] | None,
    typer.Option(
        "--set", metavar="KEY=VALUE", help="Replace a value of the rig file; may be repeated."
    ),
]
OverwriteOption = Annotated[bool, typer.Option("--overwrite", help="Overwrite an existing file.")]
RemoteOption = Annotated[
    Path | None,
    typer.Option("--remote", metavar="FILE", help="Key file of a rig on another machine."),
]
SeedOption = Annotated[
    int, typer.Option(min=0, help="Seed of the plant's noise and the star's position.")
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
JsonArrayOption = Annotated[bool, typer.Option("--json", help="Print one JSON array of the logs.")]
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
