"""What is marked on the focal plane, in camera pixels: as characters, and as lines of pixels."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import WINDOW_PX
from fitctl.logging.records import Tick
from fitctl.text import plain
from fitctl.tui.draw.frame import Mark, Marks, Placing, box_marks, reticle_marks
from fitctl.tui.inks import DIM, FAINT, GREEN, PINK, SKY, WHITE, YELLOW

Polyline = NDArray[np.float64]

OTHER_SPOT = "◦"
_LIGHT_PX = 4.0  # from a spot's middle to where its light ends
OVERLAY_INKS = (WHITE, SKY, GREEN, PINK, YELLOW, DIM, FAINT)
"""Every colour that an overlay may have."""
_CIRCLE = np.linspace(0, 2 * math.pi, 33)


class Overlay(NamedTuple):
    """One thing that is marked: a name of `SHAPES`, its place, its colour, and a name beside it if it has one.

    The name is in characters alone: a picture of pixels has the caption.
    """

    shape: str
    az_px: float
    el_px: float
    colour: str
    label: str = ""


def tick_overlays(tick: Tick, target: str = SKY, window: str = GREEN) -> list[Overlay]:
    """What a tick says about the frame: the target always; window and centroid while the star is seen.

    `target` and `window` are their colours.
    """
    found = [Overlay("target", tick.target_az_px, tick.target_el_px, target)]
    if tick.star_visible:
        found += [
            Overlay("window", tick.window_az_px, tick.window_el_px, window),
            Overlay("centroid", tick.star_az_px, tick.star_el_px, ""),
        ]
    return found


def _target_marks(overlay: Overlay, placing: Placing) -> Marks:
    half_columns = math.ceil((WINDOW_PX / 2) * placing.zoom / placing.shrink)
    gap = (half_columns + 3, math.ceil(half_columns / 2) + 2)
    return reticle_marks(*_cell(overlay, placing), gap, overlay.colour)


def _window_marks(overlay: Overlay, placing: Placing) -> Marks:
    low_az, low_el = overlay.az_px - WINDOW_PX / 2, overlay.el_px - WINDOW_PX / 2
    left, top = (
        math.floor(placing.column(low_az)) - 1,
        math.floor(placing.row(low_el + WINDOW_PX)) - 1,
    )
    right = math.ceil(placing.column(low_az + WINDOW_PX))
    return box_marks(left, top, right, math.ceil(placing.row(low_el)), overlay.colour)


def _centroid_marks(overlay: Overlay, placing: Placing) -> Marks:
    """Four arms of braille dots that point at the centroid: a cell is two dots wide and four dots high."""
    column, row = _cell(overlay, placing)
    x, y = math.floor(column), math.floor(row)
    across = Mark("⠉⠒⠤⣀"[int(4 * (row - y))], overlay.colour)
    down = Mark("⡇⢸"[int(2 * (column - x))], overlay.colour)
    arms = {(x + sign * place, y): across for sign in (-1, 1) for place in (1, 2)}
    return arms | {(x, y + sign): down for sign in (-1, 1)}


def _spot_marks(overlay: Overlay, placing: Placing) -> Marks:
    """A ring, and its name below the spot's light; above it at the lower edge."""
    column, row = (math.floor(place) for place in _cell(overlay, placing))
    light_rows = max(2, math.ceil(_LIGHT_PX * placing.zoom / placing.shrink / 2))
    below = row + light_rows < placing.top + placing.rows
    named = row + (light_rows if below else -light_rows)
    begin = column - len(overlay.label) // 2
    name = name_marks(overlay.label, begin, named, overlay.colour, placing)
    return name | {(column, row): Mark(OTHER_SPOT, overlay.colour)}


def name_marks(name: str, column: int, row: int, colour: str, placing: Placing) -> Marks:
    """A name from a column on, or from as far to the left of it as keeps the name whole on the frame."""
    signs = plain(name)
    begin = max(placing.left, min(column, placing.left + placing.columns - len(signs)))
    return {(begin + place, row): Mark(sign, colour) for place, sign in enumerate(signs)}


def _cursor_marks(overlay: Overlay, placing: Placing) -> Marks:
    marks = reticle_marks(*_cell(overlay, placing), (1, 1), overlay.colour)
    column, row = _cell(overlay, placing)
    return marks | {(math.floor(column), math.floor(row)): Mark("╳", overlay.colour)}


def _cell(overlay: Overlay, placing: Placing) -> tuple[float, float]:
    return placing.column(overlay.az_px), placing.row(overlay.el_px)


def _rays(
    inner_px: float, outer_px: float, directions: Sequence[tuple[int, int]]
) -> list[Polyline]:
    return [np.outer([inner_px, outer_px], direction) for direction in directions]


_STRAIGHT = ((1, 0), (-1, 0), (0, 1), (0, -1))
_SLANTING = ((1, 1), (-1, 1), (1, -1), (-1, -1))
_BOX = np.array([[-1, -1], [1, -1], [1, 1], [-1, 1], [-1, -1]]) * WINDOW_PX / 2


class Shape(NamedTuple):
    """How something looks: as characters, and as lines about its place in camera pixels, shape (n, 2)."""

    marks: Callable[[Overlay, Placing], Marks]
    lines: list[Polyline]


SHAPES = {
    "target": Shape(_target_marks, _rays(WINDOW_PX / 2 + 1, WINDOW_PX / 2 + 3, _STRAIGHT)),
    "window": Shape(_window_marks, [_BOX]),
    "centroid": Shape(_centroid_marks, _rays(-0.8, 0.8, _STRAIGHT[::2])),
    "spot": Shape(_spot_marks, [2.5 * np.column_stack([np.cos(_CIRCLE), np.sin(_CIRCLE)])]),
    "cursor": Shape(_cursor_marks, _rays(0.0, 1.5, _SLANTING) + _rays(1.5, 3.5, _STRAIGHT)),
}


def cell_marks(overlays: Sequence[Overlay], placing: Placing) -> Marks:
    """All of them as characters; the last lies on top."""
    marks: Marks = {}
    for overlay in overlays:
        marks |= SHAPES[overlay.shape].marks(overlay, placing)
    return marks


def paint(
    overlays: Sequence[Overlay], picture: NDArray[np.uint8], placing: Placing, inks: Sequence[str]
) -> None:
    """All of them as lines of pixels, in place.

    Parameters
    ----------
    picture : array of uint8, shape (height, width)
        Numbers of inks; it covers the cells that `placing` uses.
    inks : sequence of str
        With `OVERLAY_INKS` among them.
    """
    height, width = picture.shape
    across, down = width / placing.columns, height / placing.rows
    for overlay in overlays:
        ink = inks.index(overlay.colour or WHITE)  # over light and dark, white is seen best
        for line in SHAPES[overlay.shape].lines:
            x = (placing.column(overlay.az_px + line[:, 0]) - placing.left) * across
            y = (placing.row(overlay.el_px + line[:, 1]) - placing.top) * down
            _stroke(picture, x, y, ink)


def _stroke(picture: NDArray[np.uint8], x: Polyline, y: Polyline, ink: int) -> None:
    """A line two pixels thick through points, shape (n,) each; what lies outside is left out."""
    height, width = picture.shape
    for x0, y0, x1, y1 in zip(x[:-1], y[:-1], x[1:], y[1:], strict=True):
        steps = int(max(abs(x1 - x0), abs(y1 - y0))) + 2
        column = np.rint(np.linspace(x0, x1, steps)).astype(int)
        row = np.rint(np.linspace(y0, y1, steps)).astype(int)
        for right, low in ((0, 0), (1, 0), (0, 1)):
            c, r = column + right, row + low
            inside = (c >= 0) & (c < width) & (r >= 0) & (r < height)
            picture[r[inside], c[inside]] = ink
