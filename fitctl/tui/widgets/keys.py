"""The bottom line: the keys that matter now, for keyboard and mouse."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import ClassVar

from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import ALARM_KEYS, KEYS, OPERATOR_COMMANDS, Key, keys_of
from fitctl.tui.look import PAPER, RED, Line, cap, clickable, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

HELP = next(key for key in KEYS if key.label == "Help")


class Keys(Panel):
    """STOP always; commands that mean something now; alarms; the screen's own keys; the rest.

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
        """One line; what does not fit is left to the help."""
        stop = [text(" s STOP ", PAPER, on=RED, bold=True)]
        line: Line = [*clickable(stop, "app.command('Stop')"), text(" ")]
        for shown, label, action in self._in_order():
            piece = cap(shown, label, action)
            if width(line) + width(piece) <= columns + 1:
                line += piece
        return [line]

    def _in_order(self) -> Iterable[tuple[str, str, str]]:
        """Each once: as people write it, its label, its action."""
        now, usable = self._now(), self.state.usable_commands
        commands = [
            (command.key, command.label, f"app.command('{command.name}')")
            for command in OPERATOR_COMMANDS
            if command.name != "Stop" and command.name in usable
        ]
        # While the arrow keys move something, that is what matters.
        own = [] if now else keys_of(self._view)
        rest = [
            (key.shown, key.label, key.action)
            for key in (HELP, *ALARM_KEYS, *own, *keys_of(""))
            if key.matters(self.state, self._alarms)
        ]
        first = [(key.shown, key.label, key.action) for key in now]
        return dict.fromkeys([*first, *commands, *rest])
