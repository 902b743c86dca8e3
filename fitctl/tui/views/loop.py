"""Loop: where the error comes from, its spectrum, how the tick spends its time, and the design's margins."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from textual.app import ComposeResult
from textual.binding import BindingType

from fitctl.config import is_name
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
NO_DESIGN = "The console cannot evaluate the design that the supervisor names."
FILE_ELSEWHERE = "A saved file on the rig's machine: its margins are not known here."
LONGEST_PARAMETERS = 50_000
"""Characters; those of a design with one line are about 500. Linux accepts arguments of up to 131071 bytes."""


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
        if wanted == self._asked or not wanted.design or self._why_unknown(loop.state):
            return
        options = ["--json", "--loop", wanted.loop, *rig_arguments]
        if wanted.noise_px is not None:
            flux_dn = loop.past.since(-math.inf, "star_flux_dn")
            flux_dn = flux_dn[np.isfinite(flux_dn)]
            if not len(flux_dn):
                return  # until the star is seen
            options += ["--set", f"loops.{wanted.loop}.star_flux_dn={np.median(flux_dn):.6g}"]
        self._asked = wanted
        self._job = self.console.start_job(["design", *options, "--", wanted.design])

    def _why_unknown(self, loop: LoopState) -> str:
        if self.console.rig_arguments is None:
            return NEEDS_RIG
        design = loop.design
        learnt = design.startswith("{")
        if loop.controller_file and not learnt:
            return FILE_ELSEWHERE if self.console.remote_arguments else ""
        usable = len(design) <= LONGEST_PARAMETERS if learnt else is_name(design)
        return "" if usable or not design else NO_DESIGN

    def on_unmount(self) -> None:
        """Leave no child behind."""
        if self._job is not None:
            self._job.end()
