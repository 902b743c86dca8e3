"""How the console looks: symbols, and segments of text in the colours of :mod:`fitctl.tui.inks`."""

from __future__ import annotations

import math
from collections.abc import Iterable
from datetime import UTC, datetime
from functools import lru_cache
from typing import NamedTuple

from rich.color import Color
from rich.segment import Segment
from rich.style import Style
from textual.strip import Strip

from fitctl.text import plain
from fitctl.tui.inks import (
    DIM,
    FAINT,
    GREEN,
    INK,
    MODE_COLOURS,
    ORANGE,
    PAPER,
    PINK,
    RED,
    SKY,
)


class Look(NamedTuple):
    """A sign and its colour."""

    symbol: str
    colour: str


_MODE_SYMBOLS = {
    "OFF": "○",
    "STANDBY": "◐",
    "ACQUISITION": "◎",
    "COARSE": "◇",
    "VERNIER": "◆",
    "LOCKED": "◉",
    "SAFE": "■",
    "EXPERIMENT": "◈",
}
MODES = {name: Look(symbol, MODE_COLOURS[name].dark) for name, symbol in _MODE_SYMBOLS.items()}
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


def as_markup(content: str) -> str:
    """A text where Textual takes markup: titles, and what its palette lists.

    Textual's own `escape` and Rich's leave brackets that Textual then reads, such as ``[/`` and ``[$x]``.
    """
    return plain(content).replace("[", r"\[")


@lru_cache(maxsize=256)
def _doing(action: str) -> Style:
    return Style.from_meta({"@click": action})


def clickable(line: Iterable[Segment], action: str) -> Line:
    """The same, but a click on it does a Textual action, such as ``app.command('Stop')``; empty: none."""
    if not action:
        return list(line)
    return [Segment(part.text, (part.style or Style()) + _doing(action)) for part in line]


def cap(key: str, label: str, action: str) -> Line:
    """A key and what it does, for keyboard and mouse."""
    return clickable([text(key, PAPER, on=SKY, bold=True), text(f" {label} ", INK)], action)


@lru_cache(maxsize=4096)
def _faded(original: Style, *, words: bool) -> Style:
    """The style in greys: words as dim as can still be read, pictures by half."""
    if words:
        return Style(
            color=DIM, bgcolor=PAPER if original.bgcolor else None, meta=original.meta or None
        )
    return Style(color=_grey(original.color), bgcolor=_grey(original.bgcolor))


def _grey(colour: Color | None) -> Color | None:
    if colour is None:
        return None
    red, green, blue = colour.get_truecolor()
    level = round(0.5 * (0.2126 * red + 0.7152 * green + 0.0722 * blue))
    return Color.from_rgb(level, level, level)


def faded(line: Iterable[Segment]) -> Line:
    """The same in greys, for what is old."""
    return [
        Segment(part.text, _faded(part.style or Style(), words=has_words(part.text)))
        for part in line
    ]


def has_words(content: str) -> bool:
    """Whether there is anything to read: letters, digits or signs, and not only lines, blocks or dots."""
    return any(
        not (c == " " or "\u2500" <= c <= "\u259f" or "\u2800" <= c <= "\u28ff") for c in content
    )


def wall(seconds: float) -> str:
    """Unix time as UTC ``hh:mm:ss``; not-a-number is dashes."""
    if not math.isfinite(seconds):
        return "--:--:--"
    try:
        return datetime.fromtimestamp(seconds, UTC).strftime("%H:%M:%S")
    except (ValueError, OverflowError, OSError):  # a log's times may be anything
        return "--:--:--"


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
    if not math.isfinite(seconds):
        return "-:--"
    whole = max(0, int(seconds))
    hours, minutes = divmod(whole // 60, 60)
    return f"{hours}:{minutes:02}:{whole % 60:02}" if hours else f"{minutes}:{whole % 60:02}"
