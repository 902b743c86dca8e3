"""The Loop screen's timing: how long the parts of a tick take, and how that is distributed."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from fitctl.tui.inks import DIM, FAINT, GREEN, INK, PINK, SKY, VIOLET, YELLOW
from fitctl.tui.look import Line, bar, number, spread, text, width
from fitctl.tui.widgets.panel import Panel

LONG_FROM_COLUMNS = 56
BLOCKS = " ▁▂▃▄▅▆▇█"
Floats = NDArray[np.float64]


class Histograms(Panel):
    """Compute time of ticks and age of frames, in bars whose height is logarithmic, so that rare ones show."""

    every: ClassVar[int] = 5

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Both with equal room: a heading, bars, an axis."""
        loop, newest = self.state.loop, self.state.newest
        if loop is None or newest is None:
            return []
        since_s = newest.time_s - self.state.window.rms_s
        past = loop.past.since(since_s, "compute_s", "frame_age_s")
        height = max(1, rows // 2 - 2)
        lines: list[Line] = []
        for name, values_s, colour in (
            ("compute", past[:, 0], SKY),
            ("frame age", past[:, 1], VIOLET),
        ):
            lines += histogram(name, 1e3 * values_s[np.isfinite(values_s)], colour, columns, height)
        return lines


def histogram(name: str, values_ms: Floats, colour: str, columns: int, rows: int) -> list[Line]:
    """A heading with median, 99th percentile and worst; bars; the axis from least to worst."""
    if not len(values_ms):
        return [[text(f"{name}: no ticks", DIM)], *([] for _ in range(rows + 1))]
    middle, late, worst = np.percentile(values_ms, [50, 99, 100])
    names = (
        ("median ", "  99 % ", "  worst ") if columns >= LONG_FROM_COLUMNS else ("", " / ", " / ")
    )
    figures: Line = []
    for its_name, value in zip(names, (middle, late, worst), strict=True):
        figures += [text(its_name, DIM), text(f"{value:.2f}", INK, bold=True)]
    figures.append(text(" ms", DIM))
    heading = spread([text(name, colour, bold=True)], figures, columns)
    low, high = float(values_ms.min()), float(worst)
    high = high if high > low else low + 1e-3
    counts, _ = np.histogram(values_ms, bins=columns, range=(low, high))
    part = np.log1p(counts) / np.log1p(max(1, counts.max()))
    eighths = np.ceil(part * rows * 8).astype(int)
    lines: list[Line] = [heading]
    for row in range(rows - 1, -1, -1):
        levels = np.clip(eighths - 8 * row, 0, 8).tolist()
        lines.append([text("".join(BLOCKS[level] for level in levels), colour)])
    left, right = f"{low:.2f}", f"{high:.2f} ms"
    lines.append([text(left + right.rjust(max(0, columns - len(left))), DIM)])
    return lines


class Breakdown(Panel):
    """From the middle of an exposure to the command: what takes how long."""

    every: ClassVar[int] = 5

    def draw(self, columns: int, rows: int) -> list[Line]:
        """A row a part, the share of it as a bar."""
        loop, newest = self.state.loop, self.state.newest
        if loop is None or newest is None:
            return []
        since_s = newest.time_s - self.state.window.rms_s
        past = loop.past.since(since_s, "frame_age_s", "sense_s", "decide_s", "compute_s")
        past = past[np.isfinite(past).all(axis=1)]
        if not len(past):
            return [[text("no ticks with a frame", DIM)]]
        age_s, sense_s, decide_s, compute_s = past.T
        parts = (
            ("frame", age_s, FAINT, "exposure to frame in hand"),
            ("sense", sense_s, SKY, "star found or measured"),
            ("decide", decide_s, YELLOW, "interlocks, control law"),
            ("write", compute_s - sense_s - decide_s, PINK, "D/A, in the tick"),
            ("tick", compute_s, GREEN, "the three above"),
        )
        longest_s = float(np.median(compute_s))
        lines: list[Line] = [[text(f"{'ms':<8}{'median':>8}{'99 %':>8}{'worst':>8}", DIM)]]
        for name, values_s, colour, meaning in parts:
            middle, late, worst = 1e3 * np.percentile(values_s, [50, 99, 100])
            line = [
                text(f"{name:<8}", colour if colour != FAINT else DIM, bold=True),
                text("".join(f"{number(value, '.2f'):>8}" for value in (middle, late, worst)), INK),
                text("  "),
            ]
            room = columns - 60
            if room >= 6 and name != "frame" and longest_s > 0:
                line += [*bar(1e-3 * middle / longest_s, room, colour), text("  ")]
            whole = [*line, text(meaning, DIM)]
            lines.append(whole if width(whole) <= columns else line)
        return lines[:rows]
