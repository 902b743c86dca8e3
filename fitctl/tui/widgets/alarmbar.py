"""What is wrong and what to do now, in full; empty when all is well."""

from __future__ import annotations

import re
import textwrap
from typing import ClassVar, NamedTuple

from rich.segment import Segment

from fitctl.tui.alarms import Alarm, AlarmBook, counts, notes
from fitctl.tui.inks import DIM, INK, ORANGE, PAPER, RED, SKY, WHITE
from fitctl.tui.look import Line, clickable, pad, text, wall, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

MOST_ROWS = 8
SEVERAL_FROM_ROWS = 50  # of the screen
MOST_ALARMS = 3
_ENDPOINT = re.compile(r" at \S+:(?= )")  # all of it is a key away
KEYS = (("v", "Alarms", "app.alarms"), ("k", "Acknowledge", "app.acknowledge"))


class AlarmBar(Panel):
    """The weightiest alarm: what happened, to what, and what the system did; below it what to do now.

    Nothing is cut: an alarm that is longer than two rows gets more. A large terminal shows several alarms.
    Without an alarm it shows in ordinary ink what an operator wanted so, such as a stop.

    Attributes
    ----------
    shown : dict of str to int
        The alarms that are on the screen, by key, with their counts.
    """

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, book: AlarmBook) -> None:
        super().__init__(state)
        self._book = book
        self.shown: dict[str, int] = {}

    def redraw(self) -> None:
        """Use as many rows as the alarms need; one row stays free when there is none."""
        columns, rows = self.container_size
        if columns:
            self.styles.height = max(1, min(MOST_ROWS, len(self._alarm_lines(columns, rows))))
        super().redraw()

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The alarms that are shown, each with what to do."""
        return self._alarm_lines(columns, self.container_size.height)[:rows]

    def _alarm_lines(self, columns: int, screen_rows: int) -> list[Line]:
        alarms = self._book.in_order
        shown = alarms[: MOST_ALARMS if screen_rows >= SEVERAL_FROM_ROWS else 1]
        self.shown = counts(shown)
        if not alarms:
            return [line for note in notes(self.state)[:1] for line in self._note(note, columns)]
        lines = []
        for alarm in shown:
            lines += self._alarm(alarm, columns)
        more = len(alarms) - len(shown)
        keys = self._keys(more)
        if width(lines[-1]) + width(keys) > columns:
            if not more:  # the keys are below, too
                return lines
            lines.append([])
        lines[-1] = [*pad(lines[-1], columns - width(keys)), *keys]
        return lines

    def _keys(self, more: int) -> Line:
        line = [text(f" +{more} more", INK, bold=True)] if more else []
        for key, label, action in KEYS:
            if key == "v" or self._book.unacknowledged:
                line += clickable(
                    [text(f"  {key}", SKY, bold=True), text(f" {label}", DIM)], action
                )
        return line

    def _alarm(self, alarm: Alarm, columns: int) -> list[Line]:
        colour, sign = (RED, "✗") if alarm.error else (ORANGE, "▲")
        stamp = f"{sign} {wall(self.state.wall_s(alarm.since_s))} "
        over = f" (over {wall(self.state.wall_s(alarm.over_s))})" if alarm.over_s else ""
        what = _ENDPOINT.sub(":", alarm.what, count=1) + over
        head = text(stamp, PAPER, on=colour, bold=True)
        inks = Inks(WHITE, INK, SKY)
        if alarm.acknowledged:
            head, inks = text(stamp, colour), Inks(DIM, DIM, DIM)
        return _written(head, Words(what, alarm.did, alarm.todo), columns, inks)

    def _note(self, note: Alarm, columns: int) -> list[Line]:
        head = text(f"■ {wall(self.state.wall_s(note.since_s))} ", INK, bold=True)
        return _written(head, Words(note.what, note.did, note.todo), columns, Inks(INK, INK, SKY))


class Words(NamedTuple):
    """What happened, what the system did, and what to do now."""

    what: str
    did: str
    todo: str


class Inks(NamedTuple):
    """Their colours."""

    what: str
    did: str
    todo: str


def _written(head: Segment, words: Words, columns: int, inks: Inks) -> list[Line]:
    """All words, whole, in as few rows as they need; what to do is in the last.

    What the system did stands beside what happened where a row has room for both, else beside what to do.
    """
    indent = head.cell_length + 1
    room = max(10, columns - indent)
    words = Words(*(one[: MOST_ROWS * room] for one in words))  # no more is shown
    did, todo = f"→ {words.did}" if words.did else "", f"▸ {words.todo}" if words.todo else ""
    first, then = [(words.what, inks.what)], [(todo, inks.todo)]
    if len(f"{words.what} {did}") <= room or len(f"{did}  {todo}") > room:
        first.append((did, inks.did))
    else:
        then.insert(0, (did, inks.did))
    rows = [row for parts in (first, then) for row in _wrapped(parts, room)]
    lines: list[Line] = [[text(" " * indent), *row] for row in rows]
    lines[0] = [head, text(" "), *rows[0]]
    return lines


def _wrapped(parts: list[tuple[str, str]], room: int) -> list[Line]:
    """Words of several inks in rows of at most `room` columns."""
    rows: list[Line] = [[]]
    for words, ink in parts:
        for word in words.split():
            for piece in textwrap.wrap(word, room):  # which parts only what is longer than a row
                gap = " " if rows[-1] else ""
                if width(rows[-1]) + len(gap + piece) > room:
                    rows.append([])
                    gap = ""
                rows[-1].append(text(gap + piece, ink, bold=ink == WHITE))
    return [row for row in rows if row]
