"""What another fitctl command has printed."""

from __future__ import annotations

import textwrap
from collections.abc import Callable
from typing import ClassVar

from fitctl.tui.inks import DIM, GREEN, INK, RED, SKY
from fitctl.tui.jobs import Job
from fitctl.tui.look import Line, shorten, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.panel import Panel

MOST_LINES = 400


class Printed(Panel):
    """The newest command, how it goes, and the end of what it printed.

    Attributes
    ----------
    job : Job or None
        Ended with the panel, unless it outlives the console.
    """

    every: ClassVar[int] = 3

    def __init__(self, state: ConsoleState, title: str, hint: str) -> None:
        super().__init__(state, title)
        self._hint = hint
        self.job: Job | None = None

    def on_unmount(self) -> None:
        """Leave no child behind."""
        if self.job is not None:
            self.job.end()

    def start(self, start_job: Callable[..., Job], *arguments: str, **options: bool) -> None:
        """Run another fitctl command in place of the one before, unless that moves the stages still.

        `options` are those of :class:`~fitctl.tui.jobs.Job`.
        """
        moving = self.moving
        if moving is not None:
            self.notify(
                f"still running: {moving.command_line}", severity="warning", timeout=4, markup=False
            )
        else:
            self.show(start_job(arguments, **options))

    @property
    def moving(self) -> Job | None:
        """The command, while it runs and moves the stages."""
        job = self.job
        return job if job is not None and job.moves and job.status is None else None

    def show(self, job: Job) -> None:
        """Let a command take the place of the one before, which is ended."""
        if self.job is not None:
            self.job.end()
        self.job = job
        self.redraw()

    def draw(self, columns: int, rows: int) -> list[Line]:
        """The command and its state, then its last lines."""
        job = self.job
        if job is None:
            return [[text(line, DIM)] for line in textwrap.wrap(self._hint, max(10, columns))]
        sign, colour, state = _how_it_went(job.status)
        head = [
            text(f"{sign} ", colour, bold=True),
            text(shorten(job.command_line, columns - len(state) - 4), INK, bold=True),
            text(f"  {state}", colour),
        ]
        lines = [
            piece
            for line in job.text().splitlines()[-MOST_LINES:]
            for piece in textwrap.wrap(line, max(10, columns), subsequent_indent="  ", tabsize=4)
            or [""]
        ]
        return [head, *([text(line, INK)] for line in lines[-max(0, rows - 1) :])][:rows]


def _how_it_went(status: int | None) -> tuple[str, str, str]:
    if status is None:
        return "◌", SKY, "running"
    return ("✓", GREEN, "done") if status == 0 else ("✗", RED, f"status {status}")
