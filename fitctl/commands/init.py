"""`fitctl init`: ask what hardware is there, write a rig file, ask the hardware."""

from __future__ import annotations

import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path

import typer

from fitctl.commands.welcome import listed
from fitctl.config import ConfigError, rig_from_document
from fitctl.config.new_rig import DEVICES, MOCK, Chosen, chosen, forms, new_rig_text

TITLES = {
    "camera": "Camera",
    "siderostat": "Amplifiers of the siderostat",
    "dac": "D/A converter of the mirror",
    "mdt693": "MDT693 piezo amplifier",
}


def run_init(
    path: Path, name: str | None, said: Mapping[str, str | None], *, mocks: bool, ask_devices: bool
) -> int:
    """Write a rig file and let `fitctl doctor` look at it; returns the exit status.

    Parameters
    ----------
    path : Path
        Must not exist.
    name : str or None
        Of the rig; None is the file's own.
    said : mapping
        For each of `DEVICES`, ``KIND:ANSWER``, ``mock``, or None, which is asked on a terminal.
    mocks : bool
        What is not said is a mock.
    ask_devices : bool
        Whether devices that are no mocks are asked who they are.

    Raises
    ------
    ConfigError
        If the file exists or cannot be written, or something is not said and nobody can be asked.
    """
    if path.exists():
        msg = f"{path}: is there already, and init overwrites nothing; name another file"
        raise ConfigError(msg)
    given = {device: text and chosen(device, text) for device, text in said.items()}
    open_questions = [device for device, choice in given.items() if not choice]
    if open_questions and not mocks:
        _must_be_a_terminal(open_questions)
        typer.echo("What hardware is there? Enter takes what stands in brackets.")
        _show_serial_ports()
        name = name or typer.prompt("Name of the rig", default=path.stem)
    devices = {
        device: choice or (Chosen() if mocks else _ask(device)) for device, choice in given.items()
    }
    text = new_rig_text(name or path.stem, devices)
    rig = rig_from_document(tomllib.loads(text), str(path))
    _write(path, text)
    simulated = [device for device, (kind, _) in devices.items() if kind == MOCK]
    typer.echo(f"{path}: written; rig {rig.name}, simulated: {', '.join(simulated) or 'nothing'}")
    status = 0
    if ask_devices and len(simulated) < len(devices):
        from fitctl.commands.doctor import run_doctor

        status = run_doctor(rig, as_json=False)
    typer.echo(_next(path, simulated))
    return status


def _must_be_a_terminal(open_questions: list[str]) -> None:
    if sys.stdin.isatty():
        return
    options = "; ".join(f"--{device} {' or '.join(forms(device))}" for device in open_questions)
    msg = f"init: nobody is there to be asked; give --mocks, or: {options}"
    raise ConfigError(msg)


def _show_serial_ports() -> None:
    from serial.tools import list_ports

    for port in sorted(list_ports.comports()):
        typer.echo(f"  {port.device}  {port.description}")


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
