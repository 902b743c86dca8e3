"""What people write for sequences: TOML, YAML and, for lists of stars, CSV, as dictionaries."""

from __future__ import annotations

import csv
import os
from pathlib import Path
from typing import Any

from fitctl.config import ConfigError
from fitctl.config.reading import read_text, read_toml

_RENAMED = {"jog": "dither"}  # shipped sequences of an older fitctl
YAML_SUFFIXES = (".yaml", ".yml")
SUFFIXES = (".toml", *YAML_SUFFIXES)


def _shipped_folder() -> Path:
    """Where the shipped sequences are: beside the package in a checkout, inside it once installed."""
    package = Path(__file__).parent.parent
    installed = package / "shipped_sequences"
    return installed if installed.exists() else package.parent / "sequences"


def find_sequence(name: Path) -> Path:
    """The file of a sequence: as given, or a shipped one by its bare name.

    Raises
    ------
    ConfigError
        If it is the old name of a shipped one.
    """
    if os.path.isfile(name) or name.parent != Path() or name.suffix:  # also for what is no path
        return name
    if str(name) in _RENAMED:
        msg = f"{name}: the shipped sequence {name} is now {_RENAMED[str(name)]}"
        raise ConfigError(msg)
    return next((path for path in shipped_sequences() if path.stem == str(name)), name)


def shipped_sequences() -> list[Path]:
    """The files of the shipped sequences, by name."""
    return sorted(path for path in _shipped_folder().iterdir() if path.suffix in SUFFIXES)


def read_document(path: Path, missing: str) -> dict[str, Any]:
    """The content of a TOML or YAML file, by its suffix; `missing` is the error where there is no file.

    Raises
    ------
    ConfigError
        If it is missing, cannot be read, is not what its suffix says or has no keys.
    """
    if path.suffix not in YAML_SUFFIXES:
        return read_toml(path, missing)
    document = parse_yaml(read_text(path, missing), path)
    if not isinstance(document, dict):
        msg = f"{path}: must have keys, such as schema_version: 1"
        raise ConfigError(msg)
    return document


def parse_yaml(text: str, path: Path) -> Any:
    """What a YAML text says; `path` is what errors call it.

    Raises
    ------
    ConfigError
        If it is not YAML.
    """
    # YAML 1.2, where no and on are words and 12:30 is no number; a key given twice is an error.
    from ruamel.yaml import YAML
    from ruamel.yaml.error import MarkedYAMLError, YAMLError

    try:
        return YAML(typ="safe", pure=True).load(text)
    except MarkedYAMLError as error:
        mark = error.problem_mark
        where = "" if mark is None else f" (at line {mark.line + 1}, column {mark.column + 1})"
        problem = f"{error.problem}{where}"
    except (YAMLError, ValueError, RecursionError) as error:
        problem = str(error).splitlines()[0]
    msg = f"{path}: not YAML: {problem}"
    raise ConfigError(msg)


def read_table(path: Path, key: str, missing: str) -> list[tuple[str, Any]]:
    """A list of tables, each with where it is in the file: the lines of a CSV, or what `key` says.

    A CSV names its columns in its first line; lines that begin with # are left out.

    Raises
    ------
    ConfigError
        As :func:`read_document`, or if there is no such list.
    """
    if path.suffix == ".csv":
        return _parse_csv(read_text(path, missing), path)
    rows = read_document(path, missing).get(key)
    if not isinstance(rows, list):
        msg = f"{path}: {key}: must be a list of tables, [[{key}]] in TOML"
        raise ConfigError(msg)
    return [(f"{path}: {key} {number}", row) for number, row in enumerate(rows, start=1)]


def _parse_csv(text: str, path: Path) -> list[tuple[str, Any]]:
    try:
        rows = [
            (number, next(csv.reader([line], skipinitialspace=True, strict=True)))
            for number, line in enumerate(text.splitlines(), start=1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
    except csv.Error as error:  # also a quoted text over several lines
        msg = f"{path}: not CSV: {error}"
        raise ConfigError(msg) from None
    if not rows:
        msg = f"{path}: is empty; its first line must name the columns"
        raise ConfigError(msg)
    (_, names), *rest = rows
    if twice := sorted({name for name in names if names.count(name) > 1}):
        msg = f"{path}: column {twice[0]} is there twice; give each column once"
        raise ConfigError(msg)
    for number, row in rest:
        if len(row) != len(names):
            msg = f"{path}: line {number}: {len(row)} values for {len(names)} columns"
            raise ConfigError(msg)
    return [
        (
            f"{path}: line {number}",
            {
                # A star may be called by a number, of which each digit counts.
                name: text.strip() if name == "name" else _number(text)
                for name, text in zip(names, row, strict=True)
                if text.strip()
            },
        )
        for number, row in rest
    ]


def _number(text: str) -> float | str:
    try:
        return float(text)
    except ValueError:
        return text.strip()
