"""What has been measured, as text to lay over a rig file."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from typing import Any

import tomli_w

from fitctl.config import Rig


def fragment_text(by: str, rig: Rig, lines: Iterable[str], fragment: Mapping[str, Any]) -> str:
    """A fragment for a rig file's include list, under who wrote it and what it says for people."""
    when = time.strftime("%Y-%m-%d %H:%M:%S UTC", time.gmtime())
    notes = "".join(f"# {line}\n" for line in lines)
    return f"# Written by `{by}` for rig {rig.name}, {when}.\n{notes}\n" + tomli_w.dumps(fragment)
