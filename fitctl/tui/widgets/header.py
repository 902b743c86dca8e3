"""The three lines on top: what runs, its mode and for how long, how it came there, and whether data flow."""

from __future__ import annotations

import math
from datetime import UTC, datetime

from rich.segment import Segment

from fitctl.supervisor.messages import TrippedInterlock
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
    duration,
    shorten,
    spread,
    text,
    width,
)
from fitctl.tui.widgets.panel import Panel

BADGE_COLUMNS = 19
BADGE_FROM_COLUMNS = 100

ASIDE = {"SAFE", "EXPERIMENT"}


class Header(Panel):
    """Rig, loop, mode, time in mode, link, clock; the modes as a diagram; interlocks or last transition."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Three lines, with a large badge of the mode beside them where there is room."""
        badge = self._badge() if columns >= BADGE_FROM_COLUMNS else None
        inner = columns - (BADGE_COLUMNS + 2 if badge else 0)
        lines = [
            self._status(inner, small_badge=badge is None),
            spread(self._diagram(), [], inner),
            self._news(inner),
        ]
        if badge:
            lines = [
                [*left, Segment("  "), *right] for left, right in zip(badge, lines, strict=True)
            ]
        return lines

    @property
    def _mode(self) -> str:
        loop = self.state.loop
        return loop.state.mode if loop else "NO DATA"

    def _badge(self) -> list[Line]:
        look = MODES.get(self._mode, UNKNOWN_MODE)
        ground = DIM if self.state.stale else look.colour
        label = f"{look.symbol} {self._mode}".center(BADGE_COLUMNS)
        blank = " " * BADGE_COLUMNS
        loop = self.state.loop
        # In VERNIER it matters which design holds the star.
        design = loop.state.controller if loop and self._mode == "VERNIER" else ""
        rows = (blank, label, design.center(BADGE_COLUMNS))
        return [[text(row, PAPER, on=ground, bold=True)] for row in rows]

    def _status(self, columns: int, *, small_badge: bool) -> Line:
        state, loop, newest = self.state, self.state.loop, self.state.newest
        line: Line = []
        if small_badge:
            look = MODES.get(self._mode, UNKNOWN_MODE)
            ground = DIM if state.stale else look.colour
            line = [text(f" {look.symbol} {self._mode} ", PAPER, on=ground, bold=True), text(" ")]
        if loop is not None and newest is not None:
            in_mode = duration(newest.time_s - loop.state.since_s)
            line += [text(in_mode, WHITE, bold=True), text("  ")]
            line += [text(newest.rig_name, INK, bold=True)]
            place = f" {loop.state.name}"
            if len(state.loops) > 1:
                place += f" {list(state.loops).index(state.shown) + 1}/{len(state.loops)}"
            line += [text(place, SKY)]
            if newest.commander:
                line += [text(f"  by {newest.commander}", DIM)]
        return spread(line, [*self._link(), text("  "), text(self._clock(), DIM)], columns)

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
        for mode, look in MODES.items():
            if mode == "EXPERIMENT" and mode != self._mode:
                continue  # rare, and the line is full
            if line:
                line.append(text("   " if mode in ASIDE else " ── ", FAINT))
            if mode == self._mode:
                line.append(text(f"▐{look.symbol} {mode}▌", look.colour, bold=True))
            else:
                line.append(text(mode, DIM))
        return line

    def _news(self, columns: int) -> Line:
        state = self.state
        if state.stale:
            old = "; what you see is old" if state.newest else "; is the supervisor running?"
            message = f" ✗ NO DATA for {state.silent_s:.0f} s{old}; reconnecting"
            return [text(message.ljust(columns), PAPER, on=RED, bold=True)]
        tripped = state.loop.state.interlocks if state.loop else []
        if tripped:
            return self._tripped(tripped, columns)
        change = state.loop.change if state.loop else None
        if change is None:
            return [text("no change of mode since this console began to listen", DIM)]
        line = [
            text(f"{self._at(change.time_s)} ", DIM),
            text(f"{change.source} → {change.target}", INK),
            text(f"  {change.trigger.lower().replace('_', ' ')}", SKY),
        ]
        if change.reason:
            line.append(text(shorten(f"  {change.reason}", columns - width(line)), DIM))
        return line

    def _tripped(self, tripped: list[TrippedInterlock], columns: int) -> Line:
        """The one that tripped last in full, and how many there are besides."""
        last = max(tripped, key=lambda trip: trip.since_s)
        others = f" +{len(tripped) - 1}" if len(tripped) > 1 else ""
        colour = ORANGE if last.action == "warn" else RED
        line = [
            text(f"{self._at(last.since_s)} ", DIM),
            text(f"▲ {last.name} {last.action}{others}", colour, bold=True),
        ]
        how = "" if last.reset == "itself" else f"; reset {last.name}"
        return [*line, text(shorten(f"  {last.reason}{how}", columns - width(line)), DIM)]

    def _at(self, time_s: float) -> str:
        return datetime.fromtimestamp(self.state.wall_s(time_s), UTC).strftime("%H:%M:%S")
