"""A rig file of one's own: the shipped one, comments and all, with the hardware that is there put in."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from fitctl.config.base import ConfigError
from fitctl.config.reading import lay_over
from fitctl.config.rig import default_rig_path

MOCK = "mock"
_LOOP = "loops.right"
_RULE = "# -----"
_HEAD = """written by `fitctl init` from the shipped rig.
#
# Every value that fitctl uses is here; there are no hidden defaults. Units are in the names. Devices are as
# asked; all else, such as geometry, counts and limits, is still that of the shipped rig and must be made true
# of yours: docs/wiring-a-rig.md goes through it. `fitctl check` reads this file, `fitctl doctor` asks the
# devices. A value marked "choice" is open; "Eq." and "Fig." refer to the FIT pointing paper.
"""


class Asked(NamedTuple):
    """A key that only the rig's owner knows.

    Attributes
    ----------
    key : str
    question : str
    example : str
        What it may look like; offered, and never taken unasked.
    """

    key: str
    question: str
    example: str


class Hardware(NamedTuple):
    """One kind of a device.

    Attributes
    ----------
    asked : tuple of Asked
    fixed : tuple of key and value
        What follows from the kind.
    over : str
        The shipped rig file that has this kind; empty where the default rig has it.
    """

    asked: tuple[Asked, ...]
    fixed: tuple[tuple[str, Any], ...] = ()
    over: str = ""


_ADDRESS = Asked("camera.device.address", "Its IPv4 address", "192.168.1.20")
_DRIVE = f"{_LOOP}.siderostat.device"
_DAC = f"{_LOOP}.fsm.dac"
_MODBUS_PORT = 502  # that stations have; mocks listen elsewhere

DEVICES: dict[str, dict[str, Hardware]] = {
    "camera": {
        "gige": Hardware((_ADDRESS,), (("camera.device.driver", "gige"),)),
        "aravis": Hardware((_ADDRESS,), (("camera.device.driver", "aravis"),)),
    },
    "siderostat": {
        "cia402": Hardware(
            (
                Asked(f"{_DRIVE}.interface", "CAN interface, as python-can calls it", "socketcan"),
                Asked(f"{_DRIVE}.channel", "Its channel", "can0"),
            )
        ),
        "ensemble": Hardware(
            (Asked(f"{_DRIVE}.port", "Serial port, or socket://host:port", "/dev/ttyUSB0"),),
            over="ensemble.toml",
        ),
        "bal_analog": Hardware(
            (Asked(f"{_DRIVE}.host", "Address of the Modbus I/O station", "192.168.1.30"),),
            ((f"{_DRIVE}.port", _MODBUS_PORT),),
            over="fit-bal-analog.toml",
        ),
    },
    "dac": {
        "tcp": Hardware(
            (Asked(f"{_DAC}.host", "Its address", "192.168.1.31"),),
            ((f"{_DAC}.transport", "tcp"), (f"{_DAC}.port", _MODBUS_PORT)),
        ),
        "rtu": Hardware(
            (Asked(f"{_DAC}.serial_port", "Its serial port", "/dev/ttyUSB1"),),
            ((f"{_DAC}.transport", "rtu"),),
        ),
    },
    "mdt693": {
        "mdt693": Hardware(
            (Asked(f"{_LOOP}.fsm.piezo.port", "Its serial port", "/dev/ttyUSB2"),),
        ),
    },
}


class Chosen(NamedTuple):
    """What is there of one device: its kind, and an answer to each question about it."""

    kind: str = MOCK
    answers: tuple[str, ...] = ()

    def __str__(self) -> str:
        return ":".join([self.kind, *self.answers])


def chosen(device: str, text: str) -> Chosen:
    """What ``KIND:ANSWER`` says, or ``mock``; the last answer may have colons of its own.

    Raises
    ------
    ConfigError
        If there is no such kind, or not an answer to each of its questions.
    """
    kind, *rest = text.split(":", 1)
    if kind == MOCK and not rest:
        return Chosen()
    hardware = DEVICES[device].get(kind)
    asked = () if hardware is None else hardware.asked
    answers = rest[0].split(":", len(asked) - 1) if rest and asked else []
    if len(answers) != len(asked) or not asked or not all(answers):
        msg = f"init: --{device} {text}: must be like one of {', '.join(forms(device))}"
        raise ConfigError(msg)
    return Chosen(kind, tuple(answers))


def forms(device: str) -> list[str]:
    """What may be said of a device, with examples for its answers."""
    said = [
        str(Chosen(kind, tuple(asked.example for asked in hardware.asked)))
        for kind, hardware in DEVICES[device].items()
    ]
    return [*said, MOCK]


def new_rig_text(name: str, devices: Mapping[str, Chosen]) -> str:
    """A rig file with these devices.

    Sections ``plant`` and ``mocks`` stay as long as one device is a mock.

    Parameters
    ----------
    name : str
    devices : mapping of Chosen
        One for each of `DEVICES`.
    """
    shipped = default_rig_path()
    document = tomlkit.parse(_without_head(shipped.read_text(encoding="utf-8")))
    document["name"] = name
    document["description"] = ", ".join(f"{device} {kind}" for device, (kind, _) in devices.items())
    for device, (kind, answers) in devices.items():
        if kind != MOCK:
            _put(document, DEVICES[device][kind], answers, shipped.parent)
    if all(kind != MOCK for kind, _ in devices.values()):
        del document["plant"], document["mocks"]
    return f"# {name}: {_HEAD}" + _without_empty_rules(tomlkit.dumps(document))


def _put(
    document: tomlkit.TOMLDocument, hardware: Hardware, answers: tuple[str, ...], shipped: Path
) -> None:
    if hardware.over:
        text = (shipped / hardware.over).read_text(encoding="utf-8")
        lines = [line for line in text.splitlines() if not line.startswith(_RULE)]
        over = tomlkit.parse("\n".join(lines).rstrip() + "\n")
        for key in ("base", "name", "description"):
            del over[key]
        lay_over(document, over)
    given = zip((asked.key for asked in hardware.asked), answers, strict=True)
    for key, value in [*hardware.fixed, *given]:
        *tables, last = key.split(".")
        table: Any = document
        for part in tables:
            table = table[part]
        _set_value(table, last, value)


def _set_value(table: Any, key: str, value: Any) -> None:
    """Put a value in the place of another; the comment behind it stays in its column."""
    before = table.item(key)
    table[key] = value
    after = table.item(key)
    if not after.trivia.comment:
        return
    column = len(before.as_string()) + len(before.trivia.comment_ws)
    after.trivia.comment_ws = " " * max(1, column - len(after.as_string()))


def _without_head(text: str) -> str:
    """The file from its first line that is no comment on."""
    lines = text.splitlines(keepends=True)
    first = next(n for n, line in enumerate(lines) if not line.startswith("#"))
    return "".join(lines[first:])


def _without_empty_rules(text: str) -> str:
    """Without headings of sections that are gone: nothing follows them, or another heading does."""
    rule = rf"^{_RULE}-* .*\n"
    return re.sub(rf"{rule}\s*(?={rule}|\Z)", "", text, flags=re.MULTILINE).rstrip() + "\n"
