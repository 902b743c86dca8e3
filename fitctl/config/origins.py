"""Where each value of a rig comes from: which file, include, base or ``--set`` had the last word."""

from __future__ import annotations

import functools
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple, TypeGuard


class Layer(NamedTuple):
    """One of the documents that a rig is laid together from.

    Attributes
    ----------
    origin : str
        What errors call it: a file's path, or ``--set``.
    role : str
        How the rig file refers to it: ``base``, ``include``, or empty for the rig file itself.
    depth : int
        0 for the lowest.
    """

    origin: str
    role: str
    depth: int

    def __str__(self) -> str:
        return f"{self.origin} ({self.role})" if self.role else self.origin


class Mark(NamedTuple):
    """The origin of one value.

    Attributes
    ----------
    layer : Layer
        Which had the last word.
    changed_at : int
        Depth of the last layer that changed the value; layers that repeat it do not count.
    """

    layer: Layer
    changed_at: int


Marks = dict[str, Any]
"""The tables of a rig, each value replaced with its `Mark`."""


class Given(dict[str, Any]):
    """The marks of a table that one layer gave as a whole, perhaps without a value to show whose it is."""

    def __init__(self, marks: Marks, layer: Layer) -> None:
        super().__init__(marks)
        self.layer = layer


def lies_on(under: Any, value: Any) -> TypeGuard[dict[str, Any]]:
    """Whether a table is laid over another; a table that names another driver replaces the other one."""
    return (
        isinstance(value, dict)
        and isinstance(under, dict)
        and ("driver" not in value or value["driver"] == under.get("driver"))
    )


def mark_layer(
    marks: Marks, under: Mapping[str, Any], over: Mapping[str, Any], layer: Layer
) -> None:
    """Mark what a layer says, before it is laid over the document `under`."""
    for key, value in over.items():
        below = under.get(key)
        if lies_on(below, value):
            mark_layer(marks[key], below, value, layer)
        else:
            marks[key] = _mark(value, layer, below, marks.get(key))


def _mark(value: Any, layer: Layer, below: Any, before: Any) -> Any:
    if isinstance(value, dict):
        return Given({key: _mark(each, layer, None, None) for key, each in value.items()}, layer)
    if isinstance(before, Mark) and value == below:
        return Mark(layer, before.changed_at)
    return Mark(layer, layer.depth)


def marks_at(marks: Marks, path: Sequence[str]) -> Any:
    """The mark of a value, or the marks of the innermost table on the way to it."""
    found: Any = marks
    for part in path:
        if not isinstance(found, dict) or part not in found:
            break
        found = found[part]
    return found


def layer_of(marks: Marks, path: Sequence[str], *, missing: bool = False) -> Layer | None:
    """The layer to correct: where the value is, or the table's newest value; its oldest, if one is missing."""
    layers = sorted(_layers(marks_at(marks, path)), key=lambda layer: layer.depth)
    if not layers:
        return None
    return layers[0] if missing else layers[-1]


def _layers(found: Any) -> list[Layer]:
    if isinstance(found, Mark):
        return [found.layer]
    if not found and isinstance(found, Given):
        return [found.layer]
    return [layer for each in found.values() for layer in _layers(each)]


def changed_by(marks: Marks, document: Mapping[str, Any], key: str) -> tuple[int, int]:
    """How likely a key is the one that someone has changed, for comparison with other keys.

    First counts how late in the layers its value changed; then whether it differs from the shipped default
    rig, and whether from all shipped rigs.
    """
    path = key.split(".")
    found = marks_at(marks, path)
    depth = max((mark.changed_at for mark in _all_marks(found)), default=0)
    value: Any = document
    for part in path:
        value = value.get(part) if isinstance(value, dict) else None
    if value is None:
        return depth, 0
    return depth, sum(value not in _values_of(path, rigs) for rigs in (_default_rig(), _shipped()))


def _all_marks(found: Any) -> list[Mark]:
    if isinstance(found, Mark):
        return [found]
    return [mark for each in found.values() for mark in _all_marks(each)]


def default_rig_path() -> Path:
    """The shipped default rig: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).parent.parent
    installed = package / "rigs" / "fit-mock.toml"
    return installed if installed.exists() else package.parent / "rigs" / "fit-mock.toml"


_Values = dict[tuple[str, ...], list[Any]]


@functools.cache
def _default_rig() -> _Values:
    return _values_in([default_rig_path()])


@functools.cache
def _shipped() -> _Values:
    return _values_in(default_rig_path().parent.glob("*.toml"))


def _values_of(path: Sequence[str], rigs: _Values) -> list[Any]:
    """The values that a key has in some rigs; of a loop that none of them has, those of any loop."""
    return rigs.get(tuple(path)) or rigs.get(_of_any_loop(path), [])


def _values_in(files: Iterable[Path]) -> _Values:
    values: _Values = {}
    for file in files:
        with suppress(OSError, ValueError):  # one that is none says nothing
            _collect(tomllib.loads(file.read_text(encoding="utf-8")), [], values)
    return values


def _collect(table: Mapping[str, Any], path: list[str], values: _Values) -> None:
    for key, value in table.items():
        here = [*path, key]
        for place in {tuple(here), _of_any_loop(here)}:
            values.setdefault(place, []).append(value)
        if isinstance(value, dict):
            _collect(value, here, values)


def _of_any_loop(path: Sequence[str]) -> tuple[str, ...]:
    return tuple("*" if path[:n][-1:] == ["loops"] else part for n, part in enumerate(path))
