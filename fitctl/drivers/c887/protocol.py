"""GCS 2.0 as a C-887 speaks it, for both sides: commands, answers, error numbers.

A command is a line of ASCII that ends in LF, or a single control character that acts at once and needs no LF.
A command that sets something has no answer: whether it was done, ``ERR?`` reports, which clears the error. A
question that cannot be answered has no answer either. The lines of an answer are joined by a space and LF;
the last one ends in LF alone.

Sources: PIPython 2.11 by the maker (line ends, control characters, how answers are read, error numbers);
epics-motor/motorPIGCS2, lsst-ts/ts_athexapod and ESRF's bliss, which run hexapods on a C-887 (``FRF X``
references all axes, ``SPI?`` answers with R, S and T, ``VLS`` only at rest, pose zero before referencing).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from enum import IntEnum
from typing import NamedTuple

AXES = ("X", "Y", "Z", "U", "V", "W")
LF = b"\n"
ANSWER_BYTES_MAX = 65536  # HLP? of the largest controllers is a few kB
DECIMALS = 6  # of a target: a nanometre, a microdegree

GET_POSITION = b"\x03"
GET_STATUS = b"\x04"
GET_MOTION = b"\x05"
GET_CHANGED = b"\x06"
GET_READY = b"\x07"
GET_MACRO = b"\x08"
GET_WAVE = b"\x09"
STOP_ALL = b"\x18"

READY, BUSY = b"\xb1", b"\xb0"
ENCODING = "cp1252"


class GcsError(IntEnum):
    """Numbers that ``ERR?`` answers with, as PIPython has them, as far as a hexapod needs them."""

    NONE = 0
    PARAMETER_SYNTAX = 1
    UNKNOWN_COMMAND = 2
    COMMAND_TOO_LONG = 3
    NOT_REFERENCED_OR_SERVO_OFF = 5
    POSITION_OUT_OF_LIMITS = 7
    VELOCITY_OUT_OF_LIMITS = 8
    PIVOT_NOT_POSSIBLE = 9
    STOPPED = 10
    INVALID_AXIS = 15
    PARAMETER_OUT_OF_RANGE = 17
    AXIS_TWICE = 22
    NUMBER_OF_PARAMETERS = 24
    REFERENCING_FAILED = 45
    UNKNOWN_PARAMETER = 54
    NOT_WHILE_MOVING = 93
    EMERGENCY_STOP = 500
    EMERGENCY_STOP_BEFORE = 501
    MOTION_ERROR = 1024


_ERROR_TEXTS: dict[int, str] = {
    GcsError.PARAMETER_SYNTAX: "a parameter that it cannot read",
    GcsError.UNKNOWN_COMMAND: "an unknown command",
    GcsError.COMMAND_TOO_LONG: "a command that is too long",
    GcsError.NOT_REFERENCED_OR_SERVO_OFF: "not referenced, or a servo is off",
    GcsError.POSITION_OUT_OF_LIMITS: "the pose is out of reach",
    GcsError.VELOCITY_OUT_OF_LIMITS: "the velocity is out of its limits",
    GcsError.PIVOT_NOT_POSSIBLE: "the pivot can be set only while U, V and W are zero",
    GcsError.STOPPED: "stopped by command",
    GcsError.INVALID_AXIS: "an unknown axis",
    GcsError.PARAMETER_OUT_OF_RANGE: "a parameter is out of range",
    GcsError.AXIS_TWICE: "an axis named twice",
    GcsError.NUMBER_OF_PARAMETERS: "too many or too few parameters",
    GcsError.REFERENCING_FAILED: "the reference move failed",
    GcsError.UNKNOWN_PARAMETER: "an unknown parameter",
    GcsError.NOT_WHILE_MOVING: "not allowed while the platform moves",
    GcsError.EMERGENCY_STOP: "the emergency stop is pressed",
    GcsError.EMERGENCY_STOP_BEFORE: "the emergency stop was pressed",
    GcsError.MOTION_ERROR: "an axis did not follow, and its servo was switched off",
}


def error_text(number: int) -> str:
    """An error number for people."""
    known = _ERROR_TEXTS.get(number)
    return f"error {number}, {known}" if known else f"error {number}"


class Identity(NamedTuple):
    """The answer to ``*IDN?``."""

    maker: str
    model: str
    serial: str
    firmware: str


def line(*words: object) -> bytes:
    """A command of words, floats with `DECIMALS` decimals."""
    texts = (f"{word:.{DECIMALS}f}" if isinstance(word, float) else str(word) for word in words)
    return " ".join(texts).encode("ascii") + LF


def with_values(command: str, values: Iterable[tuple[str, float]]) -> bytes:
    """A command with a number for each of some axes, such as ``MOV X 1.000000 Y 2.000000``."""
    return line(command, *(word for pair in values for word in pair))


def is_complete(answer: bytes) -> bool:
    """Whether the last line of an answer has come."""
    return answer.endswith(LF) and not answer.endswith(b" " + LF)


def lines_of(answer: bytes) -> list[str]:
    """The lines of a whole answer, without what joins them.

    Raises
    ------
    ValueError
        If it is not one whole answer of printable lines.
    """
    if not is_complete(answer):
        msg = "an answer without its end"
        raise ValueError(msg)
    lines = answer[:-1].decode(ENCODING, "replace").split(" \n")
    if any("\n" in one or not one.replace("\t", " ").isprintable() for one in lines):
        msg = "more than one answer, or none"
        raise ValueError(msg)
    return lines


def one_line(answer: bytes) -> str:
    """The only line of an answer. Raises ValueError."""
    lines = lines_of(answer)
    if len(lines) != 1:
        msg = f"{len(lines)} lines, not one"
        raise ValueError(msg)
    return lines[0].strip()


def parse_values(answer: bytes, items: Sequence[str]) -> list[str]:
    """The values of an answer with a line ``X=...`` for each of `items`, in their order. Raises ValueError."""
    lines = lines_of(answer)
    names = [name.strip() for name, _, _ in (one.partition("=") for one in lines)]
    if names != list(items) or not all("=" in one for one in lines):
        msg = f"lines for {', '.join(names)}, not for {', '.join(items)}"
        raise ValueError(msg)
    return [one.partition("=")[2].strip() for one in lines]


def parse_numbers(answer: bytes, items: Sequence[str]) -> list[float]:
    """As :func:`parse_values`, finite numbers. Raises ValueError."""
    return [parse_number(value) for value in parse_values(answer, items)]


def parse_flags(answer: bytes, items: Sequence[str]) -> list[bool]:
    """As :func:`parse_values`, 0 or 1. Raises ValueError."""
    values = parse_values(answer, items)
    if not set(values) <= {"0", "1"}:
        msg = f"neither 0 nor 1: {', '.join(values)}"
        raise ValueError(msg)
    return [value == "1" for value in values]


def parse_number(text: str) -> float:
    """A finite number. Raises ValueError."""
    number = float(text)
    if not math.isfinite(number):
        msg = f"not a finite number: {text}"
        raise ValueError(msg)
    return number


def parse_float(answer: bytes) -> float:
    """An answer of one number, such as that to ``VLS?``. Raises ValueError."""
    return parse_number(one_line(answer))


def parse_error(answer: bytes) -> int:
    """The answer to ``ERR?``. Raises ValueError."""
    return int(one_line(answer))


def parse_bits(answer: bytes) -> int:
    """The answer to #4, #5 or #6: hexadecimal, with ``0x`` or without. Raises ValueError."""
    bits = int(one_line(answer), 16)
    if bits < 0:
        msg = f"negative: {bits}"
        raise ValueError(msg)
    return bits


def parse_ready(answer: bytes) -> bool:
    """The answer to #7. Raises ValueError."""
    states = {READY + LF: True, BUSY + LF: False}
    if answer not in states:
        msg = f"neither ready nor busy: {answer!r}"
        raise ValueError(msg)
    return states[answer]


def parse_identity(answer: bytes) -> Identity:
    """The answer to ``*IDN?``: maker, model, serial number, firmware. Raises ValueError."""
    words = [word.strip() for word in one_line(answer).split(",")]
    if len(words) != len(Identity._fields):
        msg = f"{len(words)} words between commas, not {len(Identity._fields)}"
        raise ValueError(msg)
    return Identity(*words)


def answer_of(lines: Iterable[str]) -> bytes:
    """A whole answer from its lines."""
    return " \n".join(lines).encode(ENCODING) + LF


def answer_values(values: Iterable[tuple[str, object]]) -> bytes:
    """A whole answer with a line ``X=...`` for each item; floats with seven decimals, truth as 0 or 1."""
    return answer_of(f"{name}={_value(value)}" for name, value in values)


def _value(value: object) -> str:
    if isinstance(value, bool):
        return str(int(value))
    return f"{value:.7f}" if isinstance(value, float) else str(value)
