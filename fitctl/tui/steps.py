"""The Commissioning screen's lists: the steps with what came of them, and one of them in full."""

from __future__ import annotations

import textwrap
from typing import Any, ClassVar

from fitctl.tui.inks import DIM, GREEN, INK, ORANGE, RED, SKY, WHITE
from fitctl.tui.look import Line, Look, duration, shorten, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.choice import Choice
from fitctl.tui.widgets.panel import Panel

_STATES = {
    "passed": Look("✓", GREEN),
    "corrected": Look("✓", SKY),
    "measured": Look("✓", SKY),
    "failed": Look("✗", RED),
    "skipped": Look("▲", ORANGE),
    "to do": Look("·", DIM),
}
_NEXT, _RUNNING = Look("▸", WHITE), Look("◌", WHITE)
_STATE_COLUMNS = 10


class StepList(Choice):
    """A step a row: its state, how long it takes or took, and what it proves.

    Attributes
    ----------
    listed : dict
        What ``fitctl commission --list --json`` printed; empty before.
    running : str
        The step that is running now.
    """

    def __init__(self, state: ConsoleState, title: str) -> None:
        super().__init__(state, title)
        self.listed: dict[str, Any] = {}
        self.running = ""

    @property
    def steps(self) -> list[dict[str, Any]]:
        """All steps, in their order."""
        return list(self.listed.get("tasks", ()))

    @property
    def step(self) -> dict[str, Any] | None:
        """The chosen one."""
        return self.steps[self.chosen] if self.chosen < len(self.steps) else None

    @property
    def next_name(self) -> str:
        """The first step that is not done; empty where all are."""
        return next((step["name"] for step in self.steps if not step["done"]), "")

    def choose(self, name: str) -> None:
        """Choose a step by its name."""
        names = [step["name"] for step in self.steps]
        if name in names:
            self.chosen = names.index(name)

    def head(self, columns: int) -> list[Line]:
        """What the record comes to."""
        verdict = self.listed.get("verdict", "")
        colour = GREEN if verdict == "commissioned" else WHITE
        return [[text(line, colour, bold=True)] for line in textwrap.wrap(verdict, columns)]

    def rows(self, columns: int) -> list[Line]:
        """Sign, name, state, seconds, title."""
        lines: list[Line] = []
        names = max((len(step["name"]) for step in self.steps), default=0)
        for step in self.steps:
            entry = step["entry"]
            state = "to do" if entry is None else entry["state"]
            look = _STATES[state]
            if step["name"] == self.running:
                look, state = _RUNNING, "running"
            elif step["name"] == self.next_name and entry is None:
                look, state = _NEXT, "next"
            lasts = f"~{step['takes_s']:.0f} s" if entry is None else f"{entry['took_s']:.0f} s"
            line = [
                text(f"{look.symbol} ", look.colour, bold=True),
                text(f"{step['name']:<{names}} ", WHITE, bold=True),
                text(f"{state:<{_STATE_COLUMNS}}", look.colour),
                text(f"{lasts:>6}  ", INK),
            ]
            title = shorten(step["title"], max(0, columns - width(line)))
            lines.append([*line, text(title, DIM)])
        return lines or [[text("reading the record", DIM)]]


class StepFacts(Panel):
    """All about the chosen step: what it moves, what it needs, what came of it."""

    every: ClassVar[int] = 5

    def __init__(self, state: ConsoleState, title: str, steps: StepList) -> None:
        super().__init__(state, title)
        self._steps = steps

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The words of `fitctl commission --list`, in colours."""
        step = self._steps.step
        if step is None:
            return []
        lines = _wrapped(f"{step['name']}: {step['title']}", WHITE, columns)
        lines += _wrapped(f"moves {step['moves']}", SKY, columns)
        lines += _wrapped(f"takes about {duration(step['takes_s'])} on mocks", DIM, columns)
        if step["missing"]:
            lines += _wrapped(f"needs {', '.join(step['missing'])} first", ORANGE, columns)
        entry = step["entry"]
        if entry is None:
            return lines
        look = _STATES[entry["state"]]
        when = entry["at"].replace("T", " ").replace("Z", " UTC")
        again = f", done {entry['tries']} times" if entry["tries"] > 1 else ""
        lines += _wrapped(f"{look.symbol} {entry['state']} {when}{again}", look.colour, columns)
        for line in entry["lines"]:
            lines += _wrapped(line, INK, columns)
        for key, value in _flat(entry["found"]).items():
            lines += _wrapped(f"rig file: {key} = {value}", SKY, columns)
        return lines + _wrapped(entry["trouble"], look.colour, columns)


def _flat(table: dict[str, Any], under: str = "") -> dict[str, Any]:
    flat: dict[str, Any] = {}
    for key, value in table.items():
        flat |= _flat(value, f"{under}{key}.") if isinstance(value, dict) else {under + key: value}
    return flat


def _wrapped(words: str, colour: str, columns: int) -> list[Line]:
    pieces = textwrap.wrap(words, max(10, columns), subsequent_indent="  ")
    return [[text(piece, colour)] for piece in pieces]
