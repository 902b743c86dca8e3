"""The C-887's commands: a line or a control character in, an answer or none out. No I/O.

A command that fails sets the error number that ``ERR?`` answers with, does nothing, and has no answer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

from fitctl.config import C887Mock
from fitctl.drivers.c887.protocol import (
    AXES,
    BUSY,
    GET_CHANGED,
    GET_MACRO,
    GET_MOTION,
    GET_POSITION,
    GET_READY,
    GET_STATUS,
    GET_WAVE,
    LF,
    READY,
    STOP_ALL,
    GcsError,
    answer_of,
    answer_values,
    parse_number,
)
from fitctl.mocks.c887.platform import GcsFailure, Platform

COMMAND_BYTES_MAX = 1024
MODEL = "C-887"
_PIVOT_OF = {"X": "R", "Y": "S", "Z": "T", "R": "R", "S": "S", "T": "T"}
_STAGE_NAME, _SERIAL_NUMBER = 0x3C, 0x0D000000
_STATUS_REFERENCED, _STATUS_SERVO, _STATUS_MOVING, _STATUS_ON_TARGET = (
    1 << 8,
    1 << 12,
    1 << 13,
    1 << 15,
)

Answer = bytes | None


class Controller:
    """Executes commands on a platform.

    Parameters
    ----------
    settings : C887Mock
    platform : Platform

    Attributes
    ----------
    position_offset_mm : float
        How much too large X is reported.
    false_error : int
        What ``ERR?`` answers whatever happened; 0 is the truth.
    """

    def __init__(self, settings: C887Mock, platform: Platform) -> None:
        self._settings = settings
        self._platform = platform
        self.position_offset_mm = 0.0
        self.false_error = 0
        self._error = GcsError.NONE
        self._reported: dict[str, float] = {}

    def answer(self, command: bytes) -> Answer:
        """Execute a control character, or a line without its LF."""
        try:
            if command[:1] < b" ":
                return _CONTROLS[command].execute(self, [])
            if len(command) > COMMAND_BYTES_MAX:
                raise GcsFailure(GcsError.COMMAND_TOO_LONG)
            name, *words = command.decode("latin-1").split()
            return _COMMANDS[name.upper()].execute(self, words)
        except GcsFailure as failure:
            self._error = failure.number
        except KeyError:
            self._error = GcsError.UNKNOWN_COMMAND
        return None

    # ------------------------------------------------------------ who it is
    def _idn(self, words: list[str]) -> Answer:
        _none_of(words)
        settings = self._settings
        maker = "(c)2013 Physik Instrumente (PI) Karlsruhe"
        return answer_of([f"{maker}, {MODEL}, {settings.serial_number}, {settings.firmware}"])

    def _ver(self, words: list[str]) -> Answer:
        _none_of(words)
        return answer_of([f"FW_DSP: V{self._settings.firmware}", f"HW: {MODEL}"])

    def _hlp(self, words: list[str]) -> Answer:
        _none_of(words)
        controls = [f"#{name[0]} {known.text}" for name, known in _CONTROLS.items()]
        lines = [f"{name} {known.text}" for name, known in _COMMANDS.items()]
        return answer_of(["The following commands are valid:", *controls, *lines, "end of help"])

    def _hpa(self, words: list[str]) -> Answer:
        _none_of(words)
        lines = [
            f"0x{number:X}=\t0\t1\t{kind}\t{text}" for number, (kind, text) in _PARAMETERS.items()
        ]
        return answer_of(["The following parameters are valid:", *lines, "end of help"])

    def _spa(self, words: list[str]) -> Answer:
        values = {_STAGE_NAME: self._settings.stage, _SERIAL_NUMBER: self._settings.serial_number}
        lines = []
        for item, word in _pairs(words):
            _axis(item)
            try:
                number = int(word, 0)
            except ValueError:
                raise GcsFailure(GcsError.PARAMETER_SYNTAX) from None
            if number not in values:
                raise GcsFailure(GcsError.UNKNOWN_PARAMETER)
            lines.append(f"{item} 0x{number:X}={values[number]}")
        return answer_of(lines)

    def _sai(self, words: list[str]) -> Answer:
        if [word.upper() for word in words] not in ([], ["ALL"]):
            raise GcsFailure(GcsError.PARAMETER_SYNTAX)
        return answer_of(AXES)

    def _err(self, words: list[str]) -> Answer:
        _none_of(words)
        number = self._platform.error or self._error
        self._platform.error = self._error = GcsError.NONE
        return answer_of([str(self.false_error or int(number))])

    # ------------------------------------------------------------ readings
    def _position(self) -> dict[str, float]:
        position = self._platform.position()
        return position | {"X": position["X"] + self.position_offset_mm}

    def _report_position(self, words: list[str]) -> Answer:
        self._reported = self._position()
        return _per_axis(words, self._reported)

    def _changed(self, _words: list[str]) -> Answer:
        """Whether positions have changed since the last time that they were asked for."""
        before, now = self._reported, self._position()
        return _bits(now[axis] != before.get(axis, 0.0) for axis in AXES)

    def _status(self, _words: list[str]) -> Answer:
        platform = self._platform
        flags = {
            _STATUS_REFERENCED: platform.referenced,
            _STATUS_SERVO: platform.servos_on,
            _STATUS_MOVING: any(platform.moving().values()),
            _STATUS_ON_TARGET: all(platform.on_target().values()),
        }
        return answer_of([f"0x{sum(bit for bit, holds in flags.items() if holds):04X}"])

    # ------------------------------------------------------------ commands
    def _move(self, words: list[str]) -> Answer:
        self._platform.move(_numbers(words))
        return None

    def _move_relative(self, words: list[str]) -> Answer:
        target = self._platform.target()
        self._platform.move({axis: target[axis] + by for axis, by in _numbers(words).items()})
        return None

    def _can_move(self, words: list[str]) -> Answer:
        targets = _numbers(words)
        if not self._platform.referenced:
            raise GcsFailure(GcsError.NOT_REFERENCED_OR_SERVO_OFF)
        try:
            self._platform.check_reach(targets)
        except GcsFailure:
            return answer_of(["0"])
        return answer_of(["1"])

    def _reference(self, words: list[str]) -> Answer:
        _axes(words)  # whichever are named, the struts move all
        self._platform.reference()
        return None

    def _servo(self, words: list[str]) -> Answer:
        states = _flags(words)
        if len(set(states.values())) != 1:
            raise GcsFailure(GcsError.PARAMETER_SYNTAX)
        self._platform.switch_servos(on=next(iter(states.values())))
        return None

    def _stop(self, words: list[str]) -> Answer:
        _none_of(words)
        self._platform.stop()
        return None

    def _halt(self, words: list[str]) -> Answer:
        _axes(words)  # as for references
        self._platform.stop(abrupt=False)
        return None

    def _velocity(self, words: list[str]) -> Answer:
        if len(words) != 1:
            raise GcsFailure(GcsError.NUMBER_OF_PARAMETERS)
        self._platform.set_velocity(_number(words[0]))
        return None

    def _report_velocity(self, words: list[str]) -> Answer:
        _none_of(words)
        return answer_of([f"{self._platform.velocity_mm_s:.7f}"])

    def _pivot(self, words: list[str]) -> Answer:
        pairs = _unique(_pairs(words), _PIVOT_OF)
        self._platform.set_pivot({_PIVOT_OF[name]: _number(word) for name, word in pairs.items()})
        return None

    def _report_pivot(self, words: list[str]) -> Answer:
        names = [word.upper() for word in words] or list(self._platform.pivot)
        if not set(names) <= set(_PIVOT_OF):
            raise GcsFailure(GcsError.INVALID_AXIS)
        return answer_values((name, self._platform.pivot[_PIVOT_OF[name]]) for name in names)

    def _low_limits(self, words: list[str]) -> Answer:
        self._platform.set_soft_limits(0, _numbers(words))
        return None

    def _high_limits(self, words: list[str]) -> Answer:
        self._platform.set_soft_limits(1, _numbers(words))
        return None

    def _switch_limits(self, words: list[str]) -> Answer:
        self._platform.switch_soft_limits(_flags(words))
        return None


# ------------------------------------------------------------ words
def _none_of(words: Sequence[str]) -> None:
    if words:
        raise GcsFailure(GcsError.NUMBER_OF_PARAMETERS)


def _axis(word: str) -> str:
    if word.upper() not in AXES:
        raise GcsFailure(GcsError.INVALID_AXIS)
    return word.upper()


def _axes(words: Sequence[str]) -> list[str]:
    """The axes that are named, or all."""
    return [_axis(word) for word in words] or list(AXES)


def _pairs(words: Sequence[str]) -> list[tuple[str, str]]:
    if not words or len(words) % 2:
        raise GcsFailure(GcsError.NUMBER_OF_PARAMETERS)
    return list(zip(words[::2], words[1::2], strict=True))


def _unique(pairs: Sequence[tuple[str, str]], known: Iterable[str]) -> dict[str, str]:
    names = [name.upper() for name, _ in pairs]
    if not set(names) <= set(known):
        raise GcsFailure(GcsError.INVALID_AXIS)
    if len(set(names)) != len(names):
        raise GcsFailure(GcsError.AXIS_TWICE)
    return dict(zip(names, (word for _, word in pairs), strict=True))


def _number(word: str) -> float:
    try:
        return parse_number(word)
    except ValueError:
        raise GcsFailure(GcsError.PARAMETER_SYNTAX) from None


def _numbers(words: Sequence[str]) -> dict[str, float]:
    return {axis: _number(word) for axis, word in _unique(_pairs(words), AXES).items()}


def _flags(words: Sequence[str]) -> dict[str, bool]:
    states = _unique(_pairs(words), AXES)
    if not set(states.values()) <= {"0", "1"}:
        raise GcsFailure(GcsError.PARAMETER_SYNTAX)
    return {axis: word == "1" for axis, word in states.items()}


def _per_axis(words: Sequence[str], values: Mapping[str, object]) -> Answer:
    return answer_values((axis, values[axis]) for axis in _axes(words))


def _bits(flags: Iterable[bool]) -> Answer:
    return answer_of([f"{sum(1 << place for place, holds in enumerate(flags) if holds):x}"])


_PARAMETERS = {
    _STAGE_NAME: ("CHAR", "motor\tStage Name"),
    _SERIAL_NUMBER: ("CHAR", "system\tDevice S/N"),
}

_UNITS = dict(zip(AXES, ["mm"] * 3 + ["deg"] * 3, strict=True))


class _Command(NamedTuple):
    """What a command does, and how ``HLP?`` describes it."""

    execute: Callable[[Controller, list[str]], Answer]
    text: str


def _of_platform(read: Callable[[Platform], Mapping[str, object]], text: str) -> _Command:
    return _Command(
        lambda self, words: _per_axis(words, read(self._platform)), f"[{{<AxisID>}}] {text}"
    )


def _fixed(answer: str, text: str) -> _Command:
    return _Command(
        lambda _self, words: answer_of([answer]) if not words else _none_of(words), text
    )


_CONTROLS = {
    GET_POSITION: _Command(Controller._report_position, "Get Real Position"),
    GET_STATUS: _Command(Controller._status, "Request Status Register"),
    GET_MOTION: _Command(
        lambda self, _: _bits(self._platform.moving().values()), "Request Motion Status"
    ),
    GET_CHANGED: _Command(Controller._changed, "Query for Position Change"),
    GET_READY: _Command(
        lambda self, _: (BUSY if self._platform.referencing else READY) + LF,
        "Request Controller Ready Status",
    ),
    GET_MACRO: _fixed("0", "Query if Macro is Running"),
    GET_WAVE: _fixed("0", "Get Wave Generator Status"),
    STOP_ALL: _Command(Controller._stop, "Stop All Axes"),
}
_COMMANDS = {
    "*IDN?": _Command(Controller._idn, "Get Device Identification"),
    "CSV?": _fixed("2.0", "Get Current Syntax Version"),
    "CST?": _Command(
        lambda self, words: _per_axis(words, dict.fromkeys(AXES, self._settings.stage)),
        "[{<AxisID>}] Get Assignment of Stages to Axes",
    ),
    "ERR?": _Command(Controller._err, "Get Error Number"),
    "FRF": _Command(Controller._reference, "[{<AxisID>}] Fast Reference Move to Reference Switch"),
    "FRF?": _of_platform(
        lambda platform: dict.fromkeys(AXES, platform.referenced), "Get Referencing Result"
    ),
    "HLP?": _Command(Controller._hlp, "Get List of Available Commands"),
    "HLT": _Command(Controller._halt, "[{<AxisID>}] Halt Motion Smoothly"),
    "HPA?": _Command(Controller._hpa, "Get List of Available Parameters"),
    "MOV": _Command(Controller._move, "{<AxisID> <Position>} Set Target Position"),
    "MOV?": _of_platform(Platform.target, "Get Target Position"),
    "MVR": _Command(Controller._move_relative, "{<AxisID> <Distance>} Set Target Relative"),
    "NLM": _Command(Controller._low_limits, "{<AxisID> <LowLimit>} Set Low Position Soft Limit"),
    "NLM?": _of_platform(lambda platform: _ends(platform, 0), "Get Low Position Soft Limit"),
    "ONT?": _of_platform(Platform.on_target, "Get On-Target State"),
    "PLM": _Command(Controller._high_limits, "{<AxisID> <HighLimit>} Set High Position Soft Limit"),
    "PLM?": _of_platform(lambda platform: _ends(platform, 1), "Get High Position Soft Limit"),
    "POS?": _Command(Controller._report_position, "[{<AxisID>}] Get Real Position"),
    "PUN?": _of_platform(lambda _: _UNITS, "Get Position Unit"),
    "SAI?": _Command(Controller._sai, "[ALL] Get List of Current Axis Identifiers"),
    "SPA?": _Command(Controller._spa, "[{<ItemID> <PamID>}] Get Volatile Memory Parameters"),
    "SPI": _Command(Controller._pivot, "{<PPCoordinate> <Position>} Set Pivot Point"),
    "SPI?": _Command(Controller._report_pivot, "[{<PPCoordinate>}] Get Pivot Point"),
    "SSL": _Command(Controller._switch_limits, "{<AxisID> <SoftLimitsOn>} Set Soft Limit"),
    "SSL?": _of_platform(lambda platform: platform.soft_limits_on, "Get Soft Limit Status"),
    "STP": _Command(Controller._stop, "Stop All Axes"),
    "SVO": _Command(Controller._servo, "{<AxisID> <ServoState>} Set Servo Mode"),
    "SVO?": _of_platform(
        lambda platform: dict.fromkeys(AXES, platform.servos_on), "Get Servo Mode"
    ),
    "TMN?": _of_platform(lambda platform: platform.travel(0), "Get Minimum Commandable Position"),
    "TMX?": _of_platform(lambda platform: platform.travel(1), "Get Maximum Commandable Position"),
    "VER?": _Command(Controller._ver, "Get Versions of Firmware and Drivers"),
    "VLS": _Command(Controller._velocity, "<SystemVelocity> Set System Velocity"),
    "VLS?": _Command(Controller._report_velocity, "Get System Velocity"),
    "VMO?": _Command(Controller._can_move, "{<AxisID> <Position>} Virtual Move"),
}


def _ends(platform: Platform, end: int) -> dict[str, float]:
    return {axis: ends[end] for axis, ends in platform.soft_limits.items()}
