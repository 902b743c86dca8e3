"""Sequence files: TOML or YAML in, a sequence or one line for each mistake out."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, get_args

from pydantic import ValidationError

from fitctl.config import ConfigError, Rig
from fitctl.config.base import Settings, must_be
from fitctl.config.conflict import short, written
from fitctl.config.reading import parse_override
from fitctl.sequences.behaviours.table import problems
from fitctl.sequences.files import read_document, read_table, shipped_sequences
from fitctl.sequences.steps import (
    RENAMED_KEYS,
    RENAMED_STEPS,
    RENAMED_VALUES,
    AnyStep,
    Sequence,
    Star,
    Stars,
    Step,
)

STEPS: dict[str, type[Step]] = {
    kind.model_fields["step"].default: kind for kind in get_args(AnyStep)
}


def load_sequence(path: Path, rig: Rig, overrides: Iterable[str] = ()) -> Sequence:
    """Read a sequence file and check it for a rig, without the instrument.

    `overrides` are ``steps.2.key=value`` texts, or ``steps.hold.key=value`` for every step of that name.

    Raises
    ------
    ConfigError
        One line for each mistake: file, step, key, what is allowed.
    """
    sequence = read_sequence(path, overrides)
    wrong = [
        f"{path}: step {number} ({step.step}): {problem}"
        for number, step in enumerate(sequence.steps, start=1)
        for problem in problems(step, rig)
    ]
    if wrong:
        raise ConfigError("\n".join(wrong))
    return sequence


def read_sequence(path: Path, overrides: Iterable[str] = ()) -> Sequence:
    """Read a sequence file, for whatever rig; `overrides` as :func:`load_sequence`.

    Raises
    ------
    ConfigError
        One line for each mistake.
    """
    names = ", ".join(file.stem for file in shipped_sequences())
    document = read_document(path, f"no such sequence file; shipped are {names}")
    steps = document.get("steps")
    if isinstance(steps, list):
        steps = document["steps"] = [_own(s) if isinstance(s, dict) else s for s in steps]
    for override in overrides:
        _override(document, override)
    for number, step in enumerate(steps if isinstance(steps, list) else [], start=1):
        if isinstance(step, dict) and step.get("step") == "stars":
            step.update(_stars_of_file(step, path.parent, f"{path}: step {number} (stars)"))
    return sequence_from_document(document, str(path))


def _own(step: Mapping[str, Any]) -> dict[str, Any]:
    """A copy: an alias in YAML gives one dictionary for several steps. Its name is a text that can be shown."""
    name = step.get("step", "")
    return dict(step) if isinstance(name, str) else {**step, "step": written(name)}


def _override(document: Mapping[str, Any], text: str) -> None:
    parts, value = parse_override(text, "steps.2.duration_s=60.0")
    listed = document.get("steps")
    steps = {
        str(number): step
        for number, step in enumerate(listed if isinstance(listed, list) else [], start=1)
        if isinstance(step, dict)
    }
    meant = [s for number, s in steps.items() if parts[1:2] in ([number], [s.get("step")])]
    if len(parts) != 3 or not meant:
        have = ", ".join(
            f"{number} ({short(str(step.get('step')))})" for number, step in steps.items()
        )
        msg = (
            f"--set {short(text)}: expected steps.NUMBER.key=value or steps.NAME.key=value; "
            f"there are {have}"
        )
        raise ConfigError(msg)
    for step in meant:
        step[parts[2]] = value


def sequence_from_document(document: Mapping[str, Any], origin: str) -> Sequence:
    """Validate a sequence that is already a dictionary; `origin` is what errors call it.

    Raises
    ------
    ConfigError
        One line for each mistake.
    """
    try:
        return Sequence.model_validate(document)
    except ValidationError as error:
        lines = [_mistake(*_place(origin, each["loc"]), each) for each in error.errors()]
        raise ConfigError("\n".join(lines)) from None


def make_step(kind: type[Step], keys: Mapping[str, Any]) -> Step:
    """A step from its keys.

    Raises
    ------
    ConfigError
        One line for each mistake.
    """
    more = _stars_of_file(keys, Path(), "stars") if kind is Stars else {}
    try:
        return kind.model_validate({**keys, **more})
    except ValidationError as error:
        name = kind.model_fields["step"].default
        lines = [_mistake(name, kind, _key(each["loc"]), each) for each in error.errors()]
        raise ConfigError("\n".join(lines)) from None


def _stars_of_file(keys: Mapping[str, Any], folder: Path, where: str) -> dict[str, Any]:
    """What replaces the file that a step names, if it names one: its stars; errors name the step as `where`.

    The step then names no file, so that it is the same step when it is written and read again.
    """
    file = keys.get("file")
    if not isinstance(file, str) or not file:
        return {}
    if keys.get("stars") is not None:
        msg = f"{where}: has both stars and file ({short(file)}); expected one of them"
        raise ConfigError(msg)
    return {"stars": [star.model_dump() for star in read_stars(folder / file)], "file": ""}


def read_stars(path: Path) -> list[Star]:
    """Read a list of stars: TOML or YAML with ``stars``, or CSV with a line for each.

    Raises
    ------
    ConfigError
        One line for each mistake: file, star or line, key.
    """
    stars, wrong = [], []
    for where, row in read_table(path, "stars", "no such list of stars"):
        try:
            stars.append(Star.model_validate(row))
        except ValidationError as error:
            wrong += [_mistake(where, Star, _key(each["loc"]), each) for each in error.errors()]
    if wrong:
        raise ConfigError("\n".join(wrong))
    return stars


def _place(origin: str, place: tuple[Any, ...]) -> tuple[str, type[Settings], str]:
    """Where a mistake is, of what kind that is, and its key: from ("steps", number, step's name, key)."""
    if len(place) < 2 or place[0] != "steps":
        return origin, Sequence, _key(place)
    where = f"{origin}: step {place[1] + 1}"
    if len(place) == 2:
        return where, Sequence, ""
    if place[3:4] == ("stars",) and len(place) > 5:
        return f"{where} ({place[2]}): star {place[4] + 1}", Star, _key(place[5:])
    return f"{where} ({place[2]})", STEPS[place[2]], _key(place[3:])


def _key(place: tuple[Any, ...]) -> str:
    return ".".join(short(str(part)) for part in place)


def _mistake(where: str, kind: type[Settings], key: str, problem: Mapping[str, Any]) -> str:
    """One mistake as one line."""
    match problem["type"]:
        case "union_tag_not_found":
            mistake = f"step is missing. Available: {', '.join(STEPS)}"
        case "union_tag_invalid":
            tag = problem["ctx"]["tag"]
            mistake = f"unknown step {written(tag)}. Available: {', '.join(STEPS)}"
            if tag in RENAMED_STEPS:
                mistake = f"step {tag!r} is now {RENAMED_STEPS[tag]!r}"
        case "extra_forbidden":
            allowed = [name for name in kind.model_fields if name != "step"]
            near = difflib.get_close_matches(key, allowed, 1)
            hint = f"; did you mean {near[0]}?" if near else ""
            if key in RENAMED_KEYS:
                hint = f"; it is now {RENAMED_KEYS[key]}"
            mistake = f"{key}: unknown key{hint} (allowed here: {', '.join(allowed)})"
        case "missing":
            mistake = f"{key}: is missing"
        case _:
            given = problem.get("input")
            what = f" (is {written(given)})" if isinstance(given, str | int | float) else ""
            message = must_be(problem) + what
            mistake = f"{key}: {message}" if key else message
            if isinstance(given, str) and (key, given) in RENAMED_VALUES:
                mistake += f"; {given} is now {RENAMED_VALUES[key, given]}"
    return f"{where}: {mistake}".replace("\n", " ")
