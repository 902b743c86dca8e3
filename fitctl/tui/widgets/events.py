"""What happened lately, newest first."""

from __future__ import annotations

import textwrap
from collections.abc import Collection

from fitctl.logging.records import Event
from fitctl.tui.inks import DIM, INK
from fitctl.tui.look import SEVERITIES, Line, text, wall
from fitctl.tui.widgets.panel import Panel

STAMP_COLUMNS = 11


class Events(Panel):
    """As many events as there are rows; long ones are wrapped."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Newest first, until the panel is full."""
        lines: list[Line] = []
        for event in self.state.events:
            if len(lines) >= rows:
                break
            lines += event_lines(event, self.state.wall_s(event.time_s), columns, self.state.loops)
        return lines or [[text("no events yet", DIM)]]


def event_lines(
    event: Event, wall_s: float, columns: int, loops: Collection[str] = ()
) -> list[Line]:
    """One event: time, sign of its severity, source and message, wrapped under itself.

    With several `loops`, their names have a column of their own; what is of no loop leaves it empty.
    """
    look = SEVERITIES[event.severity]
    words, column = f"{event.source}: {event.message}", ""
    if len(loops) > 1:
        of_loop = event.source in loops
        words = event.message if of_loop else words
        column = f"{event.source if of_loop else '':<{max(map(len, loops))}}  "
    indent = STAMP_COLUMNS + len(column)
    room = max(10, columns - indent)
    pieces = textwrap.wrap(words, room) or [""]
    lines: list[Line] = [
        [
            text(f"{wall(wall_s)} ", DIM),
            text(f"{look.symbol} ", look.colour, bold=True),
            text(column, INK, bold=True),
            text(pieces[0], look.colour),
        ]
    ]
    return lines + [[text(" " * indent), text(piece, look.colour)] for piece in pieces[1:]]
