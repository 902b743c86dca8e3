"""`fitctl init`: ask what hardware is there, write a rig file, ask the hardware."""

from __future__ import annotations

import os
import re
import sys
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import typer
from serial.tools import list_ports

from fitctl.commands.set_up.doctor import ask_devices as run_doctor
from fitctl.commands.shared.printing import say, say_lines
from fitctl.commands.shared.welcome import listed
from fitctl.config import ConfigError, Rig, rig_from_document
from fitctl.config.new_rig import (
    DEVICES,
    MOCK,
    ONE_STAR,
    TESTBED,
    Asked,
    Chosen,
    chosen,
    forms,
    new_rig_text,
)
from fitctl.config.rig import RIG_NAME
from fitctl.config.simulated import mixture_warnings

_FORM = "KIND:ADDRESS"
_AMPLIFIERS = "cia402:INTERFACE:CHANNEL, ensemble:PORT, bal_analog:HOST or mock."
_DACS = "tcp:HOST, rtu:PORT or mock."
_PIEZOS = "mdt693:LIMIT:PORT or mock; the stacks' limit, 75, 100 or 150 V."


def _device(text: str) -> Any:
    return typer.Option(metavar=_FORM, help=text)


def init(
    file: Annotated[Path, typer.Argument(help="The rig file to write.")] = Path("my-rig.toml"),
    name: Annotated[str | None, typer.Option(help="Name of the rig. [default: the file's]")] = None,
    testbed: Annotated[
        bool,
        typer.Option("--testbed", help="Two stars, metrology and a collector on a hexapod."),
    ] = False,
    camera: Annotated[str | None, _device("gige:ADDRESS, aravis:ADDRESS or mock.")] = None,
    siderostat: Annotated[str | None, _device(_AMPLIFIERS)] = None,
    dac: Annotated[str | None, _device(_DACS)] = None,
    mdt693: Annotated[str | None, _device(_PIEZOS)] = None,
    metrology_siderostat: Annotated[
        str | None, _device(f"Testbed: left combiner siderostat; {_AMPLIFIERS}")
    ] = None,
    photodiodes: Annotated[str | None, _device("Testbed: labjack_t7:HOST or mock.")] = None,
    left_siderostat: Annotated[
        str | None, _device(f"Testbed: collector siderostat; {_AMPLIFIERS}")
    ] = None,
    left_dac: Annotated[str | None, _device(f"Testbed: {_DACS}")] = None,
    left_mdt693: Annotated[str | None, _device(f"Testbed: {_PIEZOS}")] = None,
    hexapod: Annotated[str | None, _device("Testbed: c887:PORT or mock.")] = None,
    mocks: Annotated[
        bool, typer.Option("--mocks", help="Ask no questions: unnamed devices are mocks.")
    ] = False,
    ask_devices: Annotated[
        bool, typer.Option("--doctor/--no-doctor", help="Check the devices at the end.")
    ] = True,
) -> None:
    """Write a rig file for your hardware.

    Asks for each device that no option names. The rig points one star; with --testbed it is the whole testbed.
    Never overwrites a file. At the end it checks the devices as `fitctl doctor` does; the exit status is 1 if
    one of them differs from the rig file.
    """
    options = {
        "camera": camera,
        "siderostat": siderostat,
        "dac": dac,
        "mdt693": mdt693,
        "metrology-siderostat": metrology_siderostat,
        "photodiodes": photodiodes,
        "left-siderostat": left_siderostat,
        "left-dac": left_dac,
        "left-mdt693": left_mdt693,
        "hexapod": hexapod,
    }
    base = TESTBED if testbed else ONE_STAR
    _require_new(file)
    for device, text in options.items():
        if text and device not in DEVICES[base]:
            msg = (
                f"init: --{device} is a device of the testbed; give --testbed too, or leave it out"
            )
            raise ConfigError(msg)
    given = {
        device: chosen(base, device, text) if text else None
        for device, text in options.items()
        if device in DEVICES[base]
    }
    open_questions = [device for device, choice in given.items() if not choice]
    if open_questions and not mocks:
        _must_be_a_terminal(base, open_questions)
        say("Name your hardware. Press Enter for the value in brackets.")
        _show_serial_ports()
        name = name or typer.prompt("Name of the rig", default=file.stem)
    name = name or file.stem
    if not re.fullmatch(RIG_NAME, name):
        msg = (
            f"init: name {name!r}: expected letters, digits, '_', '.' and '-', at most 41 of them, the first a "
            "letter or digit; give another with --name"
        )
        raise ConfigError(msg)
    devices = {device: choice or Chosen() for device, choice in given.items()}
    text, rig = _made(base, name, devices, str(file))
    for device in [] if mocks else open_questions:
        devices, text, rig = _asked_until_it_fits(base, name, devices, device)
    _write(file, text)
    simulated = [device for device, (kind, _) in devices.items() if kind == MOCK]
    say(f"{file}: written; rig {rig.name}, simulated: {', '.join(simulated) or 'nothing'}")
    status = 0
    all_mocks = len(simulated) == len(devices)
    if ask_devices and not all_mocks:
        status = run_doctor(rig, file, as_json=False)
    else:
        for line in mixture_warnings(rig):
            say(line)
    say_lines(_next(file, simulated, all_mocks=all_mocks))
    raise typer.Exit(status)


def _require_new(file: Path) -> None:
    """Before the first question, refuse a file that exists or cannot be written."""
    try:
        file.lstat()
        msg = f"{file}: exists already, and init never overwrites a file; name another"
    except FileNotFoundError:
        if os.access(file.parent, os.W_OK | os.X_OK):
            return
        msg = (
            f"{file}: cannot be written: {file.parent} is no folder, or one in which you may not write; name "
            "another file"
        )
    except OSError as error:
        msg = f"{file}: cannot be written: {error.strerror}; name another file"
    raise ConfigError(msg)


def _made(base: str, name: str, devices: Mapping[str, Chosen], origin: str) -> tuple[str, Rig]:
    text = new_rig_text(base, name, devices)
    try:
        text.encode()
    except UnicodeEncodeError:
        msg = f"{origin}: an address has bytes that are no UTF-8, expected text; give another"
        raise ConfigError(msg) from None
    return text, rig_from_document(tomllib.loads(text), origin)


def _must_be_a_terminal(base: str, open_questions: list[str]) -> None:
    if sys.stdin.isatty():
        return
    options = "; ".join(
        f"--{device} {' or '.join(forms(base, device))}" for device in open_questions
    )
    msg = (
        "init: needs a terminal to ask questions. Without one, pass --mocks, or name each device: "
        + options
    )
    raise ConfigError(msg)


def _show_serial_ports() -> None:
    for port in sorted(list_ports.comports()):
        say(f"  {port.device}  {port.description}")


def _ask(base: str, device: str) -> Chosen:
    """Ask for a kind, then for its address; an answer KIND:ADDRESS gives both, as in the option."""
    title, hardware = DEVICES[base][device]
    kinds = ", ".join([*hardware, MOCK])
    while True:
        answer = typer.prompt(f"{title} ({kinds})", default=MOCK).strip()
        if answer == MOCK:
            return Chosen()
        if answer in hardware:
            return Chosen(answer, tuple(map(_answer, hardware[answer].asked)))
        try:
            return chosen(base, device, answer)
        except ConfigError:
            say(f"  Expected {kinds}, or {' or '.join(forms(base, device))}; got {answer!r}.")


def _asked_until_it_fits(
    base: str, name: str, devices: Mapping[str, Chosen], device: str
) -> tuple[dict[str, Chosen], str, Rig]:
    """The devices with what is answered about one of them, and the rig that they make."""
    while True:
        more = {**devices, device: _ask(base, device)}
        try:
            return more, *_made(base, name, more, DEVICES[base][device].title)
        except ConfigError as error:
            say_lines("\n".join(f"  {line}" for line in str(error).splitlines()))


def _answer(asked: Asked) -> str:
    """One answer; where only some are possible, none is offered: that choice is the owner's."""
    if not asked.choices:
        return str(typer.prompt(f"  {asked.question}", default=asked.example))
    answer = ""
    while answer not in asked.choices:
        if answer:
            say(f"  Expected one of {', '.join(asked.choices)}; got {answer!r}.")
        answer = typer.prompt(f"  {asked.question}").strip()
    return answer


def _write(path: Path, text: str) -> None:
    try:
        with path.open("x", encoding="utf-8") as file:
            file.write(text)
    except OSError as error:
        msg = f"{path}: cannot be written: {error.strerror}; name another file"
        raise ConfigError(msg) from None


def _next(path: Path, simulated: list[str], *, all_mocks: bool) -> str:
    if all_mocks:
        steps = [(f"fitctl demo --rig {path}", "see it acquire and hold a star")]
    else:
        steps = [
            (f"edit {path}", "geometry, counts and limits of your rig"),
            (f"fitctl check --rig {path}", "list all its mistakes, by key"),
            (f"fitctl doctor --rig {path}", "identify the devices and compare them with it"),
            *((f"fitctl mocks --rig {path}", "the simulated devices") for _ in simulated[:1]),
            (f"fitctl run --rig {path}", "supervise it; it begins in OFF"),
            (f"fitctl console --rig {path}", "attach a console, in another terminal"),
        ]
    return f"Next:\n{listed(steps)}"
