"""What every part of a rig file is made of: numbers with their ranges, and settings that are frozen."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from typing import Annotated, Any, TypeVar

from pydantic import AfterValidator, BaseModel, ConfigDict, Discriminator, Field, model_validator

from fitctl.config.conflict import Conflict, Conflicts, above, below

ARCSEC_PER_RAD = 180 * 3600 / math.pi


class ConfigError(Exception):
    """A rig file that cannot be used; ``str()`` gives one line for each thing that is wrong."""


# Where pydantic has a type of Python, and a rig file has another word.
_MUST_BE = {
    "model_type": "must be a table",
    "dict_type": "must be a table",
    "list_type": "must be a list",
    "tuple_type": "must be a list",
    "bool_type": "must be true or false",
}


def must_be(problem: Mapping[str, Any]) -> str:
    """What a value must be, of one problem that pydantic found with it."""
    text = str(problem["msg"]).removeprefix("Value error, ")
    return _MUST_BE.get(problem["type"]) or text.replace("Input should be", "must be")


_NAME = re.compile(r"[a-z][a-z0-9_-]{0,31}")


def is_name(text: str) -> bool:
    """Whether a rig file may give something this name: one that is safe in file names, topics and pages."""
    return _NAME.fullmatch(text) is not None


def _name(text: str) -> str:
    if not is_name(text):
        msg = "must be 1 to 32 characters: a letter a to z, then letters, digits, _ or -"
        raise ValueError(msg)
    return text


Name = Annotated[str, AfterValidator(_name)]
_MOST = 1e15  # beyond all numbers of an instrument; products and squares of a few such numbers stay finite
Positive = Annotated[float, Field(gt=0, le=_MOST, allow_inf_nan=False)]
NonNegative = Annotated[float, Field(ge=0, le=_MOST, allow_inf_nan=False)]
Finite = Annotated[float, Field(ge=-_MOST, le=_MOST, allow_inf_nan=False)]
Fraction = Annotated[float, Field(gt=0, le=1)]
TimeoutS = Annotated[float, Field(gt=0, le=60)]
DelayS = Annotated[float, Field(ge=0, le=10)]
OffsetSkyArcsec = Annotated[float, Field(ge=0, le=72_000)]
Port = Annotated[int, Field(ge=0, le=65535)]
Count = Annotated[int, Field(ge=1)]


class Settings(BaseModel):
    """A part of a rig file: frozen; unknown keys are errors, and so are numbers given as text."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class AxisPair(Settings):
    """One number for each axis."""

    az: Finite
    el: Finite


def _invertible(matrix: list[list[float]]) -> list[list[float]]:
    (a, b), (c, d) = matrix
    if a * d - b * c < _LEAST_DETERMINANT:
        msg = f"must have a determinant of at least {_LEAST_DETERMINANT:g}; [[1.0, 0.0], [0.0, 1.0]] is even"
        raise ValueError(msg)
    return matrix


_LEAST_DETERMINANT = 0.1
_Row = Annotated[list[Finite], Field(min_length=2, max_length=2)]
AxisGains = Annotated[list[_Row], Field(min_length=2, max_length=2), AfterValidator(_invertible)]
"""From a stage's angles, az and el, to those by which it turns the beam along its axes, row by row."""


class Range(Settings):
    """A closed range."""

    low: NonNegative
    high: Positive

    @model_validator(mode="after")
    def _ordered(self) -> Range:
        require_order(self.low, self.high)
        return self


def require_order(low: float, high: float) -> None:
    """Reject limits of which the low one is not below the high one.

    Raises
    ------
    Conflicts
        If so.
    """
    if low >= high:
        parts = (below("low", low, high), above("high", high, low))
        raise Conflicts([Conflict("a range goes from low to high", parts)])


def _kind_of(settings: Any) -> str:
    """A loop's kind: the `kind` of its table, or stellar without this key."""
    if isinstance(settings, dict):
        return str(settings.get("kind", STELLAR))
    return getattr(settings, "kind", STELLAR)


STELLAR, METROLOGY = "stellar", "metrology"
BY_KIND = Discriminator(_kind_of)
"""Which of two classes a loop's table is of, each marked with its kind as a pydantic ``Tag``."""

_Kind = TypeVar("_Kind", bound=Settings)


def of_kind(loops: Mapping[str, Settings], kind: type[_Kind]) -> dict[str, _Kind]:
    """The loops whose settings are of one class, in the rig file's order."""
    return {name: loop for name, loop in loops.items() if isinstance(loop, kind)}
