"""Command lines about a rig as such: its file, and the hardware that it describes."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.choosing import check_plant, rig_of
from fitctl.commands.options import JsonOption, RigOption, SetOption
from fitctl.config import default_rig_path

_DEVICE_SAID = "KIND:ADDRESS"


def init(
    file: Annotated[Path, typer.Argument(help="The rig file to write.")] = Path("my-rig.toml"),
    name: Annotated[str | None, typer.Option(help="Of the rig; by default the file's.")] = None,
    camera: Annotated[
        str | None, typer.Option(metavar=_DEVICE_SAID, help="gige:ADDRESS, aravis:ADDRESS or mock.")
    ] = None,
    siderostat: Annotated[
        str | None,
        typer.Option(
            metavar=_DEVICE_SAID,
            help="cia402:INTERFACE:CHANNEL, ensemble:PORT, bal_analog:HOST or mock.",
        ),
    ] = None,
    dac: Annotated[
        str | None, typer.Option(metavar=_DEVICE_SAID, help="tcp:HOST, rtu:PORT or mock.")
    ] = None,
    mdt693: Annotated[
        str | None, typer.Option(metavar=_DEVICE_SAID, help="mdt693:PORT or mock.")
    ] = None,
    mocks: Annotated[
        bool, typer.Option("--mocks", help="Ask nothing: what is not said is a mock.")
    ] = False,
    ask_devices: Annotated[
        bool, typer.Option("--doctor/--no-doctor", help="Ask the devices at the end.")
    ] = True,
) -> None:
    """Write a rig file of your own: asks what hardware is there, or is told by options.

    Nothing is overwritten. At the end the devices are asked who they are, as `fitctl doctor` does; the exit
    status is 1 if one disagrees.
    """
    from fitctl.commands.init import run_init

    said = {"camera": camera, "siderostat": siderostat, "dac": dac, "mdt693": mdt693}
    raise typer.Exit(run_init(file, name, said, mocks=mocks, ask_devices=ask_devices))


def check(rig: RigOption = None, overrides: SetOption = None) -> None:
    """Read a rig file and say whether it is well."""
    settings = rig_of(rig, overrides)
    check_plant(settings)
    loops = ", ".join(settings.loops)
    typer.echo(f"{rig or default_rig_path()}: well; rig {settings.name}, loops {loops}")


def doctor(rig: RigOption = None, overrides: SetOption = None, as_json: JsonOption = False) -> None:
    """Ask every device of the rig who it is; nothing is set, nothing moves.

    Exit status 1 if one is missing or is not as the rig file says.
    """
    from fitctl.commands.doctor import run_doctor

    raise typer.Exit(run_doctor(rig_of(rig, overrides), as_json=as_json))


def discover(
    broadcast: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Where cameras are asked to say who they are.")
    ] = "255.255.255.255",
    wait_s: Annotated[
        float, typer.Option("--wait", min=0.01, max=60.0, help="For their answers, seconds.")
    ] = 1.0,
    as_json: JsonOption = False,
) -> None:
    """List cameras, serial ports and CAN interfaces. Cameras are asked by a broadcast."""
    from fitctl.commands.doctor import run_discover

    run_discover(broadcast, wait_s, as_json=as_json)
