"""The mock controller's ASCII commands: a line in, an answer out.

Axes are ``@0`` and ``@1`` or names; parentheses, commas and blanks are all the same between words, as
public clients write ``AXISFAULT(@0)``, ``AXISFAULT @0``, ``MOVEABS X 1`` and ``MOVEABS X1 XF10 Y2 YF10``.

Known limitations: of AeroBasic these commands only, no expressions, variables, programs or tasks;
one plane, in which LINEAR moves each axis by its own ramp and not along a line; of PLANESTATUS bit 0 alone, set
while a LINEAR runs and by no other motion (that MOVEABS and MOVEINC do not set it is inferred), while bit 3 of
AXISSTATUS is set by all of them (by LINEAR: unknown); the interpreter never
waits for a move, as after WAIT MODE NOWAIT. SETPARM of a value out of range is answered ``#``: the ranges
are those of the maker's newer controllers, the character is invented. A changed CountsPerUnit or
ReverseMotionDirection has no effect; whether the real one needs a RESET first is unknown.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

from fitctl.drivers.ensemble.protocol import Parameter, Reply, format_bits
from fitctl.mocks.ensemble.axis import Axis

_REVERSE_DIRECTION, _LIMIT_SETUP, _HOME_SETUP = 1, 61, 75
_MASKS = {_REVERSE_DIRECTION, _LIMIT_SETUP, _HOME_SETUP, Parameter.POSITION_FEEDBACK_TYPE}
_ABOVE_ZERO = {Parameter.DEFAULT_RAMP_RATE, Parameter.ABORT_DECEL_RATE}

AXIS_NAME_NUMBERS = (99, 140)
"""Parameter AxisName: public headers disagree on its number."""

_WORD = re.compile(r"(?P<word>@\d+|[-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?|[A-Z_]+)", re.ASCII)
_BETWEEN = re.compile(r"[\s(),]+", re.ASCII)

Words = list[str]


class _NotUnderstood(Exception):
    pass


def words_of(line: str) -> Words:
    """The words and numbers of a command, in capitals; empty if there is anything else in it."""
    text, words, place = line.upper(), [], 0
    while place < len(text):
        match = _WORD.match(text, place) or _BETWEEN.match(text, place)
        if match is None:
            return []
        if match.lastgroup:
            words.append(match.group())
        place = match.end()
    return words


class Interpreter:
    """Has commands done by the axes.

    Parameters
    ----------
    axes : sequence of Axis
    parameters : sequence of dict
        Of each axis, by number.
    names : sequence of str
        Of the axes, beside ``@0`` and on.
    """

    def __init__(
        self, axes: Sequence[Axis], parameters: Sequence[dict[int, float]], names: Sequence[str]
    ) -> None:
        self._axes = axes
        self._parameters = parameters
        self._numbers = {f"@{number}": number for number in range(len(axes))}
        self._names = [name.upper() for name in names]
        self._numbers |= {name: number for number, name in enumerate(self._names)}
        self._incremental = False
        self._commands: dict[str, Callable[[Words], bool | str]] = {
            "ENABLE": lambda words: self._all(words, Axis.enable),
            "DISABLE": lambda words: self._all(words, Axis.disable),
            "ABORT": lambda words: self._all(words, Axis.abort),
            "FAULTACK": lambda words: self._all(words, Axis.acknowledge),
            "ACKNOWLEDGEALL": self._acknowledge_all,
            "WAIT": self._wait,
            "RAMP": self._ramp,
            "ABS": lambda words: self._set_incremental(words, False),
            "INC": lambda words: self._set_incremental(words, True),
            "FREERUN": self._free_run,
            "LINEAR": lambda words: self._move(
                words, incremental=self._incremental, coordinated=True
            ),
            "MOVEABS": lambda words: self._move(words, incremental=False),
            "MOVEINC": lambda words: self._move(words, incremental=True),
            "AXISSTATUS": lambda words: format_bits(self._one(words).status),
            "AXISFAULT": lambda words: format_bits(self._one(words).faults),
            "PLANESTATUS": self._plane_status,
            "PFBKPROG": lambda words: _number(self._one(words).feedback),
            "PFBK": lambda words: _number(self._one(words).feedback),
            "PCMDPROG": lambda words: _number(self._one(words).command),
            "VFBK": lambda words: _number(self._one(words).feedback_velocity),
            "GETPARM": self._get_parameter,
            "SETPARM": self._set_parameter,
        }

    def answer(self, line: str) -> tuple[Reply, str]:
        """Execute a line; returns the result and the value that was requested."""
        verb, *words = words_of(line) or [""]
        try:
            done = self._commands[verb](words)
        except (KeyError, _NotUnderstood):
            return Reply.NOT_UNDERSTOOD, ""
        if isinstance(done, str):
            return Reply.DONE, done
        return (Reply.DONE if done else Reply.FAULT), ""

    # ------------------------------------------------------------ arguments
    def _one(self, words: Words) -> Axis:
        _require(len(words) == 1 and words[0] in self._numbers)
        return self._axes[self._numbers[words[0]]]

    def _all(self, words: Words, action: Callable[[Axis], bool | None]) -> bool:
        """Do it to all axes that are named; each does what it can."""
        _require(bool(words) and all(word in self._numbers for word in words))
        done = [action(self._axes[self._numbers[word]]) is not False for word in words]
        return all(done)

    def _pop_axis(self, words: Words) -> Axis:
        _require(bool(words) and words[0] in self._numbers)
        return self._axes[self._numbers[words.pop(0)]]

    # ------------------------------------------------------------ commands
    def _acknowledge_all(self, words: Words) -> bool:
        _require(not words)
        for axis in self._axes:
            axis.acknowledge()
        return True

    def _wait(self, words: Words) -> bool:
        _require(words in (["MODE", "NOWAIT"], ["MODE", "MOVEDONE"], ["MODE", "INPOS"]))
        return True

    def _set_incremental(self, words: Words, incremental: bool) -> bool:
        _require(not words)
        self._incremental = incremental
        return True

    def _ramp(self, words: Words) -> bool:
        """``RAMP MODE [@0] RATE``, ``RAMP RATE [@0] a``; without an axis it is of all."""
        _require(len(words) in {2, 3})
        what, value = words[0], words[-1]
        axes = list(self._axes) if len(words) == 2 else [self._one(words[1:2])]
        if what == "MODE":
            _require(value == "RATE")
            return True
        _require(what == "RATE")
        rate = _float(value)
        for axis in axes:
            axis.ramp_rate = rate if rate > 0 else axis.ramp_rate
        return rate > 0

    def _free_run(self, words: Words) -> bool:
        wishes = []
        while words:
            axis = self._pop_axis(words)
            _require(bool(words))
            wishes.append((axis, _float(words.pop(0))))
        _require(bool(wishes))
        done = [axis.free_run(velocity) for axis, velocity in wishes]
        return all(done)

    def _move(self, words: Words, *, incremental: bool, coordinated: bool = False) -> bool:
        """Axis and place, its own speed or one for all: ``X 1 XF 10 Y 2 YF 10``, ``@0 1 F 10``."""
        places: dict[Axis, float] = {}
        while words:
            _require(len(words) >= 2)
            key, value = words.pop(0), _float(words.pop(0))
            if key in self._numbers:
                axis = self._axes[self._numbers[key]]
                places[axis] = value + (axis.command if incremental else 0.0)
            elif key.endswith("F") and key[:-1] in self._numbers:
                self._axes[self._numbers[key[:-1]]].speed = abs(value)
            else:
                _require(key == "F")
                for axis in places:
                    axis.speed = abs(value)
        _require(bool(places))
        done = [
            axis.move_to(place, axis.speed, coordinated=coordinated)
            for axis, place in places.items()
        ]
        return all(done)

    def _plane_status(self, words: Words) -> str:
        _require(words == ["0"])
        return format_bits(int(any(axis.moving_in_plane for axis in self._axes)))

    def _get_parameter(self, words: Words) -> str:
        if len(words) == 2 and words[1] in map(str, AXIS_NAME_NUMBERS):
            return self._names[self._axes.index(self._one(words[:1]))]
        parameters, number = self._parameter(words)
        _require(not words)
        return _number(parameters[number])

    def _set_parameter(self, words: Words) -> bool:
        parameters, number = self._parameter(words)
        _require(len(words) == 1)
        value = _float(words[0])
        if in_range(number, value):
            parameters[number] = value
            return True
        return False

    def _parameter(self, words: Words) -> tuple[dict[int, float], int]:
        parameters = self._parameters[self._axes.index(self._pop_axis(words))]
        _require(bool(words) and words[0].isdecimal() and int(words[0]) in parameters)
        return parameters, int(words.pop(0))


def in_range(number: int, value: float) -> bool:
    """Whether the controller takes a finite value for a parameter."""
    if number in _MASKS:
        return value >= 0 and value.is_integer()
    if number in _ABOVE_ZERO:
        return value > 0
    if number == Parameter.COUNTS_PER_UNIT:
        return value != 0
    return value >= 0 or number != Parameter.POSITION_ERROR_THRESHOLD


def _require(holds: bool) -> None:
    if not holds:
        raise _NotUnderstood


def _float(word: str) -> float:
    try:
        value = float(word)
    except ValueError:
        raise _NotUnderstood from None
    _require(math.isfinite(value))
    return value


def _number(value: float) -> str:
    return f"{value:.6f}"
