"""What happened lately, newest first."""

from __future__ import annotations

import textwrap

from fitctl.logging.records import Event
from fitctl.tui.look import DIM, SEVERITIES, Line, text, wall
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
            lines += event_lines(event, self.state.wall_s(event.time_s), columns)
        return lines or [[text("no events yet", DIM)]]


def event_lines(event: Event, wall_s: float, columns: int) -> list[Line]:
    """One event: time, sign of its severity, source and message, wrapped under itself."""
    look = SEVERITIES[event.severity]
    room = max(10, columns - STAMP_COLUMNS)
    pieces = textwrap.wrap(f"{event.source}: {event.message}", room) or [""]
    lines: list[Line] = [
        [
            text(f"{wall(wall_s)} ", DIM),
            text(f"{look.symbol} ", look.colour, bold=True),
            text(pieces[0], look.colour),
        ]
    ]
    return lines + [[text(" " * STAMP_COLUMNS), text(piece, look.colour)] for piece in pieces[1:]]
