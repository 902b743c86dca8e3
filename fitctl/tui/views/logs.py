"""Logs: which there are, which are kept, what is in them, and what is made of them."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.logging.errors import LogError
from fitctl.logging.folder import keep
from fitctl.tui.commands import keys_of
from fitctl.tui.views.view import View
from fitctl.tui.widgets.loglist import LogList, Summaries
from fitctl.tui.widgets.printed import Printed

TOOLS = {
    "info": ["log", "info"],
    "verify": ["log", "verify"],
    "report": ["report"],
    "replay": ["replay"],
}
HINT = (
    "Choose a log. enter shows what it holds, f verifies it, m keeps it, t reports on it, y replays it. "
    "To see every screen as it was, run from a shell: fitctl console --log FILE"
)


class LogsView(View):
    """The list, and what the last command printed. Nothing here deletes."""

    view_name = "logs"
    BINDINGS: ClassVar[list[BindingType]] = [key.binding() for key in keys_of("logs") if key.action]

    def __init__(self) -> None:
        super().__init__()
        self._summaries = Summaries()

    def parts(self) -> ComposeResult:
        """Two panels."""
        yield LogList(self.state, "Logs", self.console.log_folder, self._summaries.of)
        yield Printed(self.state, "Printed", HINT)

    def before_drawing(self) -> None:
        """Have the logs read that are not known yet."""
        for logs in self.query(LogList):  # there is none before the screen is composed
            self._summaries.ask(self.console.start_job, logs.logs, logs.current)

    def on_unmount(self) -> None:
        """Leave no child behind."""
        self._summaries.end()

    def action_tool(self, name: str) -> None:
        """Run a fitctl command on the chosen log."""
        log = self.query_one(LogList).chosen_log
        if log is None:
            self.notify("there is no log yet", timeout=3)
        else:
            self.query_one(Printed).start(self.console.start_job, *TOOLS[name], str(log.path))

    def action_keep(self) -> None:
        """Mark the chosen log, so that it is never deleted, or take the mark away."""
        logs = self.query_one(LogList)
        if logs.chosen_log is None:
            return
        try:
            keep(logs.chosen_log.path, kept=not logs.chosen_log.kept)
        except LogError as error:
            self.notify(str(error), severity="error", timeout=8, markup=False)
        logs.look()
        self.console.draw_all()
