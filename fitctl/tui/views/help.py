"""Help: every key, mode and sign."""

from __future__ import annotations

from collections.abc import Iterable
from typing import ClassVar, NamedTuple, cast

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import VerticalScroll
from textual.widgets import Input, Static

from fitctl.messages.modes import MEANING
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.commands import KEYS, OPERATOR_COMMANDS, SCREENS, keys_of
from fitctl.tui.inks import INK, SKY, WHITE
from fitctl.tui.look import MODES
from fitctl.tui.state import ConsoleState
from fitctl.tui.views.view import View

_SIGNS = (
    ("+ in a box", "centroid in its 7×7 px window; the four blue lines point at the target"),
    ("◦", "another spot that moves with the star, such as its fringe spot, from the rig file"),
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
    ("✓ ▲ ✗ · ○", "well, warning, fault, not evaluated in this mode, closed"),
)
_ALWAYS = (
    ("space ^s", "STOP as well; ^s stops while you type, too"),
    ("click", "on a key of the last line, on a screen's name, on a row, on the focal plane"),
)


class Section(NamedTuple):
    """Some rows of help: a key or sign, what it means, and the colour of the first."""

    title: str
    rows: list[tuple[str, str, str]]


class HelpSheet(VerticalScroll):
    """The text, in which home and end keep their meaning for the past while that is shown."""

    def check_action(self, action: str, parameters: tuple[object, ...]) -> bool:
        """Whether it scrolls: not where the console has the key for the past."""
        is_past = not cast("HelpView", self.screen).state.live
        return not (is_past and action in {"scroll_home", "scroll_end"})


class HelpView(View):
    """What can be done now, then everything; a filter shows the rows that have its words."""

    view_name = "help"
    BINDINGS: ClassVar[list[BindingType]] = [
        *(key.binding() for key in keys_of("help")),
        Binding("question_mark", "leave", show=False),
    ]

    def __init__(self) -> None:
        super().__init__()
        self._shown: tuple[object, ...] = ()

    def parts(self) -> ComposeResult:
        """The filter, while there is one, and the whole of it."""
        yield Input(
            placeholder="words to find; enter keeps the filter, esc shows everything", id="filter"
        )
        with HelpSheet(id="sheet"):
            yield Static("", id="help")

    def on_mount(self) -> None:
        """No filter at first: letters are commands."""
        super().on_mount()
        self.query_one("#filter").display = False
        self.query_one("#sheet").focus()

    def before_drawing(self) -> None:
        """Show what can be done now."""
        if not self.query("#help"):  # the screen is not composed yet
            return
        sections = self.sections()
        words = self.query_one("#filter", Input).value
        if (words, sections) != self._shown:
            self._shown = (words, sections)
            self.query_one("#help", Static).update(table(matching(sections, words)))

    def sections(self) -> list[Section]:
        """Everything, what can be done now first."""
        now = now_section(self.state, self.console.alarms)
        return [now, *all_sections(quit_shuts_down=self.console.quit_shuts_down)]

    def action_filter(self) -> None:
        """Type words to look for."""
        field = self.query_one("#filter", Input)
        field.display = True
        field.focus()

    def action_leave(self) -> None:
        """Show everything again; what is shown whole is left for the screen before."""
        field = self.query_one("#filter", Input)
        if not field.display:
            self.console.action_view(self.console.view_before)
            return
        field.value = ""
        field.display = False
        self.query_one("#sheet").focus()
        self.before_drawing()

    def on_input_changed(self) -> None:
        """Look for what is typed so far."""
        self.before_drawing()

    def on_input_submitted(self) -> None:
        """Letters are commands again."""
        self.query_one("#sheet").focus()


def now_section(state: ConsoleState, alarms: AlarmBook) -> Section:
    """The commands that are possible, and the keys that matter."""
    usable = state.usable_commands
    rows = [
        (command.key, f"{command.label}: {command.help}", SKY)
        for command in OPERATOR_COMMANDS
        if command.name in usable or command.name == "Stop"
    ]
    rows += [
        (key.shown, f"{key.label}: {key.help}", SKY)
        for key in KEYS
        if key.view in {"", "operate"} and not key.always and key.matters(state, alarms)
    ]
    where = f"{state.shown} is in {state.mode}" if state.mode else "no data"
    return Section(f"Now: {where if state.live else 'the past is shown'}", rows)


def all_sections(*, quit_shuts_down: bool) -> list[Section]:
    """Every key, every mode, every sign."""
    leave = "quit, and end this demo" if quit_shuts_down else "leave; the instrument keeps running"
    commands = [(c.key, f"{c.label}: {c.help}", SKY) for c in OPERATOR_COMMANDS]
    sections = [
        Section(
            "Commands, on every screen",
            [*commands, *((key, meaning, SKY) for key, meaning in _ALWAYS)],
        ),
        Section("Screens", [(view.key, f"{view.label}: {view.help}", SKY) for view in SCREENS]),
        Section(
            "Everywhere",
            [
                (k.shown, f"{k.label}: {leave if k.keys == 'q' else k.help}", SKY)
                for k in keys_of("")
            ],
        ),
    ]
    for view in SCREENS:
        own = keys_of(view.name)
        if own:
            rows = [(key.shown, f"{key.label}: {key.help}", SKY) for key in own]
            sections.append(Section(f"Screen {view.label}", rows))
    looks = ((MODES[mode.name], mode.name, meaning) for mode, meaning in MEANING.items())
    sections.append(
        Section("Modes", [(f"{look.symbol} {m}", what, look.colour) for look, m, what in looks])
    )
    sections.append(Section("Signs", [(sign, meaning, INK) for sign, meaning in _SIGNS]))
    return sections


def matching(sections: Iterable[Section], words: str) -> list[Section]:
    """The rows that have all of the words, in any order and case; sections without any are left out."""
    wanted = words.lower().split()
    found = [
        section._replace(
            rows=[
                row
                for row in section.rows
                if all(word in f"{row[0]} {row[1]} {section.title}".lower() for word in wanted)
            ]
        )
        for section in sections
    ]
    return [section for section in found if section.rows]


def table(sections: Iterable[Section]) -> Table:
    """The sections under each other."""
    grid = Table.grid(padding=(0, 2))
    for section in sections:
        if grid.row_count:
            grid.add_row()
        grid.add_row(Text(section.title, f"bold {WHITE}"))
        for name, meaning, colour in section.rows:
            grid.add_row(Text(f"  {name}", f"bold {colour}", no_wrap=True), Text(meaning, INK))
    if not grid.row_count:
        grid.add_row(Text("no row has these words; esc shows everything", INK))
    return grid
