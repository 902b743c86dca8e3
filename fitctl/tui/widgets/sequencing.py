"""The Sequences screen's lists: sequences, and the parameters of the steps of one."""

from __future__ import annotations

from typing import Any, NamedTuple

from fitctl.tui.look import (
    DIM,
    INK,
    ORANGE,
    SKY,
    WHITE,
    YELLOW,
    Line,
    bar,
    number,
    shorten,
    text,
    width,
)
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.choice import Choice
from fitctl.tui.widgets.panel import Panel

NAME_COLUMNS = 14
_SIGNS = {"running": "▶", "paused": "⏸", "done": "✓", "failed": "✗", "stopped": "■"}


class SequenceList(Choice):
    """A sequence a row."""

    def __init__(self, state: ConsoleState, title: str) -> None:
        super().__init__(state, title)
        self.documents: list[dict[str, Any]] = []
        self.edited: set[str] = set()

    @property
    def document(self) -> dict[str, Any] | None:
        """The chosen one."""
        return self.documents[self.chosen] if self.chosen < len(self.documents) else None

    def rows(self, columns: int) -> list[Line]:
        """Name, whether it was edited, what it is."""
        lines: list[Line] = []
        for document in self.documents:
            edited = document["file"] in self.edited
            name = document["name"] + ("*" if edited else "")
            line = [text(f"{name:<{NAME_COLUMNS}}", ORANGE if edited else WHITE, bold=True)]
            room = columns - width(line)
            lines.append([*line, text(shorten(document["description"], room), DIM)])
        return lines or [[text("reading the sequences", DIM)]]


class Parameter(NamedTuple):
    """One key of one step; a step's own row has no key."""

    step: int
    key: str
    value: Any


class Parameters(Choice):
    """Every key of every step of the chosen sequence."""

    def __init__(self, state: ConsoleState, title: str, sequences: SequenceList) -> None:
        super().__init__(state, title)
        self._sequences = sequences

    def parameters(self) -> list[Parameter]:
        """In the order of the file."""
        document = self._sequences.document
        rows: list[Parameter] = []
        for number_, step in enumerate(document["steps"] if document else []):
            rows.append(Parameter(number_, "", step["step"]))
            rows += [Parameter(number_, key, step[key]) for key in step if key != "step"]
        return rows

    def now(self) -> Parameter | None:
        """The chosen row, if it is a parameter."""
        rows = self.parameters()
        row = rows[self.chosen] if self.chosen < len(rows) else None
        return row if row and row.key else None

    def rows(self, columns: int) -> list[Line]:
        """Steps with their parameters under them."""
        lines: list[Line] = []
        for row in self.parameters():
            if row.key:
                value = row.value if row.value != "" else "the only loop"
                lines.append(
                    [text(f"   {row.key:<{24}}", DIM), text(shorten(str(value), columns - 28), INK)]
                )
            else:
                lines.append([text(f"{row.step + 1} {row.value}", SKY, bold=True)])
        return lines


class Progress(Panel):
    """The sequence that is under way on the instrument, wherever it was started."""

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Its state, its step as a bar, what it said last."""
        newest = self.state.newest
        status = newest.running_sequence if newest else None
        if status is None:
            return [[text("no sequence is under way on the instrument", DIM)]]
        asked = "" if status.wanted == "run" else f"; asked to {status.wanted}"
        part = status.step_number / max(1, status.steps)
        again = f", attempt {status.attempt}" if status.attempt > 1 else ""
        last = status.last_attempt
        outcome = "" if last is None else f"{last.step}: {last.outcome} {last.message}"
        head = f"{_SIGNS[status.state]} {status.name} {status.state}{asked}"
        return [
            [
                text(f"{head}  ", YELLOW, bold=True),
                text(f"step {number(status.step_number, 'd')}/{status.steps} ", INK),
                text(f"{status.step}{again}  ", SKY),
                *bar(part, max(4, min(30, columns - len(head) - 32)), SKY),
            ],
            [text(shorten(status.message or outcome, columns), DIM)],
        ]
