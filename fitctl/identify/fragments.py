"""What has been measured, as text to lay over a rig file."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import tomli_w

from fitctl.config import Rig


def fragment_text(by: str, rig: Rig, lines: Iterable[str], fragment: Mapping[str, Any]) -> str:
    """A fragment for a rig file's include list, under who wrote it and what it says for people."""
    when = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    notes = "".join(f"# {line}\n" for line in lines)
    return f"# Written by `{by}` for rig {rig.name}, {when}.\n{notes}\n" + tomli_w.dumps(fragment)


def write_whole(path: Path, content: bytes) -> None:
    """Write a file that, whenever the power fails, is the old one or the new one, and never a part of it.

    Raises
    ------
    OSError
        If it cannot be written; the old one is still there then.
    """
    with tempfile.NamedTemporaryFile(
        dir=path.parent, prefix=".", suffix=".part", delete=False
    ) as file:
        temporary = Path(file.name)
        try:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
            temporary.chmod(0o644)
            temporary.replace(path)
        except BaseException:
            temporary.unlink(missing_ok=True)
            raise
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(folder)  # the new name too
    finally:
        os.close(folder)
