"""A list to choose from, by keys and by mouse."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from textual.binding import Binding, BindingType
from textual.events import Click, MouseScrollDown, MouseScrollUp
from textual.message import Message

from fitctl.tui.inks import DIM, SKY
from fitctl.tui.look import Line, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

BAR = "▌"
THIN_BAR = "▏"
"""Before the chosen row of a list that does not have the focus."""


class Choice(Panel, can_focus=True):
    """Rows of which one is chosen; the arrow keys move in the list that has the focus.

    Attributes
    ----------
    chosen : int
        Number of the row. Where rows have names, the choice follows its row to another place in the list.
    """

    every: ClassVar[int] = 5
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
        Binding("pageup", "move(-10)", show=False),
        Binding("pagedown", "move(10)", show=False),
    ]

    class Changed(Message):
        """Another row was chosen, or another list has the focus."""

    def __init__(self, state: ConsoleState, title: str = "") -> None:
        super().__init__(state, title)
        self.chosen = 0
        self._top = 0
        self._heads = 0
        self._count = 0
        self._names: list[str] = []  # as they were drawn last

    @property
    def takes_keys(self) -> bool:
        """Whether keys go to this list.

        `has_focus` becomes true only a message later, when a key that was typed fast may have been handled.
        """
        return self.screen.focused is self

    def names(self) -> list[str]:
        """The names of the rows, where rows change places; empty where they do not."""
        return []

    def _follow(self) -> None:
        """Keep the choice on its row."""
        before, self._names = self._names, self.names()
        if self.chosen < len(before) and before[self.chosen] in self._names:
            self.chosen = self._names.index(before[self.chosen])

    def head(self, columns: int) -> list[Line]:
        """Lines that stay above the rows."""
        return []

    @abstractmethod
    def rows(self, columns: int) -> list[Line]:
        """One line for each row."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The head, and as many rows as there is room for about the chosen one."""
        self._follow()
        heads = self.head(columns - 1)[: max(0, rows - 1)]
        lines = self.rows(columns - 1)
        room = max(1, rows - len(heads))
        self._heads, self._count = len(heads), len(lines)
        self.chosen = max(0, min(self.chosen, len(lines) - 1))
        lowest = max(0, len(lines) - room)
        self._top = min(max(self._top, self.chosen - room + 1, 0), self.chosen, lowest)
        mark = text(BAR, SKY, bold=True) if self.has_focus else text(THIN_BAR, DIM)
        shown = [
            [mark if number == self.chosen else text(" "), *line]
            for number, line in enumerate(lines[self._top : self._top + room], start=self._top)
        ]
        return [*([text(" "), *line] for line in heads), *shown]

    def action_move(self, by: int) -> None:
        """Choose another row, as far as there is one."""
        chosen = max(0, min(self.chosen + by, self._count - 1))
        if chosen != self.chosen:
            self.chosen = chosen
            self.redraw()
            self.post_message(self.Changed())

    def on_focus(self) -> None:
        """Show it."""
        self.post_message(self.Changed())

    def on_click(self, event: Click) -> None:
        """Choose the row under the mouse."""
        number = event.y - self.gutter.top - self._heads + self._top
        if 0 <= number < self._count:
            self.chosen = number
            self.redraw()
            self.post_message(self.Changed())

    def on_mouse_scroll_down(self, _event: MouseScrollDown) -> None:
        """Go down."""
        self.focus()
        self.action_move(1)

    def on_mouse_scroll_up(self, _event: MouseScrollUp) -> None:
        """Go up."""
        self.focus()
        self.action_move(-1)
