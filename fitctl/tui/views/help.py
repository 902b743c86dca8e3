"""Help: every key, mode and sign."""

from __future__ import annotations

from collections.abc import Iterable

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.containers import VerticalScroll
from textual.widgets import Static

from fitctl.messages.modes import MEANING
from fitctl.tui.commands import OPERATOR_COMMANDS, VIEWS, keys_of
from fitctl.tui.look import INK, MODES, SKY, WHITE
from fitctl.tui.views.view import View

_SIGNS = (
    ("+ in a box", "centroid in its 7×7 px window; the four blue lines point at the target"),
    ("◦", "another spot that moves with the star, such as its fringe spot, by the rig file"),
    (
        "dotted lines",
        "zero and ± the requirement; RMS is of the last 10 s in this mode, about the target",
    ),
    ("diamond", "the mirror's range, |az| + |el|, with its way of the last 10 s; ✗ when saturated"),
    (
        "sider",
        "the siderostat on the sky, az and el, in arcsec; to go: to its set-point, at the motors",
    ),
    ("median/worst", "of the last second, in ms: compute time, frame age, servo lateness"),
    ("✓ ▲ ✗ · ○", "well, warning, fault, not judged in this mode, closed"),
)
_ALWAYS = (
    ("space ^s", "STOP as well; ^s stops while you type, too"),
    ("click", "on a key of the last line, on a screen's name, on a row, on the focal plane"),
)


class HelpView(View):
    """A text to scroll through."""

    view_name = "help"

    def parts(self) -> ComposeResult:
        """The whole of it."""
        with VerticalScroll(id="sheet"):
            yield Static(help_text(quit_shuts_down=self.console.quit_shuts_down))


def help_text(*, quit_shuts_down: bool) -> Table:
    """Every key, every mode, every sign."""
    leave = "quit, and end this demo" if quit_shuts_down else "leave; the instrument keeps running"
    table = Table.grid(padding=(0, 2))
    commands = ((c.key, f"{c.label}: {c.help}", SKY) for c in OPERATOR_COMMANDS)
    _section(table, "Commands, on every screen", commands)
    _rows(table, ((key, meaning, SKY) for key, meaning in _ALWAYS))
    _section(table, "Screens", ((view.key, f"{view.label}: {view.help}", SKY) for view in VIEWS))
    common = (
        (k.shown, f"{k.label}: {leave if k.keys == 'q' else k.help}", SKY) for k in keys_of("")
    )
    _section(table, "Everywhere", common)
    for view in VIEWS:
        own = keys_of(view.name)
        if own:
            rows = ((key.shown, f"{key.label}: {key.help}", SKY) for key in own)
            _section(table, f"Screen {view.label}", rows)
    modes = ((MODES[mode.name], mode.name, meaning) for mode, meaning in MEANING.items())
    _section(table, "Modes", ((f"{look.symbol} {m}", what, look.colour) for look, m, what in modes))
    _section(table, "Signs", ((sign, meaning, INK) for sign, meaning in _SIGNS))
    return table


def _section(table: Table, title: str, rows: Iterable[tuple[str, str, str]]) -> None:
    if table.row_count:
        table.add_row()
    table.add_row(Text(title, f"bold {WHITE}"))
    _rows(table, rows)


def _rows(table: Table, rows: Iterable[tuple[str, str, str]]) -> None:
    for name, meaning, colour in rows:
        table.add_row(Text(f"  {name}", f"bold {colour}", no_wrap=True), Text(meaning, INK))
