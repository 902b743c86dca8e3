"""What opens over a screen: texts, alarms, questions, one value to type."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from rich.markup import escape
from rich.table import Table
from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Vertical, VerticalScroll
from textual.screen import ModalScreen
from textual.widgets import Input, Static

from fitctl.tui.alarms import AlarmBook
from fitctl.tui.look import DIM, INK, ORANGE, RED, SKY, Line, wall
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import event_lines


class Reader(ModalScreen[None]):
    """A text to scroll through; any of its closing keys goes back."""

    HINT = "esc closes · s stops"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,question_mark,e,v,enter", "dismiss", "Close", show=False),
    ]

    def __init__(self, title: str, content: Table | Text) -> None:
        super().__init__()
        self._title = title
        self._content = content

    def compose(self) -> ComposeResult:
        """One scrolling text in a frame."""
        with VerticalScroll() as sheet:
            sheet.border_title = escape(self._title)
            sheet.border_subtitle = self.HINT
            yield Static(self._content, id="text")


class Alarms(Reader):
    """Every alarm in full; acknowledges and silences."""

    HINT = "k acknowledges · u silences · esc closes · s stops"
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,q,v,enter", "dismiss", "Close", show=False),
        Binding("k", "acknowledge", "Acknowledge", show=False),
        Binding("u", "silence", "Silence", show=False),
    ]

    def __init__(self, state: ConsoleState, book: AlarmBook) -> None:
        super().__init__("Alarms", alarms_text(state, book))
        self._state = state
        self._book = book

    def on_mount(self) -> None:
        """Keep up with what happens meanwhile."""
        self.set_interval(0.5, self._show)

    def _show(self) -> None:
        self.query_one("#text", Static).update(alarms_text(self._state, self._book))

    def action_acknowledge(self) -> None:
        """Acknowledge all of them."""
        self._book.acknowledge()
        self._show()

    def action_silence(self) -> None:
        """No bell for these."""
        self._book.silence()
        self._show()


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
            sheet.border_title = escape(self._title)
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
            sheet.border_title = escape(self._title)
            sheet.border_subtitle = "enter takes it · esc leaves · ^s stops"
            yield Static(Text(self._prompt, DIM))
            yield Input(self._value, id="value")
            yield Static("", id="refused")

    def on_input_submitted(self, event: Input.Submitted) -> None:
        """Accept it, or say why not."""
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
        for line in event_lines(event, state.wall_s(event.time_s), columns)
    ]
    return Text("\n").join(map(as_text, lines)) if lines else Text("no events yet", DIM)


def alarms_text(state: ConsoleState, book: AlarmBook) -> Text:
    """Every alarm: what, since when, what was done, what to do."""
    if not book.alarms:
        return Text("all is well: no alarm", DIM)
    text = Text()
    for alarm in book.in_order:
        colour = RED if alarm.error else ORANGE
        text.append(f"{'✗' if alarm.error else '▲'} {alarm.what}\n", f"bold {colour}")
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
