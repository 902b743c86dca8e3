"""The bottom line: what can be done now, in groups, for keyboard and mouse; and STOP, which nothing covers."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from rich.segment import Segment
from rich.text import Text
from textual.events import Click
from textual.widget import Widget

from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import ALARM_KEYS, KEYS, OPERATOR_COMMANDS, Key, keys_of
from fitctl.tui.inks import FAINT, INK, PAPER, RED, SKY, WHITE
from fitctl.tui.look import Line, cap, clickable, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

HELP = next(key for key in KEYS if key.label == "Help")
# Keys that stand for several, each with what Textual calls for it.
ARROWS = {
    ("↑↓", ""): (("↑", "focused.move(-1)"), ("↓", "focused.move(1)")),
    ("↑↓←→", "screen.nudge"): (
        ("↑", "screen.nudge(0, 1)"),
        ("↓", "screen.nudge(0, -1)"),
        ("←", "screen.nudge(-1, 0)"),
        ("→", "screen.nudge(1, 0)"),
    ),
    ("[ ]", "screen.step"): (("[", "screen.step(-1)"), ("]", "screen.step(1)")),
}


class StopKey(Widget, can_focus=False):
    """STOP at the top right, over every screen and every dialog, as bright as ever."""

    def render(self) -> Text:
        """The key; white where there are no colours, which makes it the brightest thing on the screen."""
        ground = WHITE if self.app.no_color else RED
        return Text("  s STOP  ", f"bold {PAPER} on {ground}")

    async def on_click(self, event: Click) -> None:
        """Stop."""
        event.stop()
        await self.app.run_action("command('Stop')")


class Keys(Panel):
    """STOP always; then what can be done in this mode: commands, alarms, the screen's own keys, the rest.

    With several loops the commands begin with the name of the loop that they go to.

    Parameters
    ----------
    state : ConsoleState
    view : str
        Name of the screen.
    alarms : AlarmBook
    now : callable
        Keys that go before the screen's own at this moment, such as those of a jog.
    """

    every: ClassVar[int] = 2

    def __init__(
        self,
        state: ConsoleState,
        view: str,
        alarms: AlarmBook,
        now: Callable[[], list[Key]] = list,
    ) -> None:
        super().__init__(state)
        self._view = view
        self._alarms = alarms
        self._now = now

    def draw(self, columns: int, rows: int) -> list[Line]:
        """One line; what does not fit is left to the help, whose own key always fits."""
        several = len(self.state.loops) > 1
        stop = [text(" s STOP all " if several else " s STOP ", PAPER, on=RED, bold=True)]
        line: Line = clickable(stop, "app.command('Stop')")
        help_key = _caps(HELP)
        room = columns - width(help_key)
        for heading, group in self._groups():
            between: Line = [text(" │ ", FAINT), *heading]
            for piece in group:
                if width(line) + width(between) + width(piece) <= room:
                    line = [*line, *between, *piece]
                    between = []
        return [[*line, text(" "), *help_key]]

    def _groups(self) -> list[tuple[Line, list[Line]]]:
        """Heading and keys of each group, the weightiest first; each key once."""
        now, state = self._now(), self.state
        commands = [
            cap(command.key, command.label, f"app.command('{command.name}')")
            for command in OPERATOR_COMMANDS
            if command.name != "Stop" and command.name in state.usable_commands
        ]
        several = len(state.loops) > 1
        heading: Line = [text(f"{state.shown} ", WHITE, bold=True)] if several else []
        # While the arrow keys move something, that is what matters.
        own = [] if now else keys_of(self._view)
        rest = [key for key in keys_of("") if key not in ALARM_KEYS and key != HELP]
        return [
            (heading, [_caps(key) for key in now]),
            (heading if not now else [], commands),
            *(([], self._that_matter(keys)) for keys in (ALARM_KEYS, own, rest)),
        ]

    def _that_matter(self, keys: tuple[Key, ...] | list[Key]) -> list[Line]:
        return [_caps(key) for key in keys if key.matters(self.state, self._alarms)]


def _caps(key: Key) -> Line:
    """A key and what it does; one that stands for several keys is as many buttons."""
    several = ARROWS.get((key.shown, key.action.partition("(")[0]))
    if several is None:
        return cap(key.shown, key.label, key.action)
    line: list[Segment] = []
    for shown, action in several:
        line += clickable([text(shown, PAPER, on=SKY, bold=True)], action)
    return [*line, text(f" {key.label} ", INK)]
