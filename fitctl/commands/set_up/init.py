"""`fitctl init`: ask what hardware is there, write a rig file, ask the hardware."""

from __future__ import annotations

import sys
import tomllib
from pathlib import Path
from typing import Annotated

import typer
from serial.tools import list_ports

from fitctl.commands.set_up.doctor import ask_devices as run_doctor
from fitctl.commands.shared.printing import say, say_lines
from fitctl.commands.shared.welcome import listed
from fitctl.config import ConfigError, rig_from_document
from fitctl.config.new_rig import DEVICES, MOCK, Chosen, chosen, forms, new_rig_text

TITLES = {
    "camera": "Camera",
    "siderostat": "Amplifiers of the siderostat",
    "dac": "D/A converter of the mirror",
    "mdt693": "MDT693 piezo amplifier",
}
_FORM = "KIND:ADDRESS"


def init(
    file: Annotated[Path, typer.Argument(help="The rig file to write.")] = Path("my-rig.toml"),
    name: Annotated[str | None, typer.Option(help="Of the rig; by default the file's.")] = None,
    camera: Annotated[
        str | None, typer.Option(metavar=_FORM, help="gige:ADDRESS, aravis:ADDRESS or mock.")
    ] = None,
    siderostat: Annotated[
        str | None,
        typer.Option(
            metavar=_FORM,
            help="cia402:INTERFACE:CHANNEL, ensemble:PORT, bal_analog:HOST or mock.",
        ),
    ] = None,
    dac: Annotated[
        str | None, typer.Option(metavar=_FORM, help="tcp:HOST, rtu:PORT or mock.")
    ] = None,
    mdt693: Annotated[str | None, typer.Option(metavar=_FORM, help="mdt693:PORT or mock.")] = None,
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
    options = {"camera": camera, "siderostat": siderostat, "dac": dac, "mdt693": mdt693}
    if file.exists():
        msg = f"{file}: is there already, and init overwrites nothing; name another file"
        raise ConfigError(msg)
    given = {device: text and chosen(device, text) for device, text in options.items()}
    open_questions = [device for device, choice in given.items() if not choice]
    if open_questions and not mocks:
        _must_be_a_terminal(open_questions)
        say("What hardware is there? Enter takes what stands in brackets.")
        _show_serial_ports()
        name = name or typer.prompt("Name of the rig", default=file.stem)
    devices = {
        device: choice or (Chosen() if mocks else _ask(device)) for device, choice in given.items()
    }
    text = new_rig_text(name or file.stem, devices)
    rig = rig_from_document(tomllib.loads(text), str(file))
    _write(file, text)
    simulated = [device for device, (kind, _) in devices.items() if kind == MOCK]
    say(f"{file}: written; rig {rig.name}, simulated: {', '.join(simulated) or 'nothing'}")
    status = 0
    if ask_devices and len(simulated) < len(devices):
        status = run_doctor(rig, as_json=False)
    say_lines(_next(file, simulated))
    raise typer.Exit(status)


def _must_be_a_terminal(open_questions: list[str]) -> None:
    if sys.stdin.isatty():
        return
    options = "; ".join(f"--{device} {' or '.join(forms(device))}" for device in open_questions)
    msg = (
        "init: needs a terminal to ask questions. Without one, pass --mocks, or name each device: "
        + options
    )
    raise ConfigError(msg)


def _show_serial_ports() -> None:
    for port in sorted(list_ports.comports()):
        say(f"  {port.device}  {port.description}")


def _ask(device: str) -> Chosen:
    kinds = [*DEVICES[device], MOCK]
    kind = ""
    while kind not in kinds:
        kind = typer.prompt(f"{TITLES[device]} ({', '.join(kinds)})", default=MOCK)
    if kind == MOCK:
        return Chosen()
    asked = DEVICES[device][kind].asked
    return Chosen(kind, tuple(typer.prompt(f"  {a.question}", default=a.example) for a in asked))


def _write(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}; name another file"
        raise ConfigError(msg) from None


def _next(path: Path, simulated: list[str]) -> str:
    if len(simulated) == len(DEVICES):
        steps = [(f"fitctl demo --rig {path}", "see it acquire and hold a star")]
    else:
        steps = [
            (f"edit {path}", "geometry, counts and limits of your rig"),
            (f"fitctl check --rig {path}", "every mistake in it, by key"),
            (f"fitctl doctor --rig {path}", "who the devices are, and what disagrees"),
            *((f"fitctl mocks --rig {path}", "the simulated devices") for _ in simulated[:1]),
            (f"fitctl run --rig {path}", "supervise it; it begins in OFF"),
            (f"fitctl console --rig {path}", "attach a console, in another terminal"),
        ]
    return f"Next:\n{listed(steps)}"
