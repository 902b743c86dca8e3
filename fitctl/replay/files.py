"""The files that a log's rig names, out of the log: on the disk they may hold something else by now."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fitctl.config import CONTROLLERS, Rig, is_name
from fitctl.logging.errors import LogError
from fitctl.logging.reading import LogInfo
from fitctl.logging.schemas import dark_npy_of


@contextmanager
def logged_files(info: LogInfo) -> Iterator[list[str]]:
    """The log's dark frame, and the designs that came from files, as files of this context's folder.

    Yields
    ------
    list of str
        What makes the log's rig name them: overrides, as :func:`fitctl.config.load_rig` takes them.

    Raises
    ------
    LogError
        If the dark frame in the log is damaged.
    """
    with tempfile.TemporaryDirectory(prefix="fitctl-replay-") as folder:
        contents: list[tuple[str, str, bytes]] = []  # name of its own, key of the rig, content
        try:
            dark_npy = dark_npy_of(info.metadata)
        except ValueError as error:
            msg = f"{info.path}: {error}; replay another copy of it, or give --rig FILE"
            raise LogError(msg) from None
        if dark_npy is not None:
            contents.append(("dark.npy", "camera.dark_file", dark_npy))
        for number, (loop, text) in enumerate(info.metadata.get("designs", {}).items()):
            # A loop of another name is refused with the rig, and is no key of an override.
            if is_name(loop) and _controller(info, loop) not in CONTROLLERS:
                key = f"loops.{loop}.vernier.controller"
                contents.append((f"design-{number}.json", key, text.encode()))
        for name, _, content in contents:
            (Path(folder) / name).write_bytes(content)
        yield [f"{key}={json.dumps(f'{folder}/{name}')}" for name, key, _ in contents]


def missing_dark_file(info: LogInfo, rig: Rig) -> str | None:
    """The name of a dark frame that the log does not hold, if the rig has none in its place; else None."""
    named = _table(_document(info), "camera").get("dark_file")
    if named is None or rig.camera.dark_file is not None:
        return None
    return str(named)


def _document(info: LogInfo) -> dict[str, Any]:
    try:
        document = json.loads(info.metadata["rig"]["json"])
    except (KeyError, ValueError, RecursionError):  # said where the rig itself is read
        return {}
    return document if isinstance(document, dict) else {}


def _table(document: Mapping[str, Any], key: str) -> dict[str, Any]:
    table = document.get(key)
    return table if isinstance(table, dict) else {}


def _controller(info: LogInfo, loop: str) -> str:
    of_loop = _table(_table(_document(info), "loops"), loop)
    return str(_table(of_loop, "vernier").get("controller", ""))
