"""A camera frame as half blocks, two pixels a cell, with marks on top. Elevation points up, azimuth right."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray
from rich.segment import Segment

from fitctl.tui.draw.colours import LEVELS
from fitctl.tui.inks import WHITE
from fitctl.tui.look import Line, style

Floats = NDArray[np.float64]
PlaceT = TypeVar("PlaceT", float, Floats)  # one place, or many at once

STRETCHES: dict[str, Callable[[Floats, float], Floats]] = {
    "asinh": lambda above, noise: np.arcsinh(above / (4 * noise)),
    "sqrt": lambda above, _: np.sqrt(np.maximum(above, 0.0)),
    "linear": lambda above, _: above,
}


def stretch(image: NDArray[np.uint16], kind: str = "asinh") -> NDArray[np.int64]:
    """Colour levels, 0 to ``LEVELS - 1``, from just above the background to the brightest pixel.

    The median stands for bias and sky; the scatter below it, which no star touches, for the noise.
    Black is one deviation above the background: most of the field is calm, and cheap to send to a
    terminal. Without a star the top is far above the noise, so that an empty field looks empty.
    """
    values = image.astype(np.float64)
    background = float(np.median(values))
    below = background - values[values < background]
    noise = max(1.0, 1.4826 * float(np.median(below)) if below.size else 1.0)
    black = background + noise
    top = max(float(values.max()) - black, 30 * noise)
    curve = STRETCHES[kind]
    scaled = curve(values - black, noise) / curve(np.array(top), noise)
    return np.clip(np.rint(scaled * (LEVELS - 1)), 0, LEVELS - 1).astype(np.int64)


@dataclass(frozen=True)
class Placing:
    """Where a frame lies in a panel: ``zoom`` screen pixels a camera pixel (or 1, with `shrink`)."""

    zoom: int
    shrink: int
    columns: int
    rows: int
    left: int
    top: int
    height_px: int

    def column(self, az_px: PlaceT) -> PlaceT:
        """Panel column of an azimuth; a cell's left edge is a whole number."""
        return self.left + (az_px + 0.5) * self.zoom / self.shrink

    def row(self, el_px: PlaceT) -> PlaceT:
        """Panel row of an elevation; a cell's upper edge is a whole number."""
        return self.top + (self.height_px - 0.5 - el_px) * self.zoom / self.shrink / 2

    def pixel(self, column: int, row: int) -> tuple[float, float]:
        """Azimuth and elevation in px at the middle of a cell."""
        az_px = (column + 0.5 - self.left) * self.shrink / self.zoom - 0.5
        el_px = self.height_px - 0.5 - (row + 0.5 - self.top) * 2 * self.shrink / self.zoom
        return az_px, el_px


def place(width_px: int, height_px: int, columns: int, rows: int) -> Placing:
    """The largest whole zoom that fits the panel, in its middle; a frame too large is shrunk."""
    zoom = max(1, min(columns // width_px, 2 * rows // height_px))
    shrink = max(1, math.ceil(width_px / columns), math.ceil(height_px / (2 * rows)))
    if shrink > 1:
        zoom = 1
    used_columns = min(columns, width_px * zoom // shrink)
    used_rows = min(rows, math.ceil(height_px * zoom / shrink / 2))
    return Placing(
        zoom,
        shrink,
        used_columns,
        used_rows,
        (columns - used_columns) // 2,
        (rows - used_rows) // 2,
        height_px,
    )


def levels_on_screen(
    image: NDArray[np.uint16], placing: Placing, kind: str = "asinh"
) -> NDArray[np.int64]:
    """Levels of the screen's half cells, uppermost first; shape (2 rows, columns).

    A shrunken frame shows the brightest pixel of each block, so that no star can vanish.
    """
    levels = stretch(image, kind)[::-1]
    n = placing.shrink
    if n > 1:
        height, width = levels.shape[0] // n * n, levels.shape[1] // n * n
        levels = levels[:height, :width].reshape(height // n, n, width // n, n).max(axis=(1, 3))
    levels = np.repeat(np.repeat(levels, placing.zoom, axis=0), placing.zoom, axis=1)
    levels = levels[: 2 * placing.rows, : placing.columns]
    missing = 2 * placing.rows - levels.shape[0]
    return np.pad(levels, ((0, missing), (0, 0))) if missing else levels


@dataclass(frozen=True)
class Mark:
    """A character over the image, at a cell of the panel; without a colour it takes what contrasts."""

    character: str
    colour: str = ""


Marks = dict[tuple[int, int], Mark]


def box_marks(left: int, top: int, right: int, bottom: int, colour: str) -> Marks:
    """An outline of thin lines through the given cells."""
    marks: Marks = {}
    for column in range(left + 1, right):
        marks[column, top] = marks[column, bottom] = Mark("─", colour)
    for row in range(top + 1, bottom):
        marks[left, row] = marks[right, row] = Mark("│", colour)
    corners = ((left, top, "┌"), (right, top, "┐"), (left, bottom, "└"), (right, bottom, "┘"))
    marks.update({(column, row): Mark(corner, colour) for column, row, corner in corners})
    return marks


def reticle_marks(column: float, row: float, gap: tuple[int, int], colour: str) -> Marks:
    """Four short lines that point at a place and leave it free; `gap` is columns and rows to each side.

    The lines across sit at the nearest third of their row, so that a place between two rows shows as one.
    """
    x, y = math.floor(column), math.floor(row)
    across = "▔─▁"[min(2, int((row - y) * 3))]
    marks = {
        (x + sign * (gap[0] + i), y): Mark(across, colour) for sign in (-1, 1) for i in (0, 1, 2)
    }
    return marks | {
        (x, y + sign * (gap[1] + i)): Mark("│", colour) for sign in (-1, 1) for i in (0, 1)
    }


def frame_lines(
    levels: NDArray[np.int64],
    placing: Placing,
    marks: Marks,
    columns: int,
    rows: int,
    colours: Sequence[str],
) -> list[Line]:
    """Lines of the panel: the image in its place, marks on top, equal neighbours in one segment.

    `colours` are of the levels, from dark to bright.
    """
    lines: list[Line] = [[] for _ in range(rows)]
    for row in range(placing.rows):
        upper, lower = levels[2 * row].tolist(), levels[2 * row + 1].tolist()
        y = placing.top + row
        line: Line = [Segment(" " * placing.left)] if placing.left else []
        run, last = 0, (-1, -1)
        for x, pair in enumerate(zip(upper, lower, strict=True), start=placing.left):
            mark = marks.get((x, y))
            if run and (mark or pair != last):
                line.append(_pixels(run, last, colours))
                run = 0
            if mark:
                level = (pair[0] + pair[1]) // 2
                contrast = colours[0] if level > LEVELS // 2 else WHITE
                ink = style(mark.colour or contrast, colours[level], bold=True)
                line.append(Segment(mark.character, ink))
            else:
                run, last = run + 1, pair
        if run:
            line.append(_pixels(run, last, colours))
        lines[y] = line
    return lines


def _pixels(count: int, pair: tuple[int, int], colours: Sequence[str]) -> Segment:
    upper, lower = pair
    if upper == lower:
        return Segment(" " * count, style(None, colours[upper]))
    return Segment("▀" * count, style(colours[upper], colours[lower]))
