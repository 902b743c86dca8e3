"""The lines on top: what runs, its mode and for how long, whether data flow, and the way to other screens."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import ClassVar

from rich.segment import Segment

from fitctl.messages.modes import KIND_MODES
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import COMMISSIONING, VIEWS
from fitctl.tui.inks import DIM, FAINT, GREEN, INK, ORANGE, PAPER, RED, SKY, WHITE
from fitctl.tui.look import (
    MODES,
    Line,
    clickable,
    duration,
    shorten,
    spread,
    text,
    width,
)
from fitctl.tui.loops.band import STAR_LOST, age, has_failed, loop_rows, mode_chip, mode_look
from fitctl.tui.loops.fringes import fringe_line, has_fringes
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

BADGE_COLUMNS = 19
SHORTEST_NAME = 4  # columns of whoever has the instrument
STOP_COLUMNS = 11  # at the right end of the first line, for the key that is never covered
WIDE_FROM_COLUMNS = 100
ASIDE = {"SAFE", "EXPERIMENT"}


class Header(Panel):
    """Rig, link and clock; the loops with their modes; the screens.

    One loop has a badge of its mode and the modes as a diagram. Several loops have a band, and their fringes a
    line. On a narrow terminal the band is a row for each loop, on Operate alone. On a low one the line of the
    screens gives way to an alarm.
    """

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, view: str, alarms: AlarmBook) -> None:
        super().__init__(state)
        self._view = view
        self._alarms = alarms

    def redraw(self) -> None:
        """Use as many rows as there are lines."""
        columns = self.container_size.width
        if columns:
            low = self.screen.has_class("short")
            self.styles.height = len(self.lines(columns, low=low))
        super().redraw()

    def draw(self, columns: int, rows: int) -> list[Line]:
        """As many of the lines as there are rows."""
        lines = self.lines(columns, low=False)
        return lines if len(lines) <= rows else self.lines(columns, low=True)

    def lines(self, columns: int, *, low: bool) -> list[Line]:
        """All lines; on a low terminal without the screens while there is an alarm."""
        state = self.state
        several, narrow = len(state.loops) > 1, columns < WIDE_FROM_COLUMNS
        screens = [] if low and self._alarms.in_order else [self._screens()]
        if not several and not narrow:
            return self._beside_badge(columns, screens)
        lines = [self._status(columns, chip=narrow)]
        if several and (not narrow or self._view == "operate"):
            lines += loop_rows(state, columns)
            if has_fringes(state):
                lines.append(fringe_line(state, columns))
        return lines + screens

    def _beside_badge(self, columns: int, screens: list[Line]) -> list[Line]:
        inner = columns - (BADGE_COLUMNS + 2)
        lines = [self._status(inner, chip=False), self._diagram(), *screens]
        return [
            [*left, Segment("  "), *right]
            for left, right in zip(self._badge(), lines, strict=False)
        ]

    @property
    def _mode(self) -> str:
        return self.state.mode or "NO DATA"

    def _badge(self) -> list[Line]:
        state, loop = self.state, self.state.loop
        look = mode_look(loop)
        label, ground = f"{look.symbol} {self._mode}", look.colour
        # In VERNIER it matters which design holds the star.
        below = loop.state.controller if loop and self._mode == "VERNIER" else ""
        if loop and loop.state.search_again is not None:
            below = STAR_LOST
        elif loop and self._mode == "SAFE":
            below = "fault" if has_failed(loop) else "stopped"
        if state.stale:
            ground = DIM
            ago = f"{age(state.silent_s)} ago" if loop else ""
            whole = f"{self._mode}, {ago}" if loop else self._mode
            label, below = (whole, "") if len(whole) < BADGE_COLUMNS else (f"{self._mode},", ago)
        blank = " " * BADGE_COLUMNS
        rows = (blank, label.center(BADGE_COLUMNS), below.center(BADGE_COLUMNS))
        return [[text(row, PAPER, on=ground, bold=True)] for row in rows]

    def _status(self, columns: int, *, chip: bool) -> Line:
        """Its parts by their weight: what does not fit goes, from the last one on."""
        state, loop, newest = self.state, self.state.loop, self.state.newest
        room = columns - STOP_COLUMNS
        line = mode_chip(state, loop) if chip else []
        link = self._link()
        parts: list[Line] = []
        if loop is not None and newest is not None:
            gap = [text(" ")] if line else []
            several = len(state.loops) > 1
            if chip and loop.state.search_again is not None:
                parts.append([*gap, text(f"▲ {STAR_LOST}", ORANGE, bold=True)])
            if not state.stale and (chip or not several):
                in_mode = duration(newest.time_s - loop.state.since_s)
                parts.append([*gap, text(in_mode, WHITE, bold=True), text(" ")])
            place = f" {loop.state.name}"
            if several:
                place += f" {list(state.loops).index(state.shown) + 1}/{len(state.loops)}"
            parts.append([text(place, SKY)])
            parts.append([text(f"  {newest.rig_name}", INK, bold=True)])
        room -= width(link) + 1
        for part in parts:
            if width(line) + width(part) <= room:
                line = [*line, *part]
        free = room - width(line)
        clock = next(
            (c for c in (self._clock(dated=True), self._clock(dated=False)) if len(c) + 2 <= free),
            "",
        )
        if newest is not None and newest.commander:
            # Who has the instrument gives way to the state of the link and the time.
            free -= len(f"  {clock}  by ")
            if free < SHORTEST_NAME and len(clock) > len(self._clock(dated=False)):
                free += len(clock) - len(self._clock(dated=False))
                clock = self._clock(dated=False)
            if free >= SHORTEST_NAME:
                line = [*line, text(f"  by {shorten(newest.commander, free)}", DIM)]
        right = [*link, text(f"  {clock}", DIM)] if clock else link
        return [*spread(line, right, columns - STOP_COLUMNS), text(" " * STOP_COLUMNS)]

    def _link(self) -> Line:
        state = self.state
        if state.live and state.stale and not state.waits_for_supervisor:
            return [text("no supervisor", DIM)]
        if state.newest is None:
            return [text(" ◌ connecting ", PAPER, on=SKY, bold=True)]
        if not state.live:
            return [text(" ◀◀ PAST ", PAPER, on=WHITE, bold=True)]
        if state.stale and state.newest.shutting_down:
            return [text(" supervisor shut down ", PAPER, on=ORANGE, bold=True)]
        if state.stale:
            return [text(" ✗ link lost ", PAPER, on=RED, bold=True)]
        line = [text("●", GREEN), text(f" live {state.rate_hz:.0f} Hz", DIM)]
        if state.missed:
            line.append(text(f" ▲ {state.missed} missed", ORANGE, bold=True))
        return line

    def _clock(self, *, dated: bool) -> str:
        wall_s = self.state.wall_s(self.state.now_s)
        if math.isnan(wall_s):
            return "--:--:-- UTC"
        form = "%Y-%m-%d %H:%M:%S UTC" if dated else "%H:%M:%S UTC"
        return datetime.fromtimestamp(wall_s, UTC).strftime(form)

    def _diagram(self) -> Line:
        line: Line = []
        loop = self.state.loop
        modes = KIND_MODES["stellar" if loop is None else loop.state.kind]
        for mode in MODES:
            if mode not in modes or (mode == "EXPERIMENT" and mode != self._mode):
                continue  # an experiment is rare, and the line is full
            if line:
                line.append(text("   " if mode in ASIDE else " ── ", FAINT))
            if mode == self._mode:
                sign, colour = mode_look(loop)
                line.append(
                    text(f"▐{sign} {mode}▌", DIM if self.state.stale else colour, bold=True)
                )
            else:
                line.append(text(mode, DIM))
        return line

    def _screens(self) -> Line:
        line: Line = []
        commissions = not self.state.waits_for_supervisor or self._view == COMMISSIONING.name
        for key, name, label, _ in (*VIEWS, *([COMMISSIONING] if commissions else [])):
            if name == self._view:
                piece = [text(f" {key} {label} ", PAPER, on=INK, bold=True)]
            else:
                piece = [text(f" {key}", SKY, bold=True), text(f" {label} ", DIM)]
            line += clickable(piece, f"app.view('{name}')")
        return line
