"""The focal plane: the newest frame, windows, centroids, targets, and a cursor to put things with."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from textual.events import Click
from textual.message import Message

from fitctl.config import HALF_WINDOW_PX
from fitctl.logging.records import FrameRecord, Tick
from fitctl.tui.draw.colours import ANCHORS, colour_map
from fitctl.tui.draw.frame import (
    STRETCHES,
    Mark,
    Marks,
    Placing,
    box_marks,
    frame_lines,
    levels_on_screen,
    place,
    reticle_marks,
)
from fitctl.tui.look import (
    DIM,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PINK,
    SKY,
    WHITE,
    YELLOW,
    Line,
    number,
    pad,
    text,
    width,
)
from fitctl.tui.state import ConsoleState, LoopView
from fitctl.tui.widgets.panel import Panel

WINDOW_PX = 2 * HALF_WINDOW_PX + 1
"""Side of the centroid's window; a tick names its central pixel."""
OTHER_SPOT = "◦"


class FocalPlane(Panel):
    """The frame as half blocks, elevation up.

    Attributes
    ----------
    colours, stretch : str
        Of `ANCHORS` and `STRETCHES`.
    cursor_px : tuple of float or None
        Where a target or the window would be put, az and el.
    """

    every: ClassVar[int] = 1

    class Picked(Message):
        """A place was clicked, az and el in px."""

        def __init__(self, az_px: float, el_px: float) -> None:
            super().__init__()
            self.az_px = az_px
            self.el_px = el_px

    def __init__(self, state: ConsoleState, title: str = "") -> None:
        super().__init__(state, title)
        self.colours = next(iter(ANCHORS))
        self.stretch = next(iter(STRETCHES))
        self.cursor_px: tuple[float, float] | None = None
        self._placing: Placing | None = None

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The image in the middle; a caption below it, or over its last row when there is no room."""
        frame = self.state.newest.frame if self.state.newest else None
        tick = self.state.loop.tick if self.state.loop else None
        if frame is None:
            self._placing = None
            note = [[text("no frame yet".center(columns), DIM)]]
            return [[] for _ in range((rows - 1) // 2)] + note
        image = np.frombuffer(frame.data, dtype="<u2").reshape(frame.height_px, frame.width_px)
        placing = self._placing = place(frame.width_px, frame.height_px, columns, rows)
        marks = self._marks(tick, placing)
        caption = self._caption(frame, tick, columns - placing.left)
        below = placing.top + placing.rows
        if below >= rows:
            marks |= _written_over(caption, placing.left, rows - 1)
        levels = levels_on_screen(image, placing, self.stretch)
        lines = frame_lines(levels, placing, marks, columns, rows, colour_map(self.colours))
        if below < rows:
            lines[below] = pad([text(" " * placing.left), *caption], columns)
        return lines

    def on_click(self, event: Click) -> None:
        """Say which pixel it was."""
        placing = self._placing
        if placing is None:
            return
        az_px, el_px = placing.pixel(event.x - self.gutter.left, event.y - self.gutter.top)
        self.post_message(self.Picked(az_px, el_px))

    def next_colours(self) -> None:
        """Take the next colour map."""
        self.colours = _next(list(ANCHORS), self.colours)

    def next_stretch(self) -> None:
        """Take the next stretch."""
        self.stretch = _next(list(STRETCHES), self.stretch)

    def _marks(self, tick: Tick | None, placing: Placing) -> Marks:
        marks: Marks = {}
        for name, loop in self.state.loops.items():  # one camera sees the stars of all loops
            if name != self.state.shown and loop.tick is not None:
                marks |= spot_marks(loop, placing, DIM)
                marks |= tick_marks(loop.tick, placing, target=FAINT, window=DIM)
        if self.state.loop is not None and tick is not None:
            marks |= spot_marks(self.state.loop, placing)
            marks |= tick_marks(tick, placing)
        if self.cursor_px is not None:
            column, row = placing.column(self.cursor_px[0]), placing.row(self.cursor_px[1])
            marks |= reticle_marks(column, row, (1, 1), YELLOW)
            marks[math.floor(column), math.floor(row)] = Mark("╳", YELLOW)
        return marks

    def _caption(self, frame: FrameRecord, tick: Tick | None, columns: int) -> Line:
        if self.cursor_px is not None:
            az_px, el_px = self.cursor_px
            return [text(f"╳ {az_px:.1f} {el_px:.1f} px: target, or look here?", YELLOW, bold=True)]
        if tick is None or not tick.star_visible:
            return [text("○ no star", ORANGE, bold=True), text(f"  frame {frame.number}", DIM)]
        position = f"{number(tick.star_az_px, '5.2f')} {number(tick.star_el_px, '5.2f')} px"
        flux = f"{number(tick.star_flux_dn, ',.0f')} DN".replace(",", " ")
        star = [text("+", WHITE, bold=True), text(" star ", GREEN, bold=True), text(position, INK)]
        spots = self.state.loop.state.other_spots if self.state.loop else []
        names = dict.fromkeys(spot.name for spot in spots)
        legend = [text(f" {OTHER_SPOT} {name}", PINK) for name in names]
        whole = [*star, text(f" {flux}", DIM), *legend]
        return whole if width(whole) <= columns else [*star, *legend]


def tick_marks(tick: Tick, placing: Placing, target: str = SKY, window: str = GREEN) -> Marks:
    """What a tick says about the frame: the target always; window and centroid while the star is seen.

    `target` and `window` are their colours.
    """
    at = placing.column(tick.target_az_px), placing.row(tick.target_el_px)
    half_columns = math.ceil((WINDOW_PX / 2) * placing.zoom / placing.shrink)
    half_rows = math.ceil(half_columns / 2)
    marks = reticle_marks(*at, (half_columns + 3, half_rows + 2), target)
    if tick.star_visible:
        low_az, low_el = tick.window_az_px - WINDOW_PX / 2, tick.window_el_px - WINDOW_PX / 2
        marks |= box_marks(
            math.floor(placing.column(low_az)) - 1,
            math.floor(placing.row(low_el + WINDOW_PX)) - 1,
            math.ceil(placing.column(low_az + WINDOW_PX)),
            math.ceil(placing.row(low_el)),
            window,
        )
        centroid = placing.column(tick.star_az_px), placing.row(tick.star_el_px)
        marks[math.floor(centroid[0]), math.floor(centroid[1])] = Mark("+")
    return marks


def spot_marks(loop: LoopView, placing: Placing, colour: str = PINK) -> Marks:
    """Where a loop's other spots are, from the star that its last tick measured; none without a star."""
    tick = loop.tick
    if tick is None or not tick.star_visible:
        return {}
    marks: Marks = {}
    for spot in loop.state.other_spots:
        column = placing.column(tick.star_az_px + spot.az_offset_px)
        row = placing.row(tick.star_el_px + spot.el_offset_px)
        marks[math.floor(column), math.floor(row)] = Mark(OTHER_SPOT, colour)
    return marks


def _next(names: list[str], name: str) -> str:
    return names[(names.index(name) + 1) % len(names)]


def _written_over(line: Line, left: int, row: int) -> Marks:
    colour = {
        segment: (segment.style.color.name if segment.style and segment.style.color else INK)
        for segment in line
    }
    marks: Marks = {}
    column = left
    for segment in line:
        for character in segment.text:
            marks[column, row] = Mark(character, colour[segment])
            column += 1
    return marks
