"""The bottom line: the keys that matter now, for keyboard and mouse."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from fitctl.tui.commands import OPERATOR_COMMANDS, Key, keys_of
from fitctl.tui.look import PAPER, RED, Line, cap, clickable, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel


class Keys(Panel):
    """STOP always; commands that mean something now; the screen's own keys; the rest where there is room.

    Parameters
    ----------
    state : ConsoleState
    view : str
        Name of the screen.
    now : callable
        Keys that go before the screen's own at this moment, such as those of a jog.
    """

    every: ClassVar[int] = 2

    def __init__(
        self,
        state: ConsoleState,
        view: str,
        now: Callable[[], list[Key]] = list,
    ) -> None:
        super().__init__(state)
        self._view = view
        self._now = now

    def draw(self, columns: int, rows: int) -> list[Line]:
        """One line; what does not fit is left to the help."""
        stop = [text(" s STOP ", PAPER, on=RED, bold=True)]
        line: Line = [*clickable(stop, "app.command('Stop')"), text(" ")]
        for key, label, action in self._in_order():
            piece = cap(key, label, action)
            if width(line) + width(piece) <= columns + 1:
                line += piece
        return [line]

    def _in_order(self) -> list[tuple[str, str, str]]:
        now = self._now()
        usable = self.state.usable_commands
        commands = [
            (command.key, command.label, f"app.command('{command.name}')")
            for command in OPERATOR_COMMANDS
            if command.name != "Stop" and command.name in usable
        ]
        own = [key for key in keys_of(self._view) if key.matters(self.state)]
        common = [key for key in keys_of("") if key.matters(self.state)]
        told = [(key.shown, key.label, key.action) for key in now]
        # While the arrow keys move something, that is what matters.
        rest = [(key.shown, key.label, key.action) for key in ([] if now else own) + common]
        help_ = next(item for item in rest if item[1] == "Help")
        rest.remove(help_)
        return [*told, *commands, help_, *rest]
