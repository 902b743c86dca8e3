"""What opens over the main screen: the help, and the events at full length."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Static

from fitctl.supervisor.modes import MEANING
from fitctl.tui.commands import OPERATOR_COMMANDS
from fitctl.tui.look import DIM, INK, MODES, SKY, WHITE, Line
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import event_lines

_OTHER_KEYS = (
    ("space ^s", "STOP as well; ^s stops while you type in the palette, too"),
    ("l", "show the next loop, if there are several"),
    ("e", "events at full length"),
    ("^p", "command palette: every command, and `target AZ EL` in px"),
    ("? esc", "open and close this help"),
)
_SIGNS = (
    ("+ in a box", "centroid in its 7×7 px window; the four blue lines point at the target"),
    (
        "dotted lines",
        "zero and ± the requirement; RMS is of the last 10 s in this mode, about the target",
    ),
    ("diamond", "the mirror's range, |az| + |el|; ✗ when saturated"),
    (
        "sider.",
        "the siderostat on the sky, az and el, in arcsec; to go: to its set-point, at the motors",
    ),
    ("median/worst", "of the last second, in ms: compute time, frame age, servo lateness"),
    (
        "late, lost, miss, stall",
        "ticks too late, frames lost, servo readings missed, stalls of the machine",
    ),
    ("missed, unsent", "messages that this console was too slow for, that no console was sent"),
)


class Reader(ModalScreen[None]):
    """A text to scroll through; any of its closing keys goes back."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,question_mark,e,enter", "dismiss", "Close", show=False)
    ]

    def __init__(self, title: str, content: Table | Text) -> None:
        super().__init__()
        self._title = title
        self._content = content

    def compose(self) -> ComposeResult:
        """One scrolling text in a frame."""
        with VerticalScroll() as sheet:
            sheet.border_title = self._title
            sheet.border_subtitle = "esc closes · s stops"
            yield Static(self._content)


def help_text(*, quit_shuts_down: bool) -> Table:
    """Every key, every mode, every sign."""
    leave = "quit, and end this demo" if quit_shuts_down else "leave; the instrument keeps running"
    table = Table.grid(padding=(0, 2))
    _section(table, "Keys", ((c.key, f"{c.label}: {c.help}", SKY) for c in OPERATOR_COMMANDS))
    _rows(table, ((key, meaning, SKY) for key, meaning in (*_OTHER_KEYS, ("q", leave))))
    modes = ((MODES[mode.name], mode.name, meaning) for mode, meaning in MEANING.items())
    _section(table, "Modes", ((f"{look.symbol} {m}", what, look.colour) for look, m, what in modes))
    _section(table, "Signs", ((sign, meaning, INK) for sign, meaning in _SIGNS))
    return table


def events_text(state: ConsoleState, columns: int) -> Text:
    """All events that are remembered, newest first, wrapped to a width."""
    lines = [
        line
        for event in state.events
        for line in event_lines(event, state.wall_s(event.time_s), columns)
    ]
    return Text("\n").join(map(_as_text, lines)) if lines else Text("no events yet", DIM)


def _as_text(line: Line) -> Text:
    return Text.assemble(*((segment.text, segment.style or "") for segment in line))


def _section(table: Table, title: str, rows: Iterable[tuple[str, str, str]]) -> None:
    if table.row_count:
        table.add_row()
    table.add_row(Text(title, f"bold {WHITE}"))
    _rows(table, rows)


def _rows(table: Table, rows: Iterable[tuple[str, str, str]]) -> None:
    for name, meaning, colour in rows:
        table.add_row(Text(f"  {name}", f"bold {colour}", no_wrap=True), Text(meaning, INK))
