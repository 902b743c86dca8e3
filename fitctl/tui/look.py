"""How the console looks: colours, symbols, and segments made of them.

The colours are those of Okabe and Ito, which people of every colour vision tell apart; beside each
colour stands a symbol or a word that says the same.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache
from typing import NamedTuple

from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip

from fitctl.text import plain

INK = "#d7dde5"
DIM = "#7d8896"
FAINT = "#39424e"
PAPER = "#0b0e13"
SKY = "#56b4e9"
ORANGE = "#e69f00"
GREEN = "#2fbf8f"
YELLOW = "#f0e442"
RED = "#ff6b4a"
PINK = "#cc79a7"
WHITE = "#ffffff"


class Look(NamedTuple):
    """A sign and its colour."""

    symbol: str
    colour: str


MODES = {
    "OFF": Look("○", "#9aa4b0"),
    "STANDBY": Look("◐", SKY),
    "ACQUISITION": Look("◎", YELLOW),
    "COARSE": Look("◇", ORANGE),
    "VERNIER": Look("◆", GREEN),
    "LOCKED": Look("◉", GREEN),
    "SAFE": Look("■", RED),
    "EXPERIMENT": Look("◈", PINK),
}
UNKNOWN_MODE = Look("?", PINK)

DEVICES = {
    "ok": Look("✓", GREEN),
    "fault": Look("✗", RED),
    "closed": Look("○", DIM),
}
SEVERITIES = {
    "info": Look("·", INK),
    "warning": Look("▲", ORANGE),
    "error": Look("✗", RED),
}

Line = list[Segment]


@lru_cache(maxsize=4096)
def style(
    colour: str | None = None,
    on: str | None = None,
    *,
    bold: bool = False,
    underline: bool = False,
) -> Style:
    """Return a style, made once."""
    return Style(color=colour, bgcolor=on, bold=bold or None, underline=underline or None)


def text(content: str, colour: str = INK, *, on: str | None = None, bold: bool = False) -> Segment:
    """One piece of a line."""
    return Segment(plain(content), style(colour, on, bold=bold))


@lru_cache(maxsize=256)
def _doing(action: str) -> Style:
    return Style.from_meta({"@click": action})


def clickable(line: Iterable[Segment], action: str) -> Line:
    """The same, but a click on it does a Textual action, such as ``app.command('Stop')``; empty: none."""
    if not action:
        return list(line)
    return [Segment(part.text, (part.style or Style()) + _doing(action)) for part in line]


def cap(key: str, label: str, action: str, *, on: str = SKY) -> Line:
    """A key and what it does, for keyboard and mouse."""
    return clickable([text(key, PAPER, on=on, bold=True), text(f" {label} ", INK)], action)


def wall(seconds: float) -> str:
    """Unix time as UTC ``hh:mm:ss``; not-a-number is dashes."""
    if not math.isfinite(seconds):
        return "--:--:--"
    return datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S")


def in_columns(left: list[Line], columns: int, right: list[Line]) -> list[Line]:
    """Two blocks beside each other, the left one `columns` wide."""
    rows = max(len(left), len(right))
    empty: list[Line] = [[]]
    return [
        [*pad(a, columns), *b]
        for a, b in zip(
            left + empty * (rows - len(left)), right + empty * (rows - len(right)), strict=True
        )
    ]


def width(line: Iterable[Segment]) -> int:
    """Columns that a line takes."""
    return sum(segment.cell_length for segment in line)


def spread(left: Line, right: Line, columns: int) -> Line:
    """Put two parts at the two ends of a line; the right one goes when there is no room for both."""
    gap = columns - width(left) - width(right)
    return [*left, Segment(" " * gap), *right] if gap >= 1 else left


def pad(line: Line, columns: int) -> Line:
    """Cut or fill a line to a number of columns."""
    return list(Strip(line).adjust_cell_length(columns))


def mark(*, good: bool) -> Segment:
    """A tick or a cross, by sign and by colour."""
    return text("✓" if good else "✗", GREEN if good else RED, bold=True)


def shorten(content: str, columns: int) -> str:
    """Cut a text to a number of columns, with an ellipsis where something is missing."""
    return content if len(content) <= columns else content[: max(0, columns - 1)] + "…"


def bar(fraction: float, columns: int, colour: str, back: str = FAINT) -> Line:
    """A horizontal bar in eighths of a column; not-a-number is empty."""
    eighths = 0 if math.isnan(fraction) else round(min(max(fraction, 0.0), 1.0) * columns * 8)
    full, rest = divmod(eighths, 8)
    content = "█" * full + (" ▏▎▍▌▋▊▉"[rest] if rest else "")
    return [text(content.ljust(columns), colour, on=back)]


def number(value: float, form: str) -> str:
    """Format a value; one that does not exist is a dash of the same width."""
    if math.isfinite(value):
        return format(value, form).replace("-", "−")
    return "–".rjust(len(format(0.0, form)))


def duration(seconds: float) -> str:
    """Seconds as ``m:ss`` or ``h:mm:ss``."""
    whole = max(0, int(seconds))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"
