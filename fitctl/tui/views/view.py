"""The base of all screens: header and status bar above, keys below, and what is the screen's own between."""

from __future__ import annotations

from abc import abstractmethod
from typing import ClassVar, cast

from textual.app import ComposeResult
from textual.containers import Container
from textual.events import Resize
from textual.screen import Screen

from fitctl.tui.commands import Key
from fitctl.tui.console import Console
from fitctl.tui.rewind.bar import RewindBar
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.alarmbar import AlarmBar
from fitctl.tui.widgets.header import WIDE_FROM_COLUMNS, Header
from fitctl.tui.widgets.keys import Keys, StopKey
from fitctl.tui.widgets.panel import Panel

TALL_FROM_ROWS = 36
OF_TELEMETRY = {"operate", "devices", "loop"}  # screens whose body is old when the data are


class View(Screen[None]):
    """One of the console's screens.

    Attributes
    ----------
    view_name : str
        As :data:`fitctl.tui.commands.SCREENS` has it.
    """

    view_name: ClassVar[str]

    @property
    def console(self) -> Console:
        """The console that this is a screen of."""
        return cast("Console", self.app)

    @property
    def state(self) -> ConsoleState:
        """What the console knows."""
        return self.console.state

    def compose(self) -> ComposeResult:
        """From top to bottom."""
        yield Header(self.state, self.view_name, self.console.alarms)
        yield AlarmBar(self.state, self.console.alarms)
        with Container(id="body"):
            yield from self.parts()
        yield RewindBar(self.state, self.console.playback)
        yield Keys(self.state, self.view_name, self.console.alarms, self.keys_now)
        yield StopKey()

    @abstractmethod
    def parts(self) -> ComposeResult:
        """The screen's own part."""

    def keys_now(self) -> list[Key]:
        """Keys that go before the screen's own, at this moment."""
        return []

    def to_rehearse(self) -> str:
        """The command that is most likely wanted next."""
        tick = self.state.loop.tick if self.state.loop else None
        if self.state.mode in {"COARSE", "VERNIER"} and tick is not None:
            return f"target {tick.target_az_px:g} {tick.target_el_px:g}"
        return {"SAFE": "recover", "STANDBY": "jog 10 0", "OFF": "standby"}.get(
            self.state.mode, "release"
        )

    def on_mount(self) -> None:
        """Choose the layout that fits."""
        self._arrange(self.app.size.width, self.app.size.height)

    def on_resize(self, event: Resize) -> None:
        """Choose the layout that fits now."""
        self._arrange(event.size.width, event.size.height)

    def _arrange(self, columns: int, rows: int) -> None:
        tall = rows >= TALL_FROM_ROWS
        zoom = 3 if columns >= 220 and rows >= 82 else 2 if columns >= 150 and rows >= 58 else 1
        self.set_class(not tall, "short")
        self.set_class(tall, "tall")
        self.set_class(columns >= WIDE_FROM_COLUMNS, "broad")
        self.set_class(tall and columns >= 40 * zoom + 76, "wide")
        self.set_class(tall and zoom == 2, "zoom2")
        self.set_class(tall and zoom == 3, "zoom3")

    def draw(self, beat: int | None) -> None:
        """Draw the panels whose turn it is; all without a beat."""
        self.set_class(self.state.stale, "stale")
        self.set_class(not self.state.live, "past")
        self.set_class(len(self.state.loops) > 1, "several")
        self.before_drawing()
        old = self.state.stale and self.view_name in OF_TELEMETRY
        panels = [widget for widget in self.query() if isinstance(widget, Panel)]
        for panel in panels:
            panel.is_old = old and panel.parent is not self
            if panel.display and (beat is None or beat % panel.every == 0):
                panel.redraw()

    def on_choice_changed(self) -> None:
        """Draw what depends on a list's choice."""
        self.call_after_refresh(self.console.draw_all)

    def before_drawing(self) -> None:
        """What must be done at each beat."""
