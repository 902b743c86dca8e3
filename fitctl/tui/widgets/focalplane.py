"""The focal plane: the newest frame, the centroid's window, the centroid, and the target."""

from __future__ import annotations

import math

import numpy as np

from fitctl.config import HALF_WINDOW_PX
from fitctl.logging.records import FrameRecord, Tick
from fitctl.tui.draw.frame import (
    Mark,
    Marks,
    Placing,
    box_marks,
    frame_lines,
    levels_on_screen,
    place,
    reticle_marks,
)
from fitctl.tui.look import DIM, GREEN, INK, ORANGE, SKY, WHITE, Line, number, pad, text
from fitctl.tui.widgets.panel import Panel

WINDOW_PX = 2 * HALF_WINDOW_PX + 1
"""Side of the centroid's window; a tick names its central pixel."""


class FocalPlane(Panel):
    """The frame as half blocks, elevation up."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The image in the middle; a caption below it, or over its last row when there is no room."""
        frame = self.state.newest.frame if self.state.newest else None
        tick = self.state.loop.tick if self.state.loop else None
        if frame is None:
            note = [[text("no frame yet".center(columns), DIM)]]
            return [[] for _ in range((rows - 1) // 2)] + note
        image = np.frombuffer(frame.data, dtype="<u2").reshape(frame.height_px, frame.width_px)
        placing = place(frame.width_px, frame.height_px, columns, rows)
        marks = tick_marks(tick, placing) if tick else {}
        caption = _caption(frame, tick)
        below = placing.top + placing.rows
        if below >= rows:
            marks |= _written_over(caption, placing.left, rows - 1)
        lines = frame_lines(levels_on_screen(image, placing), placing, marks, columns, rows)
        if below < rows:
            lines[below] = pad([text(" " * placing.left), *caption], columns)
        return lines


def tick_marks(tick: Tick, placing: Placing) -> Marks:
    """What a tick says about the frame: the target always; window and centroid while the star is seen."""
    target = placing.column(tick.target_az_px), placing.row(tick.target_el_px)
    half_columns = math.ceil((WINDOW_PX / 2) * placing.zoom / placing.shrink)
    half_rows = math.ceil(half_columns / 2)
    marks = reticle_marks(*target, (half_columns + 3, half_rows + 2), SKY)
    if tick.star_visible:
        low_az, low_el = tick.window_az_px - WINDOW_PX / 2, tick.window_el_px - WINDOW_PX / 2
        marks |= box_marks(
            math.floor(placing.column(low_az)) - 1,
            math.floor(placing.row(low_el + WINDOW_PX)) - 1,
            math.ceil(placing.column(low_az + WINDOW_PX)),
            math.ceil(placing.row(low_el)),
            GREEN,
        )
        centroid = placing.column(tick.star_az_px), placing.row(tick.star_el_px)
        marks[math.floor(centroid[0]), math.floor(centroid[1])] = Mark("+")
    return marks


def _caption(frame: FrameRecord, tick: Tick | None) -> Line:
    if tick is None or not tick.star_visible:
        return [text("○ no star", ORANGE, bold=True), text(f"  frame {frame.number}", DIM)]
    position = f"{number(tick.star_az_px, '5.2f')} {number(tick.star_el_px, '5.2f')} px"
    flux = f"{number(tick.star_flux_dn, ',.0f')} DN".replace(",", " ")
    return [
        text("+", WHITE, bold=True),
        text(" star ", GREEN, bold=True),
        text(position, INK),
        text(f"  {flux}", DIM),
    ]


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
