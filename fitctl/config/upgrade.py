"""Rig files of older versions, written anew for this one with their comments."""

from __future__ import annotations

import copy
import tomllib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import tomlkit
from pydantic import ValidationError
from tomlkit.exceptions import ParseError
from tomlkit.items import InlineTable

from fitctl.config.base import ConfigError
from fitctl.config.commented import dump_commented, parse_commented, set_value
from fitctl.config.conflict import written
from fitctl.config.interlocks import RENAMED_ACTIONS
from fitctl.config.origins import default_rig_path, layer_of
from fitctl.config.reading import (
    LaidOver,
    lay_parts,
    old_actions,
    read_text,
    rig_from_parts,
    without_tags,
)
from fitctl.config.rig import SCHEMA_VERSION, Rig

_VERSION = "schema_version"
# Where a value went that has another name or place now.
_MOVED = {("supervisor", "frame_timeout_s"): ("interlocks", "frame_missing", "stale_s")}
# What keeps an instrument as it was, where the shipped rig's value would change it; * is any loop.
_AS_BEFORE: dict[tuple[str, ...], Any] = {
    ("loops", "*", "other_spots"): [],
    ("loops", "*", "siderostat", "device", "position_limit_rad"): 0.0,
}
_MOST_ROUNDS = 20  # a table that is added may lack keys in its turn


class Change(NamedTuple):
    """One change of an upgrade.

    Attributes
    ----------
    key : str
        Of the upgraded file.
    value : str
        What it has now, on one line.
    was : str
        The value or the key in the old file; empty for a new key.
    """

    key: str
    value: str
    was: str = ""


class Upgrade(NamedTuple):
    """A rig file for this version.

    Attributes
    ----------
    text : str
        The new file's content.
    changes : list of Change
        In order.
    problems : list of str
        What is left to correct by hand, a line for each key.
    """

    text: str
    changes: list[Change]
    problems: list[str]


def upgrade(path: Path) -> Upgrade:
    """Make a rig file of an older version one of this version.

    Missing keys get the shipped rig's values, and keep their comments. Values that the file has stay.

    Parameters
    ----------
    path : Path
        The rig file; its base and fragments are read as well, and not changed.

    Raises
    ------
    ConfigError
        If a file cannot be read, needs no upgrade, or lies over an older base.
    """
    text = read_text(path, "no such rig file")
    try:
        document = parse_commented(text)
    except ParseError as error:
        msg = f"{path}: not TOML: {error}"
        raise ConfigError(msg) from None
    _insist_on_old(path, document)
    changes = [Change(_VERSION, str(SCHEMA_VERSION), str(document.get(_VERSION)))]
    moved = {new: _taken(document, old) for old, new in _MOVED.items() if _holds(document, old)}
    if _VERSION in document:
        document[_VERSION] = SCHEMA_VERSION
    for name, row in old_actions(document):
        was = str(row["action"])
        set_value(row, "action", RENAMED_ACTIONS[was])
        changes.append(Change(f"interlocks.{name}.action", _shown(row["action"]), f'"{was}"'))
    shipped = parse_commented(default_rig_path().read_text(encoding="utf-8"))
    for _ in range(_MOST_ROUNDS):
        added = [_add(path, document, shipped, key) for key in _missing(_laid(path, document))]
        changes += [change for change in added if change is not None]
        if not any(added):
            break
    for old, new in _MOVED.items():
        if new in moved:
            _put(path, document, new, moved[new])
            changes.append(Change(".".join(new), _shown(moved[new]), ".".join(old)))
    return Upgrade(_dumped(path, document), changes, _problems(path, document))


def _dumped(path: Path, document: tomlkit.TOMLDocument) -> str:
    text = dump_commented(document)
    try:
        is_same = tomllib.loads(text) == document.unwrap()
    except ValueError:
        is_same = False
    if not is_same:  # tomlkit does not add a table under a dotted key as such
        msg = f"{path}: its dotted keys (a.b = 1) have no place for new tables; write [a] and b = 1 instead"
        raise ConfigError(msg)
    return text


def _insist_on_old(path: Path, document: tomlkit.TOMLDocument) -> None:
    laid = _laid(path, document)
    version = laid.document.get(_VERSION)
    layer = layer_of(laid.marks, [_VERSION])
    has_old = any(_holds(document, old) for old in _MOVED) or old_actions(document)
    if version == SCHEMA_VERSION and not has_old:
        msg = f"{path}: has {_VERSION} {SCHEMA_VERSION} and needs no upgrade"
        raise ConfigError(msg)
    if version not in range(1, SCHEMA_VERSION + 1):
        msg = f"{path}: {_VERSION}: expected 1 to {SCHEMA_VERSION}, is {written(version)}"
        raise ConfigError(msg)
    if version != SCHEMA_VERSION and layer is not None and layer.role == "base":
        msg = (
            f"{path}: its base {layer.origin} has {_VERSION} {version}; upgrade that file first, and name "
            "the new one as base"
        )
        raise ConfigError(msg)


def _laid(path: Path, document: tomlkit.TOMLDocument) -> LaidOver:
    return lay_parts(path, document.unwrap())


def _missing(laid: LaidOver) -> list[tuple[str, ...]]:
    try:
        Rig.model_validate(laid.document)
    except ValidationError as error:
        return [
            tuple(without_tags([str(part) for part in problem["loc"]]))
            for problem in error.errors()
            if problem["type"] == "missing"
        ]
    return []


def _add(
    path: Path, document: Any, shipped: tomlkit.TOMLDocument, key: tuple[str, ...]
) -> Change | None:
    """Add a missing key with the shipped rig's value and comment; None if no shipped rig has it."""
    item = _item(shipped, key)
    if item is None:
        return None
    value = copy.deepcopy(item)
    for pattern, before in _AS_BEFORE.items():
        if _matches(key, pattern):
            value = tomlkit.item(before)
            if item.trivia.comment:
                value.comment(item.trivia.comment)
    _put(path, document, key, value)
    return Change(".".join(key), _shown(value))


def _matches(key: Sequence[str], pattern: Sequence[str]) -> bool:
    same = zip(key, pattern, strict=False)
    return len(key) == len(pattern) and all(b in {"*", a} for a, b in same)


def _item(shipped: tomlkit.TOMLDocument, key: Sequence[str]) -> Any:
    """The shipped rig's item at a key; a loop of another name is its one loop."""
    found: Any = shipped
    for place, part in enumerate(key):
        name = "right" if key[:place][-1:] == ("loops",) else part
        if not isinstance(found, dict) or name not in found:
            return None
        # A table's own item keeps its comment; a whole table comes as it is.
        found = found.item(name) if hasattr(found, "item") else found[name]
    return found


def _holds(document: Any, key: Sequence[str]) -> bool:
    for part in key:
        if not isinstance(document, dict) or part not in document:
            return False
        document = document[part]
    return True


def _taken(document: Any, key: Sequence[str]) -> Any:
    """Remove a value; returns it."""
    for part in key[:-1]:
        document = document[part]
    value = document.pop(key[-1])
    return value.unwrap() if hasattr(value, "unwrap") else value  # a truth value is Python's own


def _put(path: Path, document: Any, key: Sequence[str], value: Any) -> None:
    for depth, part in enumerate(key[:-1], start=1):
        table = document.setdefault(part, tomlkit.table())
        if isinstance(table, InlineTable):  # which has no place for a table or a comment
            document[part] = _opened(table)
            table = document[part]
        if not isinstance(table, dict):
            here, rest = ".".join(key[:depth]), ".".join(key[depth:])
            msg = f"{path}: {here}: must be a table, because {rest} goes into it; correct it, then upgrade"
            raise ConfigError(msg)
        document = table
    document[key[-1]] = value


def _opened(inline: InlineTable) -> Any:
    table = tomlkit.item(inline.unwrap())
    if inline.trivia.comment:
        table.comment(inline.trivia.comment)
    return table


def _shown(value: Any) -> str:
    """A value on one line; of a table, how many keys it has."""
    if isinstance(value, dict):
        count = sum(1 for _ in _leaves(value))
        return f"{{ {count} values of the shipped rig }}"
    return " ".join(tomlkit.item(value).as_string().split())


def _leaves(table: dict[str, Any]) -> Iterator[Any]:
    for value in table.values():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield value


def _problems(path: Path, document: tomlkit.TOMLDocument) -> list[str]:
    try:
        rig_from_parts(_laid(path, document), str(path))
    except ConfigError as error:
        return str(error).splitlines()
    return []
