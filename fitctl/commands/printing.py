"""What commands print: results for programs, progress for people."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import msgspec

if TYPE_CHECKING:
    from rich.progress import Progress


def to_json(result: Any) -> str:
    """One line; what was not reached is null."""
    return msgspec.json.encode(result).decode()


def progress_line() -> Progress:
    """A progress line on standard error, so that results alone are on standard output."""
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    return Progress(
        TextColumn("{task.description}"),
        BarColumn(),
        TimeElapsedColumn(),
        console=Console(stderr=True),
        transient=False,
    )
