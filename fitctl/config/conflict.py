"""Keys of a rig file that contradict one another, each with what it must be if the others stay."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

_DIGITS = 4  # of a limit in a message
_MOST_OTHERS = 2  # keys that a message offers to change instead: the likeliest
_LONGEST = 100  # of a key or value in a message


class Part(NamedTuple):
    """One key of a conflict.

    Attributes
    ----------
    key : str
        With the tables before it, from the settings that found the conflict.
    value : object
        What the rig file has.
    must_be : str
        What the key must be if the other keys stay; empty where no value of it would do.
    """

    key: str
    value: Any
    must_be: str


class Conflict(NamedTuple):
    """Keys that cannot all be as they are.

    Attributes
    ----------
    why : str
        What would happen.
    parts : tuple of Part
        The likeliest mistake first.
    """

    why: str
    parts: tuple[Part, ...]

    def under(self, place: str) -> Conflict:
        """The same, with its keys named from further out."""
        return self._replace(
            parts=tuple(part._replace(key=f"{place}.{part.key}") for part in self.parts)
        )

    def blaming(self, changed: Callable[[str], Any]) -> Conflict:
        """The same, its keys in falling order of `changed`."""
        return self._replace(
            parts=tuple(sorted(self.parts, key=lambda part: changed(part.key), reverse=True))
        )

    def __str__(self) -> str:
        first, *others = self.parts
        must_be = f"must be {first.must_be}" if first.must_be else "does not fit"
        offered = [part for part in others if part.must_be][:_MOST_OTHERS]
        demands = [f"{short(first.key)}: {must_be} (is {shown(first.value)})"] + [
            f"or {short(part.key)} must be {part.must_be} (is {shown(part.value)})"
            for part in offered
        ]
        beside = (
            f", beside {short(others[0].key)} {shown(others[0].value)}"
            if others and not offered
            else ""
        )
        return f"{', '.join(demands)}{beside}; {self.why}"


class Conflicts(ValueError):
    """What a validator of several keys raises; ``found`` has one conflict or more."""

    def __init__(self, found: Sequence[Conflict]) -> None:
        super().__init__("; ".join(map(str, found)))
        self.found = tuple(found)


def shown(value: Any) -> str:
    """A value for people: a number as in a rig file, text in quotes."""
    return f"{value:g}" if isinstance(value, float) else written(value)


def written(value: Any) -> str:
    """A value as Python writes it, shortened as :func:`short` does."""
    try:
        return short(repr(value))
    except ValueError:  # it writes no whole number of more than 4300 digits
        return "a number of thousands of digits"


def short(text: str, most: int = _LONGEST) -> str:
    """A text for a message; of a long one its beginning and its end."""
    return text if len(text) <= most else f"{text[: 2 * most // 3]}...{text[-most // 3 + 3 :]}"


def at_most(key: str, value: float, limit: float) -> Part:
    """A key whose value must not pass a limit; the message rounds the limit down."""
    return Part(key, value, f"at most {_rounded(limit, math.floor, value)}" if limit > 0 else "")


def below(key: str, value: float, limit: float) -> Part:
    """A key whose value must stay below a limit, which the message rounds down."""
    return Part(key, value, f"below {_rounded(limit, math.floor, value)}" if limit > 0 else "")


def at_least(key: str, value: float, limit: float) -> Part:
    """A key whose value must reach a limit; the message rounds the limit up."""
    return Part(
        key, value, f"at least {_rounded(limit, math.ceil, value)}" if limit < math.inf else ""
    )


def above(key: str, value: float, limit: float) -> Part:
    """A key whose value must pass a limit, which the message rounds up."""
    return Part(
        key, value, f"above {_rounded(limit, math.ceil, value)}" if limit < math.inf else ""
    )


def _rounded(limit: float, direction: Callable[[float], int], value: float) -> str:
    """The limit with few digits; rounded towards what is allowed, but for the last bits of a float.

    That of an integer value is an integer.
    """
    if limit == 0 or not math.isfinite(limit):
        return f"{limit:g}"
    few = float(f"{limit:.{_DIGITS}g}")
    if not math.isclose(few, limit, rel_tol=1e-9):
        step = 10.0 ** (math.floor(math.log10(abs(limit))) - _DIGITS + 1)
        few = direction(limit / step) * step
    text = f"{few:.10g}"
    return str(direction(float(text))) if isinstance(value, int) else text
