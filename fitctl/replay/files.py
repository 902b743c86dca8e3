"""The files that a log's rig names, out of the log: on the disk they may hold something else by now."""

from __future__ import annotations

import json
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from fitctl.config import Rig
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
        contents: dict[str, tuple[str, bytes]] = {}
        try:
            dark_npy = dark_npy_of(info.metadata)
        except ValueError as error:
            msg = f"{info.path}: {error}; replay another copy of it, or give --rig FILE"
            raise LogError(msg) from None
        if dark_npy is not None:
            contents["dark.npy"] = ("camera.dark_file", dark_npy)
        for loop, text in info.metadata.get("designs", {}).items():
            if _controller(info, loop).endswith(".json"):
                contents[f"{loop}.json"] = (f"loops.{loop}.vernier.controller", text.encode())
        for name, (_, content) in contents.items():
            (Path(folder) / name).write_bytes(content)
        yield [f"{key}={json.dumps(f'{folder}/{name}')}" for name, (key, _) in contents.items()]


def dark_of_today(info: LogInfo, rig: Rig) -> str | None:
    """The dark frame's file that was read as it is today, since the log has but its name; None without one."""
    path = rig.camera.dark_file
    known = path is not None and path == _document(info).get("camera", {}).get("dark_file")
    return path if known and "dark" not in info.metadata else None


def _document(info: LogInfo) -> dict[str, Any]:
    try:
        document = json.loads(info.metadata["rig"]["json"])
    except (KeyError, ValueError):  # said where the rig itself is read
        return {}
    return document if isinstance(document, dict) else {}


def _controller(info: LogInfo, loop: str) -> str:
    of_loop = _document(info).get("loops", {}).get(loop, {})
    return str(of_loop.get("vernier", {}).get("controller", ""))
