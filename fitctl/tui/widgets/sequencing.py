"""The Sequences screen's lists: sequences, and the parameters of the steps of one."""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any, NamedTuple

from fitctl.messages.commands import SequenceStatus
from fitctl.tui.inks import DIM, INK, SKY, WHITE, YELLOW
from fitctl.tui.jobs import Job
from fitctl.tui.look import Line, bar, duration, number, shorten, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.choice import Choice
from fitctl.tui.widgets.panel import Panel

NAME_COLUMNS = 14
CHOSEN_S = 2.0  # a sequence that is passed over in the list is not run dry
LONGEST_DRY_RUN_S = 60.0
MOST_ESTIMATES = 200
_SIGNS = {"running": "▶", "paused": "⏸", "done": "✓", "failed": "✗", "stopped": "■"}


class Estimates:
    """How long the steps of sequences last, from dry runs by a process of its own, one at a time."""

    def __init__(self) -> None:
        self._known: dict[str, list[float] | None] = {}
        self._job: Job | None = None
        self._asked = ""
        self._since_s = 0.0

    def of(self, document: dict[str, Any]) -> list[float] | None:
        """Seconds of each step; None while they are not known, or cannot be."""
        return self._known.get(_content(document))

    def ask(
        self,
        start_job: Callable[..., Job],
        document: dict[str, Any],
        arguments: list[str],
        now_s: float,
    ) -> None:
        """Collect a dry run that has ended, give up one that takes too long, and start this one's.

        A sequence is run dry once it was chosen for `CHOSEN_S`.
        """
        job, content = self._job, _content(document)
        if job is not None:
            if job.status is not None:
                self._known[self._asked] = _step_durations_s(job.text())
                self.end()
            elif now_s - self._since_s > LONGEST_DRY_RUN_S:
                self._known[self._asked] = None
                self.end()
            return
        if content in self._known:
            return
        if content != self._asked:
            self._asked, self._since_s = content, now_s
        elif now_s - self._since_s >= CHOSEN_S:
            while len(self._known) >= MOST_ESTIMATES:
                del self._known[next(iter(self._known))]
            self._since_s = now_s
            self._job = start_job(["sequence", "dry-run", "--json", *arguments])

    def end(self) -> None:
        """Leave no child behind."""
        if self._job is not None:
            self._job.end()
            self._job = None


def _content(document: dict[str, Any]) -> str:
    return json.dumps(document["steps"], sort_keys=True, default=str)


def _step_durations_s(printed: str) -> list[float] | None:
    """Of each step, from the JSON object that a dry run prints."""
    try:
        result, _ = json.JSONDecoder().raw_decode(printed, printed.index("{"))
        if result["failure"]:
            return None
        spans: dict[int, list[float]] = {}
        for attempt in result["attempts"]:
            spans.setdefault(attempt["step_number"], []).extend(
                (attempt["began_s"], attempt["ended_s"])
            )
        return [max(span) - min(span) for _, span in sorted(spans.items())]
    except (ValueError, KeyError, TypeError):
        return None


class SequenceList(Choice):
    """A sequence a row."""

    def __init__(
        self,
        state: ConsoleState,
        title: str,
        durations_of: Callable[[dict[str, Any]], list[float] | None] = lambda _: None,
    ) -> None:
        super().__init__(state, title)
        self.documents: list[dict[str, Any]] = []
        self.edited: set[str] = set()
        self.durations_of = durations_of

    @property
    def document(self) -> dict[str, Any] | None:
        """The chosen one."""
        return self.documents[self.chosen] if self.chosen < len(self.documents) else None

    def head(self, columns: int) -> list[Line]:
        """Names of the columns."""
        return [[text(f"{'name':<{NAME_COLUMNS}}{'steps':>5}{'lasts':>8}", DIM)]]

    def rows(self, columns: int) -> list[Line]:
        """Name, whether it was edited, how many steps, how long by a dry run, what it is."""
        lines: list[Line] = []
        for document in self.documents:
            edited = document["file"] in self.edited
            name = document["name"] + ("*" if edited else "")
            steps_s = self.durations_of(document)
            lasts = "" if steps_s is None else duration(sum(steps_s))
            line = [
                text(f"{name:<{NAME_COLUMNS}}", YELLOW if edited else WHITE, bold=True),
                text(f"{len(document['steps']):>5}{lasts:>8}  ", INK),
            ]
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
        document = self._sequences.document
        steps_s = (self._sequences.durations_of(document) if document else None) or []
        for row in self.parameters():
            if row.key:
                value = "the only loop" if (row.key, row.value) == ("loop", "") else row.value
                lines.append(
                    [text(f"   {row.key:<26}", DIM), text(shorten(str(value), columns - 30), INK)]
                )
            else:
                lasts = f"  {steps_s[row.step]:.0f} s" if row.step < len(steps_s) else ""
                head = [text(f"{row.step + 1} {row.value}", SKY, bold=True), text(lasts, DIM)]
                lines.append(head)
        return lines


class Progress(Panel):
    """The sequence that is under way on the instrument, wherever it was started."""

    def __init__(
        self, state: ConsoleState, title: str = "", sequences: SequenceList | None = None
    ) -> None:
        super().__init__(state, title)
        self._sequences = sequences or SequenceList(state, "")
        self._step: tuple[str, int] = ("", 0)
        self._step_since_s = 0.0

    def document(self) -> dict[str, Any] | None:
        """The sequence under way, if it is one of the list."""
        newest = self.state.newest
        status = newest.running_sequence if newest else None
        known = self._sequences.documents if status else []
        return next((each for each in known if status and each["name"] == status.name), None)

    def draw(self, columns: int, rows: int) -> list[Line]:
        """Its state, its step as a bar, the time to go, what it reported last."""
        newest = self.state.newest
        status = newest.running_sequence if newest else None
        if newest is None or status is None:
            return [[text("no sequence is running on the instrument", DIM)]]
        asked = "" if status.wanted == "run" else f"; asked to {status.wanted}"
        part = status.step_number / max(1, status.steps)
        again = f", attempt {status.attempt}" if status.attempt > 1 else ""
        last = status.last_attempt
        outcome = "" if last is None else f"{last.step}: {last.outcome} {last.message}"
        head = f"{_SIGNS[status.state]} {status.name} {status.state}{asked}"
        to_go = self._to_go(status, newest.time_s)
        return [
            [
                text(f"{head}  ", YELLOW, bold=True),
                text(f"step {number(status.step_number, 'd')}/{status.steps} ", INK),
                text(f"{status.step}{again}  ", SKY),
                *([text(f"{to_go} to go  ", WHITE, bold=True)] if to_go else []),
                *bar(part, max(4, min(30, columns - len(head) - len(to_go) - 40)), SKY),
            ],
            [text(shorten(status.message or outcome, columns), DIM)],
        ]

    def _to_go(self, status: SequenceStatus, now_s: float) -> str:
        """How long by a dry run of the sequence, as listed here; empty where that is not known."""
        step = (status.run, status.step_number)
        if step != self._step:
            self._step, self._step_since_s = step, now_s
            if status.last_attempt is not None:  # the step began when the one before ended
                self._step_since_s = min(now_s, status.last_attempt.ended_s)
        document = self.document()
        steps_s = self._sequences.durations_of(document) if document else None
        if steps_s is None or status.state not in {"running", "paused"}:
            return ""
        index = max(0, status.step_number - 1)
        present_s = sum(steps_s[index : index + 1]) - (now_s - self._step_since_s)
        return duration(max(0.0, present_s) + sum(steps_s[index + 1 :]))
