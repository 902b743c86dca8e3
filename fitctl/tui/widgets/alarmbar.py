"""The status bar: empty when all is well."""

from __future__ import annotations

import re
from typing import ClassVar

from fitctl.tui.alarms import Alarm, AlarmBook
from fitctl.tui.look import (
    DIM,
    INK,
    ORANGE,
    PAPER,
    RED,
    SKY,
    WHITE,
    Line,
    clickable,
    pad,
    shorten,
    text,
    wall,
    width,
)
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

MOST_ROWS = 3
_ENDPOINT = re.compile(r" at \S+:(?= )")  # all of it is a key away
DID_FROM_COLUMNS = 130


class AlarmBar(Panel):
    """One alarm a row, the weightiest first: what, since when, what was done, what to do."""

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, book: AlarmBook) -> None:
        super().__init__(state)
        self._book = book

    def redraw(self) -> None:
        """Take as many rows as there are alarms, where the screen has rows to spare."""
        most = MOST_ROWS if self.screen.has_class("tall") else 1
        self.styles.height = max(1, min(most, len(self._book.alarms)))
        super().redraw()

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The first alarms; the last row says how many more there are."""
        alarms = self._book.in_order
        lines: list[Line] = []
        for number, alarm in enumerate(alarms[:rows], start=1):
            more = len(alarms) - number if number == rows else 0
            lines.append(self._row(alarm, more, columns, first=number == 1))
        return lines

    def _row(self, alarm: Alarm, more: int, columns: int, *, first: bool) -> Line:
        ground = RED if alarm.error else ORANGE
        sign = "✗" if alarm.error else "▲"
        since = wall(self.state.wall_s(alarm.since_s))
        keys: Line = []
        if more:
            keys += [text(f" +{more}", INK, bold=True)]
        if first:
            keys += clickable([text(" v", SKY, bold=True), text(" all", DIM)], "app.alarms")
            if self._book.unacknowledged:
                keys += clickable(
                    [text(" k", SKY, bold=True), text(" seen", DIM)], "app.acknowledge"
                )
        room = columns - width(keys)
        if alarm.acknowledged:
            head = [text(f" {sign} {since} ", ground)]
            ink, back = DIM, None
        else:
            head = [text(f" {sign} {since} ", PAPER, on=ground, bold=True)]
            ink, back = WHITE, None
        body = self._body(alarm, room - width(head) - 1, ink)
        return [*pad([*head, text(" ", ink, on=back), *body], room), *keys]

    def _body(self, alarm: Alarm, columns: int, ink: str) -> Line:
        over = f" (over {wall(self.state.wall_s(alarm.over_s))})" if alarm.over_s else ""
        did = f" — {alarm.did}" if columns >= DID_FROM_COLUMNS else ""
        todo = f" ▸ {alarm.todo}"
        brief = _ENDPOINT.sub(":", alarm.what, count=1)
        what = shorten(brief + over, max(columns - len(did) - len(todo), (columns * 11) // 20))
        return [
            text(what, ink, bold=True),
            text(did, DIM),
            text(shorten(todo, columns - len(what) - len(did)), SKY if ink != DIM else DIM),
        ]
