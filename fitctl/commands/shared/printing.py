"""What commands print: results for programs, progress for people."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Protocol

import typer

from fitctl.text import json_bytes, plain

if TYPE_CHECKING:
    from fitctl.messages.telemetry import Telemetry


class ShowProgress(Protocol):
    """Show how much is done, and what is being done where that changes."""

    def __call__(self, done: float, text: str | None = None) -> None:
        """Show it."""


def say(line: str, *, err: bool = False) -> None:
    """Print one line, whatever is in it: a field with line breaks or escapes cannot forge another line."""
    typer.echo(plain(line), err=err)


def say_lines(text: str, *, err: bool = False) -> None:
    """Print lines of fitctl's own; text from elsewhere in them has gone through :func:`fitctl.text.plain`."""
    for line in text.split("\n"):
        say(line, err=err)


def to_json(result: Any) -> str:
    """One line; what was not reached is null."""
    return json_bytes(result).decode()


@contextmanager
def progress_line(text: str, total: float = 1.0) -> Iterator[ShowProgress]:
    """A progress line on standard error, so that results alone are on standard output."""
    # Not at the top: most commands print and show no progress, and rich takes as long as numpy.
    from rich.console import Console
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (TextColumn("{task.description}", markup=False), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=Console(stderr=True)) as progress:
        task = progress.add_task(plain(text), total=total)
        yield lambda done, text=None: progress.update(
            task, completed=done, description=None if text is None else plain(text)
        )


def utc(telemetry: Telemetry, time_s: float) -> str:
    """A time of the supervisor's clock as ISO 8601; empty for one that a clock cannot have."""
    stamp = datetime_of(time_s + telemetry.wall_minus_monotonic_s)
    return "" if stamp is None else stamp.isoformat(timespec="milliseconds")


def datetime_of(wall_s: float) -> datetime | None:
    """A time; None for one that no clock can have: a remote program may send any number."""
    try:
        return datetime.fromtimestamp(wall_s, UTC)
    except (ValueError, OverflowError, OSError):
        return None
