"""`fitctl fault`: its command line; what it does is in :mod:`fitctl.commands.fault`, slow to import."""

from __future__ import annotations

from typing import Annotated

import typer

from fitctl.commands import completing
from fitctl.commands.choosing import rig_of
from fitctl.commands.options import RigOption, SetOption

app = typer.Typer(help="Make something go wrong with running mock devices.", no_args_is_help=True)

DeviceArgument = Annotated[
    str,
    typer.Argument(
        help="camera, or a loop's drive, dac or mdt693, such as right.mdt693.",
        autocompletion=completing.devices,
    ),
]
PartOption = Annotated[str, typer.Option(help="Of the device, where the kind has parts.")]


@app.command("set")
def set_(
    device: DeviceArgument,
    kind: Annotated[
        str,
        typer.Argument(help="`fitctl fault kinds` lists them.", autocompletion=completing.faults),
    ],
    value: Annotated[float | None, typer.Argument(help="In the kind's unit.")] = None,
    part: PartOption = "",
    for_s: Annotated[
        float | None, typer.Option("--for", metavar="SECONDS", help="Without it, until cleared.")
    ] = None,
    probability: Annotated[float, typer.Option(help="That it hits, each time.")] = 1.0,
    rig: RigOption = None,
    overrides: SetOption = None,
) -> None:
    """Begin a fault."""
    from fitctl.commands.fault import change_faults
    from fitctl.mocks.bench import SetFault

    wanted = SetFault(device, kind, part, value, for_s, probability)
    change_faults(rig_of(rig, overrides), wanted)


@app.command("clear")
def clear(
    device: Annotated[
        str, typer.Argument(help="Without it, all devices.", autocompletion=completing.devices)
    ] = "",
    kind: Annotated[str, typer.Argument(help="Without it, all kinds.")] = "",
    part: PartOption = "",
    rig: RigOption = None,
    overrides: SetOption = None,
) -> None:
    """End faults."""
    from fitctl.commands.fault import change_faults
    from fitctl.mocks.bench import ClearFaults

    change_faults(rig_of(rig, overrides), ClearFaults(device, kind, part))


@app.command("now")
def now(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Print what is wrong now."""
    from fitctl.commands.fault import change_faults
    from fitctl.mocks.bench import ListFaults

    change_faults(rig_of(rig, overrides), ListFaults())


@app.command("kinds")
def kinds_() -> None:
    """Print what can go wrong with each device."""
    from fitctl.commands.fault import list_kinds

    list_kinds()
