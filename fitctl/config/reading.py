"""Rig files: TOML in, a rig or one line for each thing that is wrong out."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, NamedTuple, get_args, get_origin

from pydantic import ValidationError

from fitctl.config.base import METROLOGY, STELLAR, ConfigError, Settings, must_be
from fitctl.config.checks import rig_conflicts
from fitctl.config.conflict import Conflict, Conflicts, short, written
from fitctl.config.devices import DEVICE_BY_TAG, DEVICE_TABLES
from fitctl.config.interlocks import RENAMED_ACTIONS
from fitctl.config.loops import CONTROLLERS
from fitctl.config.origins import Layer, Marks, changed_by, layer_of, lies_on, mark_layer
from fitctl.config.rig import SCHEMA_VERSION, Rig
from fitctl.files import read_regular
from fitctl.text import plain

_EXAMPLE = "camera.frame_rate_hz=50.0"
_SET = "--set"
_MOST_BASES = 5
_MOST_BYTES = 10 << 20
_MOST_CHARACTERS_IN_LOG = 1 << 20
_MOST_EXPLAINED = 50
_LONGEST_PATH = 4096
_LONGEST_REASON = 2000


class LaidOver(NamedTuple):
    """A rig's document, laid together from its files and overrides, and where each value comes from."""

    document: dict[str, Any]
    marks: Marks


def load_rig(path: Path, overrides: Sequence[str] = ()) -> Rig:
    """Read and validate a rig file.

    It is laid over the rig file that its ``base`` names, if it names one, which may have a base itself; then
    the fragments of its ``include`` list are laid over it, in order.

    Parameters
    ----------
    path : Path
        The TOML file.
    overrides : sequence of str
        ``key.path=value`` texts that replace values of the file; the value is read as TOML, or as
        plain text where it is not TOML.

    Raises
    ------
    ConfigError
        One line for each thing that is wrong: file, key, what is allowed.
    """
    return rig_from_parts(read_parts(path, overrides), str(path))


def read_parts(path: Path, overrides: Sequence[str] = ()) -> LaidOver:
    """Read a rig file and what it names, without validating the values; arguments as of :func:`load_rig`.

    Raises
    ------
    ConfigError
        If a file is missing or is not TOML, or an override has no value's key.
    """
    missing = (
        "no such rig file; name another with --rig, or write one with: fitctl init my-rig.toml"
    )
    return lay_parts(path, read_toml(path, missing), overrides)


def lay_parts(path: Path, document: dict[str, Any], overrides: Sequence[str] = ()) -> LaidOver:
    """As :func:`read_parts`, for a document in the place of the file's content; it is changed.

    Raises
    ------
    ConfigError
        As :func:`read_parts`.
    """
    _place_files(document, path)
    layers = _bases_of(path, document)
    layers.append((str(path), "", document))
    fragments: Any = []
    namer = path
    for origin, _, part in layers:  # the list of the uppermost file that has one
        if "include" in part:
            fragments, namer = part.pop("include"), Path(origin)
    if not isinstance(fragments, list) or not all(isinstance(name, str) for name in fragments):
        msg = f"{namer}: include: must be a list of file names (is {written(fragments)})"
        raise ConfigError(msg)
    for fragment in [namer.parent / name for name in fragments]:
        missing = f"no such rig file; it is in the include list of {namer}"
        layers.append((str(fragment), "include", _read_part(fragment, missing)))
    laid = LaidOver({}, {})
    for depth, (origin, role, part) in enumerate(layers):
        mark_layer(laid.marks, laid.document, part, Layer(origin, role, depth))
        lay_over(laid.document, part)
    for depth, override in enumerate(overrides, start=len(layers)):
        _override(laid, override, depth)
    return laid


def _bases_of(path: Path, document: dict[str, Any]) -> list[tuple[str, str, dict[str, Any]]]:
    """The rig files under one, the lowest first: a base may have a base itself."""
    found: list[tuple[str, str, dict[str, Any]]] = []
    while (base := document.pop("base", None)) is not None:
        if not isinstance(base, str):
            msg = f"{path}: base: must be a file name (is {written(base)})"
            raise ConfigError(msg)
        if len(found) == _MOST_BASES:
            msg = (
                f"{path}: base: {short(base)} would be more than {_MOST_BASES} files under a rig file; see "
                "whether a file is its own base"
            )
            raise ConfigError(msg)
        missing = f"no such rig file; it is the base of {path}"
        path = path.parent / base
        document = _read_part(path, missing)
        found.insert(0, (str(path), "base", document))
    return found


def _read_part(path: Path, missing: str) -> dict[str, Any]:
    """A rig file, its base or a fragment; a file that it names is beside it."""
    document = read_toml(path, missing)
    _place_files(document, path)
    return document


def _place_files(document: dict[str, Any], path: Path) -> None:
    camera = document.get("camera")
    if isinstance(camera, dict) and isinstance(camera.get("dark_file"), str):
        camera["dark_file"] = str(path.parent / camera["dark_file"])


def read_toml(path: Path, missing: str) -> dict[str, Any]:
    """A TOML file's content; `missing` is said where there is no file.

    Raises
    ------
    ConfigError
        If it is missing, cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(read_text(path, missing))
    except (ValueError, RecursionError) as error:  # also too many digits, and tables too deep
        why = short(str(error), _LONGEST_REASON)
        msg = f"{path}: not TOML: {why}; correct it there: expected key = value, or [table]"
        raise ConfigError(msg) from None


def read_text(path: Path, missing: str) -> str:
    """A file's text; `missing` is said where there is no file.

    Raises
    ------
    ConfigError
        If it is missing, cannot be read, is not a regular file or has more than 10 MiB.
    """
    name = short(str(path), _LONGEST_PATH)
    try:
        return read_regular(path, _MOST_BYTES).decode("utf-8-sig").replace("\r\n", "\n")
    except FileNotFoundError:
        msg = f"{name}: {missing}"
        raise ConfigError(msg) from None
    except OSError as error:
        msg = (
            f"{name}: cannot be read: {error.strerror}; give a regular text file of at most "
            f"{_MOST_BYTES >> 20} MiB that you may read"
        )
        raise ConfigError(msg) from None
    except ValueError as error:  # no UTF-8, or a NUL in the path
        msg = f"{name}: cannot be read: {error}; expected a text file in UTF-8"
        raise ConfigError(msg) from None


def lay_over(document: dict[str, Any], fragment: Mapping[str, Any]) -> None:
    """Lay a fragment over a document, table by table: what the fragment says holds.

    A table that names another driver is another device: nothing of what it lies on is left.
    """
    for key, value in fragment.items():
        under = document.get(key)
        if lies_on(under, value):
            lay_over(under, value)
        else:
            document[key] = value


def rig_from_document(document: Mapping[str, Any], origin: str) -> Rig:
    """Validate a rig that is already a dictionary; `origin` is what errors call it.

    Raises
    ------
    ConfigError
        As :func:`load_rig`.
    """
    return rig_from_parts(_marked(document, origin), origin)


def _marked(document: Mapping[str, Any], origin: str) -> LaidOver:
    laid = LaidOver(dict(document), {})
    mark_layer(laid.marks, {}, laid.document, Layer(origin, "", 0))
    return laid


def rig_from_parts(laid: LaidOver, origin: str) -> Rig:
    """Validate a rig; errors name the file that has the value, or `origin` where no file has it.

    Raises
    ------
    ConfigError
        As :func:`load_rig`.
    """
    rig = _valid(laid, origin)
    if conflicts := list(rig_conflicts(rig)):
        raise ConfigError("\n".join(map(plain, _blamed(laid, origin, conflicts, ""))))
    return rig


def _valid(laid: LaidOver, origin: str, most_explained: int = _MOST_EXPLAINED) -> Rig:
    version = laid.document.get("schema_version")
    if isinstance(version, int) and version != SCHEMA_VERSION:
        # One line: many keys of the other version are missing, too.
        place = _place(laid, origin, ["schema_version"])
        why = "a newer fitctl wrote this file: use that one"
        if version < SCHEMA_VERSION:
            why = (
                "an older fitctl wrote this file. To write it for this one: "
                f"fitctl rig upgrade {place}"
            )
        msg = f"{place}: schema_version: must be {SCHEMA_VERSION} (is {short(str(version))}); {why}"
        raise ConfigError(plain(msg))
    try:
        return Rig.model_validate(laid.document)
    except ValidationError as error:
        lines = _explained(laid, origin, error.errors(), most_explained)
        raise ConfigError("\n".join(map(plain, lines))) from None


def _explained(laid: LaidOver, origin: str, problems: Sequence[Any], most: int) -> list[str]:
    """A line for each problem, at most `most`: explaining an unknown key takes time."""
    unknown = [problem for problem in problems if problem["type"] == "extra_forbidden"]
    misspelt = set(map(_meant, unknown[:_MOST_EXPLAINED]))
    apart = [
        problem
        for problem in problems
        if problem["type"] != "missing" or problem["loc"] not in misspelt
    ]
    lines = [line for problem in apart[:most] for line in _explain(laid, origin, problem)]
    left = len(lines[most:]) + len(apart[most:])
    return [*lines[: most - 1], f"{lines[most - 1]} ({left} more)"] if left else lines


def rig_from_log(text: str, origin: str, overrides: Sequence[str] = ()) -> Rig:
    """Validate the rig that a log holds as JSON, without the files that it names.

    Contradictions between its tables do not count: the rig has run, and its devices are not opened again.

    Anyone may have written the log, so no text in it becomes a path, above all not one of Python to run: the
    dark frame's file is left out, and so is a controller that is none of `CONTROLLERS`, unless an override
    names one.

    Parameters
    ----------
    text : str
        JSON.
    origin : str
        What errors call the rig.
    overrides : sequence of str
        As in :func:`load_rig`; these are the caller's own, and may name files.

    Raises
    ------
    ConfigError
        In one line, if the rig cannot be used.
    """
    try:
        return _rig_in_log(text, origin, overrides)
    except ConfigError as error:
        line = plain(str(error))
        hint = "; give a rig file of this fitctl with --rig ('fitctl rig upgrade' makes one of an older file)"
        is_own = line.startswith(f"{_SET}:")  # no other rig file would mend it
        raise ConfigError(line + ("" if is_own else hint)) from None


def _rig_in_log(text: str, origin: str, overrides: Sequence[str]) -> Rig:
    if len(text) > _MOST_CHARACTERS_IN_LOG:
        msg = f"{origin}: has {len(text)} characters; expected at most {_MOST_CHARACTERS_IN_LOG}"
        raise ConfigError(msg)
    try:
        document = json.loads(text)
    except (ValueError, RecursionError) as error:
        msg = f"{origin}: not JSON: {error}"
        raise ConfigError(msg) from None
    if not isinstance(document, dict):
        msg = f"{origin}: must be a JSON object with the rig file's tables"
        raise ConfigError(msg)
    for table, key in _files_of(document):
        del table[key]
    if document.get("schema_version") in range(1, SCHEMA_VERSION):
        # No file that could be upgraded: it is read as it is, and refused by the keys that it lacks.
        document["schema_version"] = SCHEMA_VERSION
        for _, row in old_actions(document):
            row["action"] = RENAMED_ACTIONS[row["action"]]
    try:
        laid = _marked(document, origin)
        for depth, override in enumerate(overrides, start=1):
            _override(laid, override, depth)
        return _valid(laid, origin, most_explained=1)
    except RecursionError:
        msg = f"{origin}: its tables are nested too deep to read; expected the tables of a rig file"
        raise ConfigError(msg) from None


def old_actions(document: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """The interlocks of a rig whose action has another name today, by name."""
    rows = document.get("interlocks")
    return [
        (name, row)
        for name, row in (rows.items() if isinstance(rows, dict) else ())
        if isinstance(row, dict) and str(row.get("action")) in RENAMED_ACTIONS
    ]


def _files_of(document: Mapping[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """The tables and keys of a rig that name files to read."""
    found = []
    camera = document.get("camera")
    if isinstance(camera, dict) and "dark_file" in camera:
        found.append((camera, "dark_file"))
    loops = document.get("loops")
    for loop in loops.values() if isinstance(loops, dict) else ():
        vernier = loop.get("vernier") if isinstance(loop, dict) else None
        if isinstance(vernier, dict) and vernier.get("controller", "") not in (*CONTROLLERS, ""):
            found.append((vernier, "controller"))
    return found


def _override(laid: LaidOver, text: str, depth: int) -> None:
    parts, value = parse_override(text, _EXAMPLE)
    loops = laid.document.get("loops")
    # One line here; a loop that this key alone would make lacks everything else.
    if parts[0] == "loops" and len(parts) > 2 and isinstance(loops, dict) and parts[1] not in loops:
        there_are = short(", ".join(loops))
        msg = (
            f"--set {short(text)}: there is no loop {short(parts[1])}; expected one of {there_are}"
        )
        raise ConfigError(msg)
    table: Any = laid.document
    marks: Any = laid.marks
    for length, part in enumerate(parts[:-1], start=1):
        table = table.setdefault(part, {}) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            place = short(".".join(parts[:length]))
            msg = f"--set {short(text)}: {place} is not a table; expected a value's key, such as {_EXAMPLE}"
            raise ConfigError(msg)
        marks = marks.setdefault(part, {})
    last = parts[-1]
    # A table that is given whole replaces the other one.
    under = {} if isinstance(value, dict) else table
    mark_layer(marks, under, {last: value}, Layer(_SET, "", depth))
    table[last] = value


def parse_override(text: str, example: str) -> tuple[list[str], Any]:
    """The parts of the key of ``key.path=value``, and the value: as TOML, or plain text where it is not.

    Raises
    ------
    ConfigError
        If it is not of that form.
    """
    key, equals, value_text = text.partition("=")
    parts = key.strip().split(".")
    if not equals or not all(parts):
        msg = f"--set {short(text)}: expected key.path=value, for example {example}"
        raise ConfigError(msg)
    try:
        return parts, tomllib.loads(f"value = {value_text}")["value"]
    except (ValueError, RecursionError):
        return parts, value_text


def _explain(laid: LaidOver, origin: str, problem: Any) -> list[str]:
    """What is wrong: a line, or one for each key that is to blame for a contradiction."""
    location = without_tags([str(part) for part in problem["loc"]])
    error = problem.get("ctx", {}).get("error")
    if isinstance(error, Conflicts):
        return _blamed(laid, origin, error.found, ".".join(location))
    if problem["type"] in {"union_tag_not_found", "union_tag_invalid"}:
        location.append("kind" if location[-2:-1] == ["loops"] else "driver")
    missing = problem["type"] in {"missing", "union_tag_not_found"}
    key = ".".join(location)
    # What concerns the whole file names its key itself.
    place = _place(laid, origin, location, missing=missing)
    where = f"{place}: {short(key)}" if key else origin
    return [f"{where}: {_said(problem, location, missing=missing)}"]


def _said(problem: Any, location: list[str], *, missing: bool) -> str:
    if problem["type"] == "union_tag_invalid":
        context = problem["ctx"]
        return f"must be one of {context['expected_tags']} (is {written(context['tag'])})"
    if problem["type"] == "extra_forbidden":
        allowed = _allowed_keys([str(part) for part in problem["loc"][:-1]])
        meant = _meant(problem)
        hint = f"; did you mean {meant[-1]}?" if meant else ""
        return f"unknown key{hint} (allowed here: {', '.join(allowed)})"
    if missing:
        return "is missing; a rig file that fitctl init writes has every key with its unit"
    message = short(must_be(problem), _LONGEST_REASON)
    given = problem.get("input")
    is_value = isinstance(given, str | int | float | list)
    now = RENAMED_ACTIONS.get(str(given)) if location[-1:] == ["action"] else None
    hint = f"; {given} is now {now}" if now else ""
    return f"{message} (is {written(given)}){hint}" if is_value else message


def _meant(problem: Any) -> tuple[Any, ...]:
    """The place of the key that an unknown one is most like; empty if it is like none."""
    *table, key = problem["loc"]
    allowed = _allowed_keys([str(part) for part in table])
    near = difflib.get_close_matches(short(str(key)), allowed, 1)
    return (*table, *near) if near else ()


def _blamed(laid: LaidOver, origin: str, conflicts: Sequence[Conflict], under: str) -> list[str]:
    """A line for each key to blame: of the keys of a conflict, the one that someone has changed."""
    lines: dict[str, str] = {}
    for conflict in conflicts:
        whole = conflict.under(under) if under else conflict
        blamed = whole.blaming(lambda key: changed_by(laid.marks, laid.document, key))
        key = blamed.parts[0].key
        lines.setdefault(key, f"{_place(laid, origin, key.split('.'))}: {blamed}")
    return list(lines.values())


def _place(laid: LaidOver, origin: str, path: Sequence[str], *, missing: bool = False) -> str:
    layer = layer_of(laid.marks, path, missing=missing)
    return origin if layer is None else layer.origin


def without_tags(location: Sequence[str]) -> list[str]:
    """A place in the rig file without what pydantic adds: kinds of devices and loops, a wrong key's mark."""
    return [
        part
        for index, part in enumerate(location)
        if part != "[key]" and not _is_tag(location[:index], part)
    ]


def _is_tag(before: Sequence[str], part: str) -> bool:
    """Whether this part of a place is the kind of the device or loop that is named before it."""
    if before[-2:-1] == ["loops"] and len(before) <= 3:  # a loop may have any name, also a device's
        return part in {STELLAR, METROLOGY}
    return bool(before) and before[-1] in DEVICE_TABLES and part in DEVICE_BY_TAG


def _allowed_keys(location: Sequence[str]) -> list[str]:
    """The keys that the rig file may have at `location`, by walking the settings' own fields."""
    annotation: Any = Rig
    for index, part in enumerate(location):
        if _is_tag(location[:index], part):
            annotation = DEVICE_BY_TAG.get(part) or _of_kind(annotation, part)
        elif isinstance(annotation, type) and issubclass(annotation, Settings):
            annotation = annotation.model_fields[part].annotation
        elif get_origin(annotation) in {dict, list}:
            annotation = get_args(annotation)[-1]
        elif get_origin(annotation) is tuple:
            annotation = get_args(annotation)[0]
        annotation = _without_none(annotation)
    is_settings = isinstance(annotation, type) and issubclass(annotation, Settings)
    return sorted(annotation.model_fields) if is_settings else []


def _of_kind(union: Any, kind: str) -> Any:
    """The one of a union of settings that is for loops of this kind."""
    tagged = {get_args(option)[1].tag: get_args(option)[0] for option in get_args(union)}
    return tagged[kind]


def _without_none(annotation: Any) -> Any:
    """``X`` of ``X | None`` and of ``Annotated[X, ...]``."""
    if get_origin(annotation) is Annotated:
        return get_args(annotation)[0]
    options = [option for option in get_args(annotation) if option is not type(None)]
    return options[0] if type(None) in get_args(annotation) else annotation
