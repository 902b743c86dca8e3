"""What people write for sequences: TOML and YAML, as dictionaries."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from fitctl.config import ConfigError
from fitctl.config.reading import read_text, read_toml

YAML_SUFFIXES = (".yaml", ".yml")
SUFFIXES = (".toml", *YAML_SUFFIXES)


def read_document(path: Path, missing: str) -> dict[str, Any]:
    """The content of a TOML or YAML file, by its suffix; `missing` is said where there is no file.

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
        said = f"{error.problem}{where}"
    except (YAMLError, ValueError, RecursionError) as error:
        said = str(error).splitlines()[0]
    msg = f"{path}: not YAML: {said}"
    raise ConfigError(msg)
