"""`fitctl check`: a rig file, validated."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from fitctl.commands.shared.options import JsonOption, OwnRigOption, SetOption
from fitctl.commands.shared.plant import check_plant
from fitctl.commands.shared.printing import say, to_json
from fitctl.commands.shared.rig import named_rig
from fitctl.config import ConfigError, Rig, default_rig_path
from fitctl.config.origins import Mark, Marks, marks_at
from fitctl.config.reading import read_parts, rig_from_parts
from fitctl.config.simulated import mixture

_COLUMN = 72  # of the origins, where the values before them are shorter
_DEFAULT = "default"


def check(
    file: Annotated[
        Path | None, typer.Argument(metavar="RIG", help="Rig file, in place of --rig.")
    ] = None,
    rig: OwnRigOption = None,
    overrides: SetOption = None,
    show: Annotated[
        bool,
        typer.Option("--show", help="Print every value in force, and the file that sets it."),
    ] = False,
    as_json: JsonOption = False,
) -> None:
    """Validate a rig file.

    Prints every mistake with its key and what was expected. Exit status 0 if there is none, 2 otherwise.
    """
    if file is not None and rig is not None:
        msg = f"check: expected one rig file, got {file} and --rig {rig}"
        raise ConfigError(msg)
    path = file or named_rig(rig) or default_rig_path()
    parts = read_parts(path, overrides or ())
    settings = rig_from_parts(parts, str(path))
    check_plant(settings)
    if show:
        origins = list(_origins(settings, parts.marks))
        if as_json:
            shown = {key: {"value": value, "origin": origin} for key, value, origin in origins}
            say(to_json({"file": str(path), "rig": settings.name, "values": shown}))
            return
        for key, value, origin in origins:
            say(f"{key} = {_toml(value)}".ljust(_COLUMN) + f" # {origin}")
        return
    if as_json:
        mixed = list(mixture(settings))
        say(
            to_json(
                {
                    "file": str(path),
                    "rig": settings.name,
                    "loops": list(settings.loops),
                    "notes": mixed,
                }
            )
        )
        return
    loops = ", ".join(settings.loops)
    say(f"{path}: well; rig {settings.name}, loops {loops}")
    for line in mixture(settings):
        say(line)


def _origins(rig: Rig, marks: Marks) -> Iterator[tuple[str, Any, str]]:
    """Each key, its value and its origin; as lines, a rig file that says the same as all layers together."""
    for path, value in _values(rig.model_dump(mode="json", exclude_none=True), ()):
        mark = marks_at(marks, path)
        yield ".".join(path), value, str(mark.layer) if isinstance(mark, Mark) else _DEFAULT


def _values(table: dict[str, Any], place: tuple[str, ...]) -> Iterator[tuple[tuple[str, ...], Any]]:
    for key, value in table.items():
        if isinstance(value, dict) and value:
            yield from _values(value, (*place, key))
        else:
            yield (*place, key), value


def _toml(value: Any) -> str:
    """A value as a rig file has it, on one line."""
    import tomlkit

    if isinstance(value, dict):
        return "{ " + ", ".join(f"{key} = {_toml(each)}" for key, each in value.items()) + " }"
    if isinstance(value, list):
        return f"[{', '.join(map(_toml, value))}]"
    return tomlkit.item(value).as_string()
