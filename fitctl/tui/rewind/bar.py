"""The line that says which moment of the past is on the screen."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

from textual.events import Click

from fitctl.logging.records import Event
from fitctl.tui.inks import DIM, INK, ORANGE, PAPER, RED, WHITE
from fitctl.tui.look import Line, duration, shorten, text, width
from fitctl.tui.look import wall as utc
from fitctl.tui.rewind.playback import Playback
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

KEYS = ", . 1 s  < > 10 s  ( ) alarm  @ time"


class RewindBar(Panel):
    """Where the moment lies between the oldest and the newest, with warnings and errors on the way.

    Nothing while live. A click goes to the moment under it.
    """

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, playback: Playback) -> None:
        super().__init__(state)
        self._playback = playback

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The moment in words, then the line of time."""
        playback, state = self._playback, self.state
        if playback.shown_s is None:
            return []
        oldest_s, newest_s = playback.recording.span_s()
        moment_s = playback.shown_s
        badge = " LOG " if playback.log_name else " ◀◀ PAST "
        line: Line = [text(badge, PAPER, on=WHITE, bold=True)]
        line.append(text(f" {utc(state.wall_s(moment_s))} UTC", WHITE, bold=True))
        if playback.log_name:
            line.append(
                text(f"  {duration(moment_s - oldest_s)} of {duration(newest_s - oldest_s)}", INK)
            )
        else:
            line.append(text(f"  {duration(playback.live.now_s - moment_s)} ago", INK))
        if playback.pending:
            line.append(text("  reading", DIM))
        lines = [self._with_right_part(line, columns)]
        if rows > 1:
            lines.append(timeline(playback.marks(), oldest_s, newest_s, moment_s, columns))
        return lines

    def _with_right_part(self, line: Line, columns: int) -> Line:
        """What is wrong now, which the past must not hide; else the log's name; else the keys."""
        playback = self._playback
        room = columns - width(line) - 2
        now = [] if playback.log_name else playback.live_alarms.in_order
        fresh = [alarm for alarm in now if not alarm.acknowledged]
        if fresh:
            colour = RED if fresh[0].error else ORANGE
            sign = "✗" if fresh[0].error else "▲"
            return [*line, text(shorten(f"  NOW {sign} {fresh[0].what}", room), colour, bold=True)]
        back = "" if playback.log_name else "end now  "
        return [*line, text(shorten(f"  {back}{KEYS}  {playback.log_name}", room), DIM)]

    def on_click(self, event: Click) -> None:
        """Show the moment under the mouse."""
        oldest_s, newest_s = self._playback.recording.span_s()
        fraction = event.x / max(1, self.size.width - 1)
        self._playback.to(oldest_s + fraction * (newest_s - oldest_s))


def timeline(
    marks: Sequence[Event], oldest_s: float, newest_s: float, moment_s: float, columns: int
) -> Line:
    """A line of time with the moment, and a sign where there were warnings and errors."""
    span_s = max(newest_s - oldest_s, 1e-3)

    def column(time_s: float) -> int:
        return min(columns - 1, max(0, int((time_s - oldest_s) / span_s * columns)))

    signs = [("─", DIM)] * columns
    for severity, sign in (("warning", ("▲", ORANGE)), ("error", ("✗", RED))):
        for event in marks:
            if event.severity == severity:
                signs[column(event.time_s)] = sign
    signs[column(moment_s)] = ("┃", WHITE)
    return [text(sign, colour) for sign, colour in signs]
