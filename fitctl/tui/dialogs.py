"""What opens over a screen: texts, alarms, questions, one value to type."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, TypeVar

from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from fitctl.text import plain
from fitctl.tui.alarms import AlarmBook, counts
from fitctl.tui.inks import DIM, INK, ORANGE, RED, SKY
from fitctl.tui.jobs import Job
from fitctl.tui.look import Line, as_markup, wall
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import event_lines

ResultT = TypeVar("ResultT")


class Sheet(ModalScreen[ResultT]):
    """A text to scroll through."""

    HINT = "esc closes · s stops"

    def __init__(self, title: str, content: Table | Text) -> None:
        super().__init__()
        self._title = title
        self._content = content

    def compose(self) -> ComposeResult:
        """One scrolling text in a frame."""
        with VerticalScroll() as sheet:
            sheet.border_title = as_markup(self._title)
            sheet.border_subtitle = self.HINT
            yield Static(self._content, id="text")


class Reader(Sheet[None]):
    """A text; any of its closing keys goes back."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,question_mark,e,v,enter", "dismiss", "Close", show=False),
    ]


class Alarms(Sheet[float | None]):
    """Every alarm in full; acknowledges and silences.

    The result is when the chosen alarm began, to show that moment.
    """

    HINT = "↑↓ · enter: 5 s before · k acknowledges · u silences · esc closes"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,v", "dismiss", "Close", show=False),
        Binding("k", "acknowledge", "Acknowledge", show=False),
        Binding("u", "silence", "Silence", show=False),
        Binding("up", "choose(-1)", "Choose", show=False, priority=True),
        Binding("down", "choose(1)", "Choose", show=False, priority=True),
        Binding("enter", "show", "Show", show=False),
    ]

    def __init__(self, state: ConsoleState, book: AlarmBook) -> None:
        super().__init__("Alarms", alarms_text(state, book, 0))
        self._state = state
        self._book = book
        self._chosen = ""  # the key of an alarm; the first, where there is none of this key
        self._shown = counts(book.in_order)

    def on_mount(self) -> None:
        """Keep up with what happens meanwhile."""
        self.set_interval(0.5, self._draw)

    def _draw(self) -> None:
        self._shown = counts(self._book.in_order)
        text = alarms_text(self._state, self._book, self._row())
        self.query_one("#text", Static).update(text)

    def action_choose(self, by: int) -> None:
        """Choose another alarm."""
        alarms = self._book.in_order
        if alarms:
            self._chosen = alarms[max(0, min(self._row() + by, len(alarms) - 1))].key
        self._draw()

    def _row(self) -> int:
        keys = [alarm.key for alarm in self._book.in_order]
        return keys.index(self._chosen) if self._chosen in keys else 0

    def action_show(self) -> None:
        """Show the console as it was before the chosen alarm."""
        alarms = self._book.in_order
        self.dismiss(alarms[self._row()].since_s if alarms else None)

    def action_acknowledge(self) -> None:
        """Acknowledge all that the list shows."""
        if self._state.live:
            self._book.acknowledge(self._shown)
            self._draw()

    def action_silence(self) -> None:
        """No bell for these."""
        if self._state.live:
            self._book.silence()
            self._draw()


class Running(Sheet[None]):
    """The output of another fitctl command, while it runs and afterwards. Closing ends the command."""

    HINT = "esc closes and ends the command · s stops the instrument"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,enter", "dismiss", "Close", show=False),
    ]

    def __init__(self, title: str, job: Job) -> None:
        super().__init__(title, Text("running", DIM))
        self._job = job

    def on_mount(self) -> None:
        """Keep up with it."""
        self.set_interval(0.2, self._draw)
        self._draw()

    def on_unmount(self) -> None:
        """Leave no child behind."""
        self._job.end()

    def _draw(self) -> None:
        printed = "\n".join(map(plain, self._job.text().splitlines()))
        state = "\n◌ running" if self._job.status is None else ""
        self.query_one("#text", Static).update(Text(f"{printed}{state}", INK))


class Confirm(ModalScreen[bool]):
    """A question with yes and no; anything but yes is no."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("y", "dismiss(True)", "Yes", show=False),
        Binding("n,escape,q", "dismiss(False)", "No", show=False),
    ]

    def __init__(self, title: str, question: str) -> None:
        super().__init__()
        self._title = title
        self._question = question

    def compose(self) -> ComposeResult:
        """The question, and what can be answered, for keyboard and mouse."""
        with Vertical(classes="sheet") as sheet:
            sheet.border_title = as_markup(self._title)
            sheet.border_subtitle = "s stops"
            yield Static(self._question, markup=False)
            yield Static(
                "\n[@click=screen.dismiss(True)][bold reverse] y [/] yes[/]     "
                "[@click=screen.dismiss(False)][bold reverse] n [/] no[/]"
            )


class Ask(ModalScreen[str | None]):
    """One value to type; it stays open until `refused` says nothing against it, or escape is pressed.

    Parameters
    ----------
    title, prompt : str
        What it is about.
    value : str
        To begin with.
    refused : callable
        Why a value cannot be; empty if it can.
    """

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape", "dismiss(None)", "Leave", show=False),
    ]

    def __init__(
        self, title: str, prompt: str, value: str, refused: Callable[[str], str] = lambda _: ""
    ) -> None:
        super().__init__()
        self._title = title
        self._prompt = prompt
        self._value = value
        self._refused = refused

    def compose(self) -> ComposeResult:
        """The field, and what is wrong with it."""
        with Vertical(classes="sheet") as sheet:
            sheet.border_title = as_markup(self._title)
            sheet.border_subtitle = "enter accepts · esc cancels · ^s stops"
            yield Static(Text(self._prompt, DIM))
            yield Input(self._value, id="value")
            yield Static("", id="refused")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Accept the input, or show why it is not accepted."""
        why_not = self._refused(event.value)
        if why_not:
            self.query_one("#refused", Static).update(Text(f"✗ {why_not}", RED))
        else:
            self.dismiss(event.value)


def events_text(state: ConsoleState, columns: int) -> Text:
    """All events that are remembered, newest first, wrapped to a width."""
    lines = [
        line
        for event in state.events
        for line in event_lines(event, state.wall_s(event.time_s), columns, state.loops)
    ]
    return Text("\n").join(map(as_text, lines)) if lines else Text("no events yet", DIM)


def alarms_text(state: ConsoleState, book: AlarmBook, chosen: int = -1) -> Text:
    """Every alarm: what, since when, what was done, what to do; the chosen one is marked."""
    if not book.alarms:
        return Text("all is well: no alarm", DIM)
    text = Text()
    for row, alarm in enumerate(book.in_order):
        colour = RED if alarm.error else ORANGE
        mark = "▸ " if row == chosen and len(book.alarms) > 1 else ""
        text.append(f"{mark}{'✗' if alarm.error else '▲'} {alarm.what}\n", f"bold {colour}")
        since = wall(state.wall_s(alarm.since_s))
        over = f", over {wall(state.wall_s(alarm.over_s))}" if alarm.over_s else ""
        known = "acknowledged" if alarm.acknowledged else "not acknowledged"
        bell = ", silenced" if alarm.silenced else ""
        for name, words, ink in (
            ("since", f"{since}{over}; {known}{bell}", INK),
            ("done", alarm.did, INK),
            ("to do", alarm.todo, SKY),
        ):
            text.append(f"  {name:<6}", DIM)
            text.append(f"{words}\n", ink)
    return text


def as_text(line: Line) -> Text:
    """A drawn line for Rich."""
    return Text.assemble(*((segment.text, segment.style or "") for segment in line))
