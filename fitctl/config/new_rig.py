"""A rig file of one's own: the shipped one, comments and all, with the hardware that is there put in."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit

from fitctl.config.addresses import SOCKET_URL, is_host, is_socket_url
from fitctl.config.base import ConfigError
from fitctl.config.commented import dump_commented, parse_commented, set_value
from fitctl.config.origins import default_rig_path
from fitctl.config.reading import lay_over

MOCK = "mock"
ONE_STAR, TESTBED = "fit-mock", "fit-testbed"
"""The shipped rigs that a new one can begin with."""
_CAN_DRIVER = "cia402"
_HEADING = "# -----"
_MOCKS_OF = {"ensemble": "tcp_port", "bal_analog": "modbus_port"}
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
    own_port : int
        Of a device that has a serial port or a socket: the port of its own socket, for an address without one.
        0 where it has no socket of its own.
    choices : mapping
        Where only some answers are possible: the keys and values that follow from each.
    """

    key: str
    question: str
    example: str
    own_port: int = 0
    choices: Mapping[str, tuple[tuple[str, Any], ...]] = {}

    def values(self, answer: str) -> tuple[tuple[str, Any], ...]:
        """The keys that an answer sets, and their values."""
        return self.choices[answer] if self.choices else ((self.key, self._place(answer)),)

    def _place(self, answer: str) -> str:
        """``socket://host:port`` for an address where a serial port or a socket is asked for."""
        if self.own_port and is_host(answer):
            return f"{SOCKET_URL}{answer}:{self.own_port}"
        if self.own_port and is_socket_url(SOCKET_URL + answer):
            return SOCKET_URL + answer
        return answer


class Hardware(NamedTuple):
    """One kind of a device.

    Attributes
    ----------
    asked : tuple of Asked
    fixed : tuple of key and value
        What follows from the kind.
    over : str
        The shipped rig file that has this kind; empty where the rig that is begun with has it.
    loop : str
        The device's loop. Keys and `over` name the right loop: its name is replaced with this one.
    """

    asked: tuple[Asked, ...]
    fixed: tuple[tuple[str, Any], ...] = ()
    over: str = ""
    loop: str = "right"

    def of_loop(self, text: str) -> str:
        """A key, or the text of a rig file, with this loop in the place of the right one."""
        return text.replace("loops.right", f"loops.{self.loop}")


class Device(NamedTuple):
    """A device of a rig, and what it can be.

    Attributes
    ----------
    title : str
    kinds : dict of Hardware
    """

    title: str
    kinds: dict[str, Hardware]


_ADDRESS = Asked("camera.device.address", "Its IPv4 address", "192.168.1.20")
_DRIVE = "loops.right.siderostat.device"
_DAC = "loops.right.fsm.dac"
_LABJACK = "loops.metrology.sensor.device"
_MODBUS_PORT = 502  # that stations have; mocks listen elsewhere

_CAMERA = {
    "gige": Hardware((_ADDRESS,), (("camera.device.driver", "gige"),)),
    "aravis": Hardware((_ADDRESS,), (("camera.device.driver", "aravis"),)),
}
_SIDEROSTAT = {
    _CAN_DRIVER: Hardware(
        (
            Asked(f"{_DRIVE}.interface", "CAN interface, as python-can calls it", "socketcan"),
            Asked(f"{_DRIVE}.channel", "Its channel", "can0"),
        )
    ),
    "ensemble": Hardware(
        (
            Asked(
                f"{_DRIVE}.port",
                "Address, or serial port, or socket://host:port",
                "/dev/ttyUSB0",
                8000,
            ),
        ),
        over="ensemble.toml",
    ),
    "bal_analog": Hardware(
        (Asked(f"{_DRIVE}.host", "Address of the Modbus I/O station", "192.168.1.30"),),
        ((f"{_DRIVE}.port", _MODBUS_PORT),),
        over="fit-bal-analog.toml",
    ),
}
_MIRROR_DAC = {
    "tcp": Hardware(
        (Asked(f"{_DAC}.host", "Its address", "192.168.1.31"),),
        ((f"{_DAC}.transport", "tcp"), (f"{_DAC}.port", _MODBUS_PORT)),
    ),
    "rtu": Hardware(
        (Asked(f"{_DAC}.serial_port", "Its serial port", "/dev/ttyUSB1"),),
        ((f"{_DAC}.transport", "rtu"),),
    ),
}
_FSM = "loops.right.fsm"


def _limited(limit_v: float, bias_v: float, range_rad: float) -> tuple[tuple[str, Any], ...]:
    return (
        (f"{_FSM}.piezo.limit_v", limit_v),
        (f"{_FSM}.bias_v", bias_v),
        (f"{_FSM}.range_rad", range_rad),
    )


_PIEZO = {
    "mdt693": Hardware(
        (
            Asked(
                f"{_FSM}.piezo.limit_v",
                "Voltage that the stacks may have by their data sheet: 75, 100 or 150",
                "150",
                # The mirror's middle, and what it can move about it, are as large a part of the stacks' stroke.
                choices={
                    "75": _limited(75.5, 2.5, 8.86e-5),
                    "100": _limited(100.5, 3.33, 1.181e-4),
                    "150": _limited(150.5, 5.0, 1.772e-4),
                },
            ),
            Asked(f"{_FSM}.piezo.port", "Its serial port", "/dev/ttyUSB2"),
        )
    ),
}
_PHOTODIODES = {
    "labjack_t7": Hardware(
        (Asked(f"{_LABJACK}.host", "Its address", "192.168.1.32"),),
        ((f"{_LABJACK}.port", _MODBUS_PORT),),
    ),
}
_HEXAPOD = {
    "c887": Hardware(
        (
            Asked(
                "collector.hexapod.port",
                "Address, or serial port, or socket://host:port",
                "socket://192.168.1.40:50000",
                50000,
            ),
        )
    ),
}


_EXAMPLES_APART = {"right": 0, "metrology": 3, "left": 5}
"""By how much the last numbers of the loops' examples differ: of addresses and serial ports."""
_LAST_NUMBER = re.compile(r"(?<=[.B])\d+$")


def _of_loop(loop: str, kinds: dict[str, Hardware]) -> dict[str, Hardware]:
    def moved(match: re.Match[str]) -> str:
        return str(int(match[0]) + _EXAMPLES_APART[loop])

    def apart(asked: Asked) -> Asked:
        return asked._replace(example=_LAST_NUMBER.sub(moved, asked.example))

    return {
        kind: hardware._replace(loop=loop, asked=tuple(map(apart, hardware.asked)))
        for kind, hardware in kinds.items()
    }


_STAR = {
    "camera": Device("Camera", _CAMERA),
    "siderostat": Device("Amplifiers of the siderostat", _SIDEROSTAT),
    "dac": Device("D/A converter of the mirror", _MIRROR_DAC),
    "mdt693": Device("MDT693 piezo amplifier", _PIEZO),
}
DEVICES: dict[str, dict[str, Device]] = {
    ONE_STAR: _STAR,
    TESTBED: _STAR
    | {
        "metrology-siderostat": Device(
            "Amplifiers of the left combiner siderostat, loop metrology",
            _of_loop("metrology", _SIDEROSTAT),
        ),
        "photodiodes": Device("LabJack T7 of the metrology's photodiodes", _PHOTODIODES),
        "left-siderostat": Device(
            "Amplifiers of the collector siderostat, loop left", _of_loop("left", _SIDEROSTAT)
        ),
        "left-dac": Device("D/A converter of the left mirror", _of_loop("left", _MIRROR_DAC)),
        "left-mdt693": Device(
            "MDT693 piezo amplifier of the left mirror", _of_loop("left", _PIEZO)
        ),
        "hexapod": Device("C-887 controller of the collector's hexapod", _HEXAPOD),
    },
}
"""What `fitctl init` asks for, by the rig that it begins with."""


class Chosen(NamedTuple):
    """What is there of one device: its kind, and an answer to each question about it."""

    kind: str = MOCK
    answers: tuple[str, ...] = ()

    def __str__(self) -> str:
        return ":".join([self.kind, *self.answers])


def chosen(rig: str, device: str, text: str) -> Chosen:
    """What ``KIND:ANSWER`` says, or ``mock``; the last answer may have colons of its own.

    Raises
    ------
    ConfigError
        If there is no such kind, or not an answer to each of its questions.
    """
    kind, *rest = text.split(":", 1)
    if kind == MOCK and not rest:
        return Chosen()
    hardware = DEVICES[rig][device].kinds.get(kind)
    asked = () if hardware is None else hardware.asked
    answers = rest[0].split(":", len(asked) - 1) if rest and asked else []
    if len(answers) != len(asked) or not asked or not all(answers):
        msg = f"init: --{device} {text}: must be like one of {', '.join(forms(rig, device))}"
        raise ConfigError(msg)
    for question, answer in zip(asked, answers, strict=True):
        if question.choices and answer not in question.choices:
            possible = ", ".join(question.choices)
            msg = f"init: --{device} {text}: {answer!r} must be one of {possible}; {question.question}"
            raise ConfigError(msg)
    return Chosen(kind, tuple(answers))


def forms(rig: str, device: str) -> list[str]:
    """What may be said of a device, with examples for its answers."""
    said = [
        str(Chosen(kind, tuple(asked.example for asked in hardware.asked)))
        for kind, hardware in DEVICES[rig][device].kinds.items()
    ]
    return [*said, MOCK]


def new_rig_text(rig: str, name: str, devices: Mapping[str, Chosen]) -> str:
    """A rig file with these devices.

    Sections ``plant`` and ``mocks`` stay as long as one device is a mock.

    Parameters
    ----------
    rig : str
        The shipped rig to begin with, of `DEVICES`.
    name : str
        Of the new rig.
    devices : mapping of Chosen
        One for each of the rig's `DEVICES`.
    """
    shipped = default_rig_path()
    document = _parsed(shipped)
    if rig != ONE_STAR:
        _lay_file_over(document, shipped.with_name(f"{rig}.toml"))
    document["name"] = name
    document["description"] = ", ".join(f"{device} {kind}" for device, (kind, _) in devices.items())
    for device, (kind, answers) in devices.items():
        if kind != MOCK:
            _put(document, DEVICES[rig][device].kinds[kind], answers, shipped.parent)
    _number_nodes(document)
    _keep_searches_within_travel(document)
    if all(kind != MOCK for kind, _ in devices.values()):
        del document["plant"], document["mocks"]
    else:
        _move_mocks_apart(document)
    return f"# {name}: {_HEAD}{_headings_once(dump_commented(document))}"


def _headings_once(text: str) -> str:
    """The text without headings that files laid over repeat."""
    seen: set[str] = set()
    lines = []
    for line in text.rstrip().split("\n"):  # a text may have other ends of lines
        if line.startswith(_HEADING) and line in seen:
            continue
        seen.add(line)
        lines.append(line)
    return "\n".join(lines) + "\n"


def _put(
    document: tomlkit.TOMLDocument, hardware: Hardware, answers: tuple[str, ...], shipped: Path
) -> None:
    if hardware.over:
        _lay_file_over(document, shipped / hardware.over, hardware.of_loop)
    given = [
        each
        for asked, answer in zip(hardware.asked, answers, strict=True)
        for each in asked.values(answer)
    ]
    for key, value in [*hardware.fixed, *given]:
        *tables, last = hardware.of_loop(key).split(".")
        table: Any = document
        for part in tables:
            table = table[part]
        set_value(table, last, value)


def _parsed(path: Path, changed: Callable[[str], str] = str) -> tomlkit.TOMLDocument:
    """A shipped rig file; a comment that stands before a table goes with it.

    The comment at the head of the file is left out.
    """
    lines = path.read_text(encoding="utf-8").splitlines(keepends=True)
    first = next(n for n, line in enumerate(lines) if not line.startswith("#"))
    text = changed("".join(lines[first:]))
    return parse_commented(text)


def _lay_file_over(
    document: tomlkit.TOMLDocument, path: Path, changed: Callable[[str], str] = str
) -> None:
    over = _parsed(path, changed)
    for key in ("base", "name", "description"):
        del over[key]
    lay_over(document, over)


def _number_nodes(document: tomlkit.TOMLDocument) -> None:
    """Drives on one CAN bus get different node ids, counted from 1 in the order of the loops."""
    nodes: Counter[tuple[str, str]] = Counter()
    for loop in document["loops"].values():
        device = loop["siderostat"]["device"]
        if device["driver"] == _CAN_DRIVER:
            bus = device["interface"], device["channel"]
            nodes[bus] += 1
            set_value(device, "node_id", nodes[bus])


def _keep_searches_within_travel(document: tomlkit.TOMLDocument) -> None:
    """Some amplifiers have a shorter travel than the rig that is begun with."""
    for loop in document["loops"].values():
        travel_arcsec = loop["siderostat"]["travel_sky_arcsec"]
        if loop["acquisition"]["search_radius_sky_arcsec"] > travel_arcsec:
            set_value(loop["acquisition"], "search_radius_sky_arcsec", float(travel_arcsec))


def _move_mocks_apart(document: tomlkit.TOMLDocument) -> None:
    """Amplifiers of a kind that several loops have come from one file, with one port for their mocks."""
    loops = document["mocks"]["loops"].values()
    for kind, key in _MOCKS_OF.items():
        for number, mocks in enumerate([loop[kind] for loop in loops if kind in loop]):
            set_value(mocks, key, mocks[key] + 1000 * number)
