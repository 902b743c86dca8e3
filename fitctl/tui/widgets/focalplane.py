"""The focal plane: the newest frame, windows, centroids, targets, and a cursor to put things with."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray
from textual.events import Click
from textual.message import Message
from textual.strip import Strip

from fitctl.config import WINDOW_PX
from fitctl.logging.records import FrameRecord, MetrologyTick, Tick
from fitctl.tui.draw.colours import ANCHORS, LEVELS, colour_map
from fitctl.tui.draw.frame import (
    STRETCHES,
    Marks,
    Placing,
    frame_lines,
    levels_on_screen,
    place,
)
from fitctl.tui.draw.overlays import (
    OTHER_SPOT,
    OVERLAY_INKS,
    Overlay,
    cell_marks,
    name_marks,
    paint,
    tick_overlays,
)
from fitctl.tui.graphics import PictureSender, cell_size_px
from fitctl.tui.inks import DIM, FAINT, GREEN, INK, PINK, WHITE, YELLOW
from fitctl.tui.look import Line, faded, number, pad, text, width
from fitctl.tui.loops.band import age
from fitctl.tui.state import ConsoleState, LoopView
from fitctl.tui.widgets.panel import Panel

PICTURE_BEATS = 3
OLD_FROM_S = 1.0  # a frame that is older is no picture of what is
TERMINAL = 2  # the file descriptor that Textual writes to


class FocalPlane(Panel):
    """The frame as half blocks, or as a picture where the terminal draws them, elevation up.

    Parameters
    ----------
    state : ConsoleState
    title : str
    pictures : PictureSender, optional

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

    def __init__(
        self, state: ConsoleState, title: str = "", pictures: PictureSender | None = None
    ) -> None:
        super().__init__(state, title)
        self._pictures = pictures
        self._beats = 0
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
        old_s = self.state.newest.time_s - frame.time_s if self.state.newest else 0.0
        image = np.frombuffer(frame.data, dtype="<u2").reshape(frame.height_px, frame.width_px)
        # Rather than half the size, a frame loses its lowest row below the caption.
        whole = rows + (2 * rows < frame.height_px <= 2 * (rows + 1))
        placing = self._placing = place(frame.width_px, frame.height_px, columns, whole)
        below = placing.top + placing.rows
        left = 0 if below < rows else placing.left
        caption = self._caption(frame, tick, columns - left)
        if old_s > OLD_FROM_S:
            caption = [text(f"○ last frame {age(old_s)} ago", INK, bold=True)]
        pictures, cell_px = self._pictures, self._picture_cell_px()
        if pictures is not None and cell_px is not None:
            self._beats += 1
            if self._beats % PICTURE_BEATS == 0:
                seen_rows = min(placing.rows, rows - 1 - placing.top)
                self._send(pictures, cell_px, image, placing, seen_rows)
            lines: list[Line] = [[] for _ in range(rows)]
            lines[min(below, rows - 1)] = [text(" " * left), *caption]
            return lines
        if pictures is not None:
            pictures.clear()
        levels = levels_on_screen(image, placing, self.stretch)
        marks = cell_marks(self._overlays(), placing) | self._names(placing)
        colours = colour_map(self.colours)
        lines = frame_lines(levels, placing, marks, columns, whole, colours)[:rows]
        row = min(below, rows - 1)
        under = Strip(lines[row]).crop(left + width(caption)) if below >= rows else Strip([])
        if old_s > OLD_FROM_S:
            lines = list(map(faded, lines))
        lines[row] = pad([text(" " * left), *caption, *under], columns)
        return lines

    def _picture_cell_px(self) -> tuple[int, int] | None:
        """Width and height of a cell; None while there can be no picture.

        That is while something lies over the panel, or what it shows is old, which would have to be faded.
        """
        newest = self.state.newest
        if (
            newest is None
            or newest.frame is None
            or newest.time_s - newest.frame.time_s > OLD_FROM_S
        ):
            return None
        if self._pictures is None or self.state.stale or not self.screen.is_active:
            return None
        return None if self.screen.query("Toast") else cell_size_px(TERMINAL)

    def _send(
        self,
        pictures: PictureSender,
        cell_px: tuple[int, int],
        image: NDArray[np.uint16],
        placing: Placing,
        rows: int,
    ) -> None:
        """Send the frame with its overlays, as much of it as so many rows of cells show."""
        levels = levels_on_screen(image, placing, self.stretch)
        shades = min(LEVELS, pictures.most_inks - len(OVERLAY_INKS))
        colours = colour_map(self.colours)
        steps = np.linspace(0, LEVELS - 1, shades).round().astype(int)
        inks = [*(colours[step] for step in steps), *OVERLAY_INKS]
        width_px, height_px = placing.columns * cell_px[0], placing.rows * cell_px[1]
        down = np.arange(height_px) * levels.shape[0] // height_px
        across = np.arange(width_px) * levels.shape[1] // width_px
        picture = (levels * shades // LEVELS).astype(np.uint8)[np.ix_(down, across)]
        paint(self._overlays(), picture, placing, inks)
        region = self.content_region
        at = (region.x + placing.left, region.y + placing.top)
        cells = (placing.columns, rows)

        def send() -> None:
            if self._picture_cell_px() is not None:
                pictures.show(picture[: rows * cell_px[1]], inks, at, cells)

        self.call_after_refresh(send)  # after what Textual has to send, which would wipe it out

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

    def _overlays(self) -> list[Overlay]:
        """The shown loop's on top of those of others, whose stars the same camera sees."""
        shown = self.state.loop
        others = [loop for loop in self.state.loops.values() if loop is not shown]
        own = [] if shown is None else spot_overlays(shown)
        named = {spot.label for spot in own}  # of several loops' spots with one name, one has it
        spots = [spot for loop in others for spot in spot_overlays(loop, DIM)]
        spots = [spot._replace(label="") if spot.label in named else spot for spot in spots]
        ticks = [loop.tick for loop in others if loop.tick is not None]
        found = [each for tick in ticks for each in tick_overlays(tick, FAINT, DIM)]
        if shown is not None and shown.tick is not None:
            found += tick_overlays(shown.tick)
        found += [*spots, *own]  # on top of the windows, which would hide their names
        if self.cursor_px is not None:
            found.append(Overlay("cursor", *self.cursor_px, YELLOW))
        return found

    def _names(self, placing: Placing) -> Marks:
        """The name of its loop at the upper left corner of each window, where there are several loops.

        A name that would lie on another is left out; the shown loop's comes first.
        """
        if len(self.state.loops) < 2:
            return {}
        marks: Marks = {}
        for name in sorted(self.state.loops, key=lambda name: name != self.state.shown):
            tick = self.state.loops[name].tick
            if tick is None or not tick.star_visible:
                continue
            row = math.floor(placing.row(tick.window_el_px + WINDOW_PX / 2)) - 1
            column = math.floor(placing.column(tick.window_az_px - WINDOW_PX / 2))
            colour = GREEN if name == self.state.shown else INK
            of_name = name_marks(name, column, row, colour, placing)
            if not marks.keys() & of_name.keys():
                marks |= of_name
        return marks

    def _caption(self, frame: FrameRecord, tick: Tick | None, columns: int) -> Line:
        if self.cursor_px is not None:
            az_px, el_px = self.cursor_px
            return [text(f"╳ {az_px:.1f} {el_px:.1f} px: target, or look here?", YELLOW, bold=True)]
        beam = self.state.loop.beam if self.state.loop else None
        if beam is not None:
            return _beam_caption(beam, columns)
        if tick is None or not tick.star_visible:
            return [text("○ no star", INK, bold=True), text(f"  frame {frame.number}", DIM)]
        position = f"{number(tick.star_az_px, '5.2f')} {number(tick.star_el_px, '5.2f')} px"
        flux = f"{number(tick.star_flux_dn, ',.0f')} DN".replace(",", " ")
        star = [text("+", WHITE, bold=True), text(" star ", GREEN, bold=True), text(position, INK)]
        spots = self.state.loop.state.other_spots if self.state.loop else []
        names = dict.fromkeys(spot.name for spot in spots)
        legend = [text(f" {OTHER_SPOT} {name}", PINK) for name in names]
        whole = [*star, text(f" {flux}", DIM), *legend]
        return whole if width(whole) <= columns else [*star, *legend]


def spot_overlays(loop: LoopView, colour: str = PINK) -> list[Overlay]:
    """Where a loop's other spots are, from the star that its last tick measured; none without a star."""
    tick = loop.tick
    if tick is None or not tick.star_visible:
        return []
    return [
        Overlay(
            "spot",
            tick.star_az_px + spot.az_offset_px,
            tick.star_el_px + spot.el_offset_px,
            colour,
            spot.name,
        )
        for spot in loop.state.other_spots
    ]


def _next(names: list[str], name: str) -> str:
    return names[(names.index(name) + 1) % len(names)]


def _beam_caption(beam: MetrologyTick, columns: int) -> Line:
    """Where a metrology loop's beam is on its photodiodes, which no camera sees."""
    state = beam.beam_state.lower()
    if not math.isfinite(beam.beam_az_arcsec):
        return [text(f"○ beam {state}", INK, bold=True)]
    place = f"{number(beam.beam_az_arcsec, '+.2f')} {number(beam.beam_el_arcsec, '+.2f')}″"
    line = [text("◉ beam ", GREEN, bold=True), text(place, INK)]
    in_full = [*line, text(f" {state}", DIM)]
    return in_full if width(in_full) <= columns else line
