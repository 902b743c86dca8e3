"""The base of all panels: lines drawn by hand, of which the terminal gets only the changed ones."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar

from textual.geometry import Region
from textual.strip import Strip
from textual.widget import Widget

from fitctl.tui.inks import INK, PAPER, RED
from fitctl.tui.look import Line, faded, style, text
from fitctl.tui.state import ConsoleState

GROUND = style(INK, PAPER)  # the stylesheet's, which takes long to ask for at every line


class Panel(Widget, can_focus=False):
    """A part of the screen that draws itself from the console's state.

    Parameters
    ----------
    state : ConsoleState
        Read at every redraw; never changed here.
    title : str
        Shown in the panel's upper border, where the layout gives it one.

    Attributes
    ----------
    every : int
        It is drawn at each of so many beats of the console (:data:`fitctl.tui.app.BEAT_S`).
    is_old : bool
        What it shows is of the past: it is drawn in greys.
    """

    every: ClassVar[int] = 2

    def __init__(self, state: ConsoleState, title: str = "") -> None:
        super().__init__(id=type(self).__name__.lower())
        self.state = state
        self.border_title = title
        self.is_old = False
        self._strips: list[Strip] = []

    @abstractmethod
    def draw(self, columns: int, rows: int) -> list[Line]:
        """Lines of the whole content, uppermost first; what is too long is cut."""

    def redraw(self) -> None:
        """Draw anew, and ask for a repaint of the lines that differ."""
        columns, rows = self.content_size
        if not columns or not rows:
            return
        old = self._strips
        lines = self._lines(columns, rows)[:rows]
        self._strips = [Strip(faded(line) if self.is_old else line) for line in lines]
        changed = [y for y, strip in enumerate(self._strips) if y >= len(old) or strip != old[y]]
        changed.extend(range(len(self._strips), len(old)))
        if changed:
            self.refresh(*(Region(0, y, columns, 1) for y in changed))

    def _lines(self, columns: int, rows: int) -> list[Line]:
        """What is drawn; of a log, whose values may be anything, also why nothing can be."""
        try:
            return self.draw(columns, rows)
        except Exception as error:
            if self.state.live:
                raise
            return [[text(f"✗ cannot be drawn: {type(error).__name__}: {error}", RED)]]

    def on_resize(self) -> None:
        """Fill the new size."""
        self._strips = []
        self.redraw()
        self.refresh()

    def render_line(self, y: int) -> Strip:
        """One line for Textual's compositor."""
        columns = self.content_size.width
        if y >= len(self._strips):
            return Strip.blank(columns, GROUND)
        return self._strips[y].adjust_cell_length(columns).apply_style(GROUND)
