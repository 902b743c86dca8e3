"""Loop: where the error comes from, its spectrum, how the tick spends its time, and the design's margins."""

from __future__ import annotations

from typing import ClassVar

from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.messages.telemetry import LoopState
from fitctl.tui.commands import keys_of
from fitctl.tui.jobs import Job
from fitctl.tui.views.view import View
from fitctl.tui.widgets.margins import DesignFigures, DesignInUse, Margins, design_in_use
from fitctl.tui.widgets.spectrum import ErrorBudget, Spectrum
from fitctl.tui.widgets.timing import Breakdown, Histograms

NEEDS_RIG = (
    "The console computes margins from the rig file and does not have it here. Start the console again with "
    "--rig FILE."
)
LEARNT_HERE = (
    "A learnt design has a sensitivity of at most 2, and margins of at least 6 dB and 35°."
)
FOR_THE_LIGHT = (
    "Made for the star's measured light, {:.4f} px of noise: its margins are not known here."
)
FILE_ELSEWHERE = "A saved file on the rig's machine: its margins are not known here."


class LoopScreen(View):
    """The error budget above; below it spectrum and histograms, breakdown and margins."""

    view_name = "loop"
    BINDINGS: ClassVar[list[BindingType]] = [key.binding() for key in keys_of("loop")]

    def __init__(self) -> None:
        super().__init__()
        self._job: Job | None = None
        self._asked = DesignInUse("", "")
        self._evaluated = DesignFigures()

    def parts(self) -> ComposeResult:
        """Five panels."""
        yield ErrorBudget(self.state, "Where the error comes from", self._evaluated)
        yield Spectrum(self.state, "Spectrum of the pointing error", self._evaluated)
        yield Histograms(self.state, "Timing")
        yield Breakdown(self.state, "The tick")
        yield Margins(self.state, "Design", self._evaluated, self._why_unknown)

    def before_drawing(self) -> None:
        """Have `fitctl design` evaluate the design in use, once for each design."""
        loop, job = self.state.loop, self._job
        if job is not None and job.status is not None:
            self._evaluated.accept(self._asked, job.text(), job.status)
            job.end()
            self._job = None
        rig_arguments = self.console.rig_arguments
        if loop is None or rig_arguments is None or self._job is not None:
            return
        wanted = design_in_use(loop.state)
        if wanted != self._asked and wanted.design and not self._why_unknown(loop.state):
            self._asked = wanted
            options = ["--json", "--loop", wanted.loop, *rig_arguments]
            self._job = self.console.start_job(["design", wanted.design, *options])

    def _why_unknown(self, loop: LoopState) -> str:
        if loop.learning is not None and loop.learning.design_json:
            return LEARNT_HERE
        if loop.controller_file and self.console.remote_arguments:
            return FILE_ELSEWHERE
        if loop.noise_px is not None:
            return FOR_THE_LIGHT.format(loop.noise_px)
        return NEEDS_RIG if self.console.rig_arguments is None else ""

    def on_unmount(self) -> None:
        """Leave no child behind."""
        if self._job is not None:
            self._job.end()
