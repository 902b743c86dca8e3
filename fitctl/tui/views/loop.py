"""Loop: how the tick spends its time, what is left of the error by frequency, and how the design stands."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.tui.commands import keys_of
from fitctl.tui.jobs import Job
from fitctl.tui.views.view import View
from fitctl.tui.widgets.margins import Margins
from fitctl.tui.widgets.spectrum import Spectrum
from fitctl.tui.widgets.timing import Breakdown, Histograms


class LoopScreen(View):
    """Spectrum and histograms above, breakdown and margins below."""

    view_name = "loop"
    BINDINGS: ClassVar[list[BindingType]] = [key.binding() for key in keys_of("loop")]

    def __init__(self) -> None:
        super().__init__()
        self._job: Job | None = None
        self._asked = ("", "")

    def parts(self) -> ComposeResult:
        """Four panels."""
        yield Spectrum(self.state, "Spectrum of the pointing error")
        yield Histograms(self.state, "Timing")
        yield Breakdown(self.state, "The tick")
        yield Margins(self.state, "Design")

    def before_drawing(self) -> None:
        """Have the design at work judged by `fitctl design`, once for each design."""
        loop, job = self.state.loop, self._job
        if job is not None and job.status is not None:
            self.query_one(Margins).told(self._asked[1], job.text(), job.status)
            job.end()
            self._job = None
        if loop is None or self._job is not None:
            return
        wanted = (loop.state.name, loop.state.controller)
        if wanted != self._asked and wanted[1]:
            self._asked = wanted
            options = ["--json", "--loop", wanted[0], *self.console.rig_arguments]
            self._job = self.console.start_job(["design", wanted[1], *options])

    def on_unmount(self) -> None:
        """Leave no child behind."""
        if self._job is not None:
            self._job.end()
