"""The lines on top: what runs, its mode and for how long, whether data flow, and the way to other screens."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from typing import ClassVar

from rich.segment import Segment

from fitctl.messages.modes import KIND_MODES
from fitctl.tui.commands import VIEWS
from fitctl.tui.look import (
    DIM,
    FAINT,
    GREEN,
    INK,
    MODES,
    ORANGE,
    PAPER,
    RED,
    SKY,
    UNKNOWN_MODE,
    WHITE,
    Line,
    clickable,
    duration,
    shorten,
    spread,
    text,
    width,
)
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

BADGE_COLUMNS = 19
SHORTEST_NAME = 4  # columns of whoever has the instrument
WIDE_FROM_COLUMNS = 100
STAR_LOST = "star lost"
ASIDE = {"SAFE", "EXPERIMENT"}


class Header(Panel):
    """Rig, loop, mode, time in mode, link and clock; the modes as a diagram; the screens.

    On a narrow terminal the diagram gives way.
    """

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, view: str) -> None:
        super().__init__(state)
        self._view = view

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Three lines beside a badge of the mode, or two."""
        if columns < WIDE_FROM_COLUMNS:
            return [self._status(columns, small_badge=True), self._screens()]
        inner = columns - (BADGE_COLUMNS + 2)
        lines = [
            self._status(inner, small_badge=False),
            spread(self._diagram(), [], inner),
            self._screens(),
        ]
        return [
            [*left, Segment("  "), *right] for left, right in zip(self._badge(), lines, strict=True)
        ]

    @property
    def _mode(self) -> str:
        return self.state.mode or "NO DATA"

    def _badge(self) -> list[Line]:
        look = MODES.get(self._mode, UNKNOWN_MODE)
        ground = DIM if self.state.stale else look.colour
        label = f"{look.symbol} {self._mode}".center(BADGE_COLUMNS)
        blank = " " * BADGE_COLUMNS
        loop = self.state.loop
        # In VERNIER it matters which design holds the star.
        below = loop.state.controller if loop and self._mode == "VERNIER" else ""
        if loop and loop.state.search_again is not None:
            below = STAR_LOST
        rows = (blank, label, below.center(BADGE_COLUMNS))
        return [[text(row, PAPER, on=ground, bold=True)] for row in rows]

    def _status(self, columns: int, *, small_badge: bool) -> Line:
        state, loop, newest = self.state, self.state.loop, self.state.newest
        line: Line = []
        if small_badge:
            look = MODES.get(self._mode, UNKNOWN_MODE)
            ground = DIM if state.stale else look.colour
            line = [text(f" {look.symbol} {self._mode} ", PAPER, on=ground, bold=True), text(" ")]
        if loop is not None and newest is not None:
            if small_badge and loop.state.search_again is not None:
                line += [text(STAR_LOST, ORANGE, bold=True), text(" ")]
            in_mode = duration(newest.time_s - loop.state.since_s)
            line += [text(in_mode, WHITE, bold=True), text("  ")]
            line += [text(newest.rig_name, INK, bold=True)]
            place = f" {loop.state.name}"
            if len(state.loops) > 1:
                place += f" {list(state.loops).index(state.shown) + 1}/{len(state.loops)}"
            line += [text(place, SKY)]
        link = [*self._link(), text("  "), text(self._clock(), DIM)]
        if newest is not None and newest.commander:
            # Who has the instrument gives way to the state of the link.
            room = columns - width(line) - width(link) - len("  by ") - 1
            if room >= SHORTEST_NAME:
                line += [text(f"  by {shorten(newest.commander, room)}", DIM)]
        return spread(line, link, columns)

    def _link(self) -> Line:
        state = self.state
        if state.newest is None:
            return [text(" ◌ connecting ", PAPER, on=ORANGE, bold=True)]
        if state.stale:
            return [text(" ✗ link lost ", PAPER, on=RED, bold=True)]
        line = [text("●", GREEN), text(f" live {state.rate_hz:.0f} Hz", DIM)]
        if state.missed:
            line.append(text(f" {state.missed} missed!", ORANGE, bold=True))
        return line

    def _clock(self) -> str:
        wall_s = self.state.wall_s(self.state.now_s)
        if math.isnan(wall_s):
            return "--:--:-- UTC"
        return datetime.fromtimestamp(wall_s, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")

    def _diagram(self) -> Line:
        line: Line = []
        loop = self.state.loop
        modes = KIND_MODES["stellar" if loop is None else loop.state.kind]
        for mode, look in MODES.items():
            if mode not in modes or (mode == "EXPERIMENT" and mode != self._mode):
                continue  # an experiment is rare, and the line is full
            if line:
                line.append(text("   " if mode in ASIDE else " ── ", FAINT))
            if mode == self._mode:
                line.append(text(f"▐{look.symbol} {mode}▌", look.colour, bold=True))
            else:
                line.append(text(mode, DIM))
        return line

    def _screens(self) -> Line:
        line: Line = []
        for key, name, label, _ in VIEWS:
            if name == self._view:
                piece = [text(f" {key} {label} ", PAPER, on=INK, bold=True)]
            else:
                piece = [text(f" {key}", SKY, bold=True), text(f" {label} ", DIM)]
            line += clickable(piece, f"app.view('{name}')")
        return line
