"""The mock controller's ASCII commands: a line in, an answer out.

Axes are ``@0`` and ``@1`` or names; parentheses, commas and blanks are all the same between words, as
public clients write ``AXISFAULT(@0)``, ``AXISFAULT @0``, ``MOVEABS X 1`` and ``MOVEABS X1 XF10 Y2 YF10``.

``POSOFFSET SET @0, 1.5`` gives the program another zero: PFBKPROG, PCMDPROG and the targets of moves follow;
PFBK, software limits and homing do not. ``PROGRAM RUN 5, "HomeAsync.bcx"`` homes ``IGLOBAL(32)`` axes, of
which ``IGLOBAL(33)`` is the first.

Known limitations
-----------------
- Of AeroBasic these commands only: no expressions, and of variables, programs and tasks those of that
  homing. HOME, which the real controller answers when the axis has homed, is not understood.
- One plane, in which LINEAR moves each axis by its own ramp and not along a line.
- The interpreter never waits for a move, as after WAIT MODE NOWAIT.
- A changed CountsPerUnit or ReverseMotionDirection has no effect. Whether the real controller needs a RESET
  first is unknown.

Invented or inferred
--------------------
- Of PLANESTATUS there is bit 0, set while a LINEAR runs. That MOVEABS, MOVEINC and homing do not set it is
  inferred; whether LINEAR sets bit 3 of AXISSTATUS, as here, is unknown.
- The ranges of SETPARM are those of the maker's newer controllers; ``#`` for a value out of range is invented.
- Homing goes to where the encoder was at power-up, whatever direction HomeSetup has, and no software limit
  stops it. ``#`` answers a program that is not there or cannot home, and a global integer beyond 49.
- ``perr(0)`` and ``verr(0)`` are of axis 0. POSOFFSET CLEAR is spelled as the newer controllers' function.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence

from fitctl.drivers.ensemble.protocol import FAULT_MASKS, Parameter, Reply, format_bits
from fitctl.mocks.ensemble.axis import HOME_RAMP_RATE, HOME_SPEED, Axis

_REVERSE_DIRECTION, _LIMIT_SETUP, _HOME_SETUP = 1, 61, 75
_MASKS = {
    _REVERSE_DIRECTION,
    _LIMIT_SETUP,
    _HOME_SETUP,
    Parameter.POSITION_FEEDBACK_TYPE,
    *FAULT_MASKS,
}
_ABOVE_ZERO = {
    Parameter.DEFAULT_RAMP_RATE,
    Parameter.ABORT_DECEL_RATE,
    HOME_SPEED,
    HOME_RAMP_RATE,
}
_GLOBAL_INTEGERS = 50
_HOMED_COUNT, _HOMED_FIRST = 32, 33
"""Global integers by which HomeAsync knows how many axes to home, from which one on."""
_HOME_PROGRAM = ["5", '"HOMEASYNC.BCX"']
"""The auxiliary task and the file of epics-motor's homing program."""

AXIS_NAME_NUMBERS = (99, 140)
"""Parameter AxisName: public headers disagree on its number."""

_WORD = re.compile(
    r"(?P<word>@\d+|[-+]?(?:\d+\.?\d*|\.\d+)(?:E[-+]?\d+)?|[A-Z_]+|=|\"[^\"]*\")", re.ASCII
)
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
        self._integers = [0] * _GLOBAL_INTEGERS
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
            "PFBKPROG": self._program_feedback,
            "PFBK": lambda words: _number(self._one(words).feedback),
            "PCMDPROG": self._program_command,
            "PERR": lambda words: _number(self._one_by_number(words).error),
            "VERR": lambda words: _number(self._one_by_number(words).velocity_error),
            "VFBK": lambda words: _number(self._one(words).feedback_velocity),
            "GETPARM": self._get_parameter,
            "SETPARM": self._set_parameter,
            "POSOFFSET": self._position_offset,
            "IGLOBAL": self._global_integer,
            "PROGRAM": self._program,
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

    def _one_by_number(self, words: Words) -> Axis:
        """The axis, which a bare number may name too."""
        return self._one([f"@{word}" if word.isdecimal() else word for word in words])

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
                places[axis] = value + (axis.command if incremental else -axis.offset)
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

    def _program_feedback(self, words: Words) -> str:
        axis = self._one(words)
        return _number(axis.feedback + axis.offset)

    def _program_command(self, words: Words) -> str:
        axis = self._one(words)
        return _number(axis.command + axis.offset)

    def _position_offset(self, words: Words) -> bool:
        """``POSOFFSET SET @0, 1.5`` and ``POSOFFSET CLEAR @0``, each of one axis or several."""
        _require(len(words) >= 2)
        what = words.pop(0)
        if what == "CLEAR":
            _require(all(word in self._numbers for word in words))
            for word in words:
                self._axes[self._numbers[word]].offset = 0.0
            return True
        _require(what == "SET")
        wishes = []
        while words:
            axis = self._pop_axis(words)
            _require(bool(words))
            wishes.append((axis, _float(words.pop(0))))
        for axis, position in wishes:
            axis.set_program_position(position)
        return True

    def _global_integer(self, words: Words) -> bool | str:
        """``IGLOBAL(32)`` and ``IGLOBAL(32) = 1``."""
        _require(bool(words) and words[0].isdecimal())
        number = int(words.pop(0))
        if number >= _GLOBAL_INTEGERS:
            return False
        if not words:
            return str(self._integers[number])
        _require(len(words) == 2 and words[0] == "=")
        value = _float(words[1])
        _require(value.is_integer() and abs(value) < 2**31)
        self._integers[number] = int(value)
        return True

    def _program(self, words: Words) -> bool:
        """``PROGRAM RUN 5, "HomeAsync.bcx"``: each axis begins to home if it can."""
        _require(len(words) == 3 and words[0] == "RUN")
        first, count = self._integers[_HOMED_FIRST], self._integers[_HOMED_COUNT]
        axes = self._axes[first : first + count] if first >= 0 and count > 0 else []
        if words[1:] != _HOME_PROGRAM or not axes or len(axes) != count:
            return False
        done = [axis.home() for axis in axes]
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
