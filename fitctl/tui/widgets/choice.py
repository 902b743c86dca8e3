"""A list to choose from, by keys and by mouse."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from textual.events import Click, MouseScrollDown, MouseScrollUp
from textual.message import Message

from fitctl.tui.look import SKY, Line, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

BAR = "▌"


class Choice(Panel):
    """Rows of which one is chosen; those that do not fit are scrolled to.

    Attributes
    ----------
    chosen : int
        Number of the row.
    active : bool
        The arrow keys are for this list.
    """

    every: ClassVar[int] = 5

    class Changed(Message):
        """Another row was chosen, or a click says that this list is to be active."""

        def __init__(self, choice: Choice) -> None:
            super().__init__()
            self.choice = choice

    def __init__(self, state: ConsoleState, title: str = "") -> None:
        super().__init__(state, title)
        self.chosen = 0
        self.active = True
        self._top = 0
        self._heads = 0
        self._count = 0

    def head(self, columns: int) -> list[Line]:
        """Lines that stay above the rows."""
        return []

    @abstractmethod
    def rows(self, columns: int) -> list[Line]:
        """One line for each row."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The head, and as many rows as there is room for about the chosen one."""
        heads = self.head(columns - 1)[: max(0, rows - 1)]
        lines = self.rows(columns - 1)
        room = max(1, rows - len(heads))
        self._heads, self._count = len(heads), len(lines)
        self.chosen = max(0, min(self.chosen, len(lines) - 1))
        lowest = max(0, len(lines) - room)
        self._top = min(max(self._top, self.chosen - room + 1, 0), self.chosen, lowest)
        shown = [
            [text(BAR if number == self.chosen and self.active else " ", SKY, bold=True), *line]
            for number, line in enumerate(lines[self._top : self._top + room], start=self._top)
        ]
        return [*([text(" "), *line] for line in heads), *shown]

    def move(self, by: int) -> None:
        """Choose another row, as far as there is one."""
        chosen = max(0, min(self.chosen + by, self._count - 1))
        if chosen != self.chosen:
            self.chosen = chosen
            self.redraw()
            self.post_message(self.Changed(self))

    def on_click(self, event: Click) -> None:
        """Choose the row under the mouse."""
        number = event.y - self.gutter.top - self._heads + self._top
        if 0 <= number < self._count:
            self.chosen = number
            self.redraw()
        self.post_message(self.Changed(self))

    def on_mouse_scroll_down(self, _event: MouseScrollDown) -> None:
        """Go down."""
        self.move(1)

    def on_mouse_scroll_up(self, _event: MouseScrollUp) -> None:
        """Go up."""
        self.move(-1)
