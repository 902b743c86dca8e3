"""The base of screens with lists: the arrow keys move in the active one, tab makes the other active."""

from __future__ import annotations

from typing import ClassVar

from textual.binding import Binding, BindingType

from fitctl.tui.views.view import View
from fitctl.tui.widgets.choice import Choice


class ListingView(View):
    """A screen with at least one :class:`Choice`; the first is active to begin with."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up", "move(-1)", show=False),
        Binding("down", "move(1)", show=False),
        Binding("pageup", "move(-10)", show=False),
        Binding("pagedown", "move(10)", show=False),
        Binding("tab,shift+tab", "other", show=False),
    ]

    def choices(self) -> list[Choice]:
        """The lists, in reading order."""
        return [widget for widget in self.query() if isinstance(widget, Choice)]

    def on_mount(self) -> None:
        """The first list is active."""
        super().on_mount()
        self._activate(self.choices()[0])

    def action_move(self, by: int) -> None:
        """Another row of the active list."""
        for choice in self.choices():
            if choice.active:
                choice.move(by)

    def action_other(self) -> None:
        """The next list becomes active."""
        choices = self.choices()
        now = next(number for number, choice in enumerate(choices) if choice.active)
        self._activate(choices[(now + 1) % len(choices)])

    def on_choice_changed(self, event: Choice.Changed) -> None:
        """A list that was clicked becomes active."""
        self._activate(event.choice)

    def _activate(self, chosen: Choice) -> None:
        for choice in self.choices():
            choice.active = choice is chosen
            choice.set_class(choice is chosen, "active")
        self.call_after_refresh(self.console.draw_all)
