"""`fitctl fault`: make something go wrong with running mock devices."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import msgspec
import typer

from fitctl.commands.shared import completion
from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.fault_kinds import kinds
from fitctl.commands.shared.options import JsonOption, RigOption, SetOption
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import rig_of
from fitctl.commands.shared.supervisor import address_or_shipped, show_rig
from fitctl.config import ConfigError, Rig
from fitctl.messages.endpoints import service_folder
from fitctl.messages.running import running_rigs
from fitctl.mocks.bench import ActiveFault, ClearFaults, FaultsNow, ListFaults, SetFault, ask_bench

app = typer.Typer(help="Inject faults into running mocks.")

DeviceArgument = Annotated[
    str,
    typer.Argument(
        help="camera, hexapod, or LOOP.PART such as right.mdt693, where PART is drive, adapter (CAN), dac, "
        "mdt693 or labjack.",
        autocompletion=completion.devices,
    ),
]
PartOption = Annotated[str, typer.Option(help="Part of the device, for kinds that have parts.")]


@app.command("set")
def set_(
    device: DeviceArgument,
    kind: Annotated[
        str,
        typer.Argument(help="`fitctl fault kinds` lists them.", autocompletion=completion.faults),
    ],
    value: Annotated[float | None, typer.Argument(help="In the unit of the kind.")] = None,
    part: PartOption = "",
    for_s: Annotated[
        float | None,
        typer.Option(
            "--for",
            min=0.001,
            metavar="SECONDS",
            help="End the fault after this time. [default: when cleared]",
        ),
    ] = None,
    probability: Annotated[
        float,
        typer.Option(min=0.0, max=1.0, help="Probability that the fault hits a message or frame."),
    ] = 1.0,
    rig: RigOption = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """Start a fault.

    The mocks print which faults act afterwards. `fitctl fault kinds` lists the kinds of each device.
    """
    _change(
        rig, overrides, SetFault(device, kind, part, value, for_s, probability), as_json=as_json
    )


@app.command("clear")
def clear(
    device: Annotated[
        str, typer.Argument(help="[default: all devices]", autocompletion=completion.devices)
    ] = "",
    kind: Annotated[str, typer.Argument(help="[default: all kinds]")] = "",
    part: PartOption = "",
    rig: RigOption = None,
    overrides: SetOption = None,
    as_json: JsonOption = False,
) -> None:
    """End faults of one device, or of all devices."""
    _change(rig, overrides, ClearFaults(device, kind, part), as_json=as_json)


@app.command("now")
def now(rig: RigOption = None, overrides: SetOption = None, as_json: JsonOption = False) -> None:
    """Show the faults that act now."""
    _change(rig, overrides, ListFaults(), as_json=as_json)


@app.command("kinds")
def kinds_(as_json: JsonOption = False) -> None:
    """List the kinds of fault of each device."""
    if as_json:
        document = {
            device: {name: kind._asdict() for name, kind in table.items()}
            for device, table in kinds().items()
        }
        say(to_json(document))
        return
    for device, table in kinds().items():
        say(device)
        for name, kind in table.items():
            value = f" [{kind.value:g} {kind.unit}]" if kind.unit else ""
            parts = f" ({', '.join(kind.parts)})" if kind.parts else ""
            say(f"  {name:<18} {kind.text}{value}{parts}")


def _as_running(rig: Rig, overrides: list[str] | None) -> Rig:
    """The rig as the supervisor in its socket folder runs it, which knows the port of a demo's mocks.

    A port that is given on the command line is used as it is.
    """
    given = any(text.startswith("mocks.bench_port=") for text in overrides or ())
    folder = service_folder(rig)
    running = () if given else running_rigs()
    return next(
        (rig_of(Path(r.file), r.settings) for r in running if Path(r.folder) == folder), rig
    )


def _change(
    path: Path | None,
    overrides: list[str] | None,
    question: SetFault | ClearFaults | ListFaults,
    *,
    as_json: bool,
) -> None:
    """Change or list faults of the mocks of a rig, and print the rig and the faults that remain.

    Raises
    ------
    ConfigError
        If no mocks answer, they are of another rig, or they have no such fault.
    """
    found = address_or_shipped("fault", path, overrides)
    rig = _as_running(rig_of(found.file, found.settings), overrides)
    _, mocks = rig.mock_parts()
    port = mocks.bench_port
    if not port:
        msg = "fault: mocks.bench_port is 0; give the port that the mocks printed: --set mocks.bench_port=PORT"
        raise ConfigError(msg)
    try:
        now = ask_bench(port, msgspec.structs.replace(question, rig=rig.name), FaultsNow)
    except ConnectionError as error:
        say(
            f"fault: {error}; start fitctl mocks, or give its port: --set mocks.bench_port=PORT",
            err=True,
        )
        raise typer.Exit(FAILED) from None
    if now.rig != rig.name:
        msg = (
            f"fault: nothing was changed: at 127.0.0.1:{port} are the mocks of rig {now.rig}, and {found.file} "
            f"is of rig {rig.name}; name the rig file with --rig, or the port with --set mocks.bench_port=PORT"
        )
        raise ConfigError(msg)
    show_rig(rig.name, f"{found.file}, mocks at 127.0.0.1:{port}")
    if now.error:
        msg = f"fault: {now.error}"
        raise ConfigError(msg)
    if as_json:
        say(to_json(now.active))
        return
    for line in map(_line, now.active):
        say(line)
    if not now.active:
        say("all is well")


def _line(fault: ActiveFault) -> str:
    words = [fault.device, fault.kind]
    words += [str(each) for each in (fault.part, fault.value) if each not in {"", None}]
    if fault.for_s is not None:
        words.append(f"for {fault.for_s:g} s")
    if fault.probability != 1:
        words.append(f"probability {fault.probability:g}")
    return " ".join(words)
