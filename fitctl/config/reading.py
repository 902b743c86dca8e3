"""Rig files: TOML in, a rig or one line for each thing that is wrong out."""

from __future__ import annotations

import difflib
import json
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, get_args, get_origin

from pydantic import ValidationError

from fitctl.config.base import METROLOGY, STELLAR, ConfigError, Settings
from fitctl.config.devices import DEVICE_BY_TAG
from fitctl.config.rig import Rig
from fitctl.text import plain

_EXAMPLE = "camera.frame_rate_hz=50.0"


def load_rig(path: Path, overrides: Sequence[str] = ()) -> Rig:
    """Read and validate a rig file.

    It is laid over the rig file that its ``base`` names, if it names one; then the fragments of its
    ``include`` list are laid over it, in order.

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
    document = _read_part(
        path, "no such rig file; copy rigs/fit-mock.toml or name another with --rig"
    )
    base = document.pop("base", None)
    if base is not None:
        if not isinstance(base, str):
            msg = f"{path}: base: must be a file name (is {base!r})"
            raise ConfigError(msg)
        under = _read_part(path.parent / base, f"no such rig file; it is the base of {path}")
        lay_over(under, document)
        document = under
    fragments = document.pop("include", [])
    if not isinstance(fragments, list) or not all(isinstance(name, str) for name in fragments):
        msg = f"{path}: include: must be a list of file names (is {fragments!r})"
        raise ConfigError(msg)
    said_in = dict.fromkeys(_problems(document), str(path))
    for name in fragments:
        fragment = path.parent / name
        missing = f"no such rig file; it is in the include list of {path}"
        lay_over(document, _read_part(fragment, missing))
        # What is wrong from here on, and was not before, is this fragment's.
        said_in = {what: said_in.get(what, str(fragment)) for what in _problems(document)}
    for override in overrides:
        _override(document, override)
    return rig_from_document(document, str(path), said_in)


def _read_part(path: Path, missing: str) -> dict[str, Any]:
    """A rig file, its base or a fragment; a file that it names is beside it."""
    document = read_toml(path, missing)
    camera = document.get("camera")
    if isinstance(camera, dict) and isinstance(camera.get("dark_file"), str):
        camera["dark_file"] = str(path.parent / camera["dark_file"])
    return document


def _problems(document: Mapping[str, Any]) -> list[tuple[tuple[int | str, ...], str]]:
    """What is wrong with a document: where, and what kind of error."""
    try:
        Rig.model_validate(document)
    except ValidationError as error:
        return [(problem["loc"], problem["type"]) for problem in error.errors()]
    return []


def read_toml(path: Path, missing: str) -> dict[str, Any]:
    """A TOML file's content; `missing` is said where there is no file.

    Raises
    ------
    ConfigError
        If it is missing, cannot be read or is not TOML.
    """
    try:
        return tomllib.loads(read_text(path, missing))
    except tomllib.TOMLDecodeError as error:
        msg = f"{path}: not TOML: {error}; mend it there: expected key = value, or [table]"
        raise ConfigError(msg) from None


def read_text(path: Path, missing: str) -> str:
    """A file's text; `missing` is said where there is no file.

    Raises
    ------
    ConfigError
        If it is missing or cannot be read.
    """
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        msg = f"{path}: {missing}"
        raise ConfigError(msg) from None
    except (OSError, UnicodeDecodeError) as error:
        msg = f"{path}: cannot be read: {error}; expected a text file in UTF-8 that you may read"
        raise ConfigError(msg) from None


def lay_over(document: dict[str, Any], fragment: Mapping[str, Any]) -> None:
    """Lay a fragment over a document, table by table: what the fragment says holds.

    A table that names another driver is another device: nothing of what it lies on is left.
    """
    for key, value in fragment.items():
        under = document.get(key)
        if isinstance(value, dict) and isinstance(under, dict) and _same_device(value, under):
            lay_over(under, value)
        else:
            document[key] = value


def _same_device(table: dict[str, Any], under: dict[str, Any]) -> bool:
    return "driver" not in table or table["driver"] == under.get("driver")


def rig_from_document(
    document: Mapping[str, Any],
    origin: str,
    said_in: Mapping[tuple[tuple[int | str, ...], str], str] | None = None,
) -> Rig:
    """Validate a rig that is already a dictionary.

    `origin` is what errors call it, but for those that `said_in` knows, by place and kind, from elsewhere.
    """
    known = said_in or {}
    try:
        return Rig.model_validate(document)
    except ValidationError as error:
        lines = [
            plain(_explain(known.get((problem["loc"], problem["type"]), origin), problem))
            for problem in error.errors()
        ]
        raise ConfigError("\n".join(lines)) from None


def rig_from_log(text: str, origin: str, overrides: Sequence[str] = ()) -> Rig:
    """Validate the rig that a log holds as JSON, without the files that it names.

    Anyone may have written the log, so no text in it becomes a path: the dark frame's file is left out, and a
    controller from a file is missing unless an override names one.

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
        As :func:`load_rig`.
    """
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
    for override in overrides:
        _override(document, override)
    return rig_from_document(document, origin)


def _files_of(document: Mapping[str, Any]) -> list[tuple[dict[str, Any], str]]:
    """The tables and keys of a rig that name files to read."""
    found = []
    camera = document.get("camera")
    if isinstance(camera, dict) and "dark_file" in camera:
        found.append((camera, "dark_file"))
    loops = document.get("loops")
    for loop in loops.values() if isinstance(loops, dict) else ():
        vernier = loop.get("vernier") if isinstance(loop, dict) else None
        if isinstance(vernier, dict) and str(vernier.get("controller", "")).endswith(".json"):
            found.append((vernier, "controller"))
    return found


def _override(document: dict[str, Any], text: str) -> None:
    parts, value = parse_override(text, _EXAMPLE)
    table: Any = document
    for depth, part in enumerate(parts[:-1]):
        table = table.setdefault(part, {}) if isinstance(table, dict) else None
        if not isinstance(table, dict):
            place = ".".join(parts[: depth + 1])
            msg = (
                f"--set {text}: {place} is not a table; expected a value's key, such as {_EXAMPLE}"
            )
            raise ConfigError(msg)
    table[parts[-1]] = value


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
        msg = f"--set {text}: expected key.path=value, for example {example}"
        raise ConfigError(msg)
    try:
        return parts, tomllib.loads(f"value = {value_text}")["value"]
    except tomllib.TOMLDecodeError:
        return parts, value_text


def _explain(origin: str, problem: Any) -> str:
    location = _without_tags([str(part) for part in problem["loc"]])
    if problem["type"] in {"union_tag_not_found", "union_tag_invalid"}:
        location.append("kind" if location[-2:-1] == ["loops"] else "driver")
    key = ".".join(location)
    if problem["type"] == "union_tag_invalid":
        context = problem["ctx"]
        allowed_tags = context["expected_tags"]
        return f"{origin}: {key}: must be one of {allowed_tags} (is {context['tag']!r})"
    if problem["type"] == "extra_forbidden":
        allowed = _allowed_keys([str(part) for part in problem["loc"][:-1]])
        near = difflib.get_close_matches(location[-1], allowed, 1)
        hint = f"; did you mean {near[0]}?" if near else ""
        return f"{origin}: {key}: unknown key{hint} (allowed here: {', '.join(allowed)})"
    if problem["type"] in {"missing", "union_tag_not_found"}:
        return f"{origin}: {key}: is missing; rigs/fit-mock.toml shows every key with its unit"
    message = problem["msg"].removeprefix("Value error, ").replace("Input should be", "must be")
    given = problem.get("input")
    shown = f" (is {given!r})" if isinstance(given, str | int | float | list) else ""
    # What concerns the whole file names its key itself.
    where = f"{origin}: {key}" if key else origin
    return f"{where}: {message}{shown}"


def _without_tags(location: Sequence[str]) -> list[str]:
    """A place in the rig file without what pydantic adds: kinds of devices and loops, a wrong key's mark."""
    return [
        part
        for index, part in enumerate(location)
        if part != "[key]" and not _is_tag(location[:index], part)
    ]


def _is_tag(before: Sequence[str], part: str) -> bool:
    """Whether this part of a place is the kind of the device or loop that is named before it."""
    if before[-1:] == ["device"]:
        return part in DEVICE_BY_TAG
    return before[-2:-1] == ["loops"] and len(before) <= 3 and part in {STELLAR, METROLOGY}


def _allowed_keys(location: Sequence[str]) -> list[str]:
    """The keys that the rig file may have at `location`, by walking the settings' own fields."""
    annotation: Any = Rig
    for index, part in enumerate(location):
        if part in DEVICE_BY_TAG:
            annotation = DEVICE_BY_TAG[part]
        elif _is_tag(location[:index], part):
            annotation = _of_kind(annotation, part)
        elif isinstance(annotation, type) and issubclass(annotation, Settings):
            annotation = annotation.model_fields[part].annotation
        elif get_origin(annotation) in {dict, list}:
            annotation = get_args(annotation)[-1]
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
