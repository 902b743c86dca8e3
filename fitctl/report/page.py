"""From findings to a page: which tables and plots stand where."""

from __future__ import annotations

import json
import re
from typing import NamedTuple

from fitctl.report import frequency, motion, tables, timeline
from fitctl.report.drawing import Plot, TimeAxis, time_axis
from fitctl.report.findings import Findings, LoopFindings, StarFindings
from fitctl.report.fringes import FringeFindings
from fitctl.report.residual import Word
from fitctl.report.selection import TARGET_SETTLE_S
from fitctl.report.tables import Table
from fitctl.simulation.statistics import SETTLE_S

SIGNS: dict[Word, str] = {"met": "✓", "not met": "✗", "not known": "?"}
EVALUATION = (
    f"Judged is VERNIER (LOCKED for a metrology loop), from {SETTLE_S:g} s after it began and "
    f"{TARGET_SETTLE_S:g} s after the target last moved, on frames with a star or samples with a beam. "
    "The error is the measured one: the sensor's noise is in it. The interval "
    "knows that neighbouring frames are alike: so many independent values would leave the RMS as uncertain. "
    "Met: all of both axes' intervals is within the requirement. Not met: all of one is above. Else, or where "
    "the record is too short: not known."
)


class Section(NamedTuple):
    """A part of a page.

    Attributes
    ----------
    title : str
    plots : list of Plot
    tables : list of Table
    text : str
    fold : str
        Long text that is opened on demand.
    """

    title: str
    plots: list[Plot]
    tables: list[Table]
    text: str = ""
    fold: str = ""

    @property
    def anchor(self) -> str:
        """For links."""
        return re.sub(r"\W+", "-", self.title.lower())


def _star(findings: Findings, loop: StarFindings, time: TimeAxis) -> Section:
    plots = [
        timeline.timeline(findings, loop, time),
        timeline.traces(findings, loop, time),
        frequency.spectra(loop),
        frequency.rejection(loop),
        motion.mirror(findings, loop, time),
        motion.siderostat(findings, loop, time),
        frequency.hysteresis(loop),
        motion.timing(findings, loop, time),
    ]
    why = "; ".join(one.why for one in loop.rejections if one.why)
    texts = [f"The design's own figures are not known: {why}."] if why else []
    link = findings.run.rig.stellar_loops[loop.name].link
    if link is not None:
        texts.append(
            f"The star comes over the link that loop {link} holds. The rebuilt disturbance contains what "
            f"{link}'s siderostat turned, and the rejection what the feedforward undid of it."
        )
    measured = [tables.rejected(loop), tables.timings(loop)]
    return Section(f"Loop {loop.name}", plots, measured, " ".join(texts))


def _beam(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Section:
    plots = [
        timeline.timeline(findings, loop, time),
        timeline.beam_traces(findings, loop, time),
        frequency.beam_spectrum(loop, findings.run.rig.camera.period_s),
        motion.timing(findings, loop, time),
    ]
    return Section(f"Loop {loop.name}", plots, [tables.timings(loop)])


def _fringes(findings: Findings, fringes: FringeFindings, time: TimeAxis) -> Section:
    if not len(fringes.overlap["time_s"]):
        text = "No frame with a measured tilt is in the log, so there is nothing to draw."
        return Section("Fringes", [], [], text)
    plots = [motion.tilt(findings, fringes, time), frequency.tilt_spectrum(fringes)]
    return Section("Fringes", plots, [tables.fringes(fringes)])


def sections(findings: Findings) -> list[Section]:
    """All of a run's report. Draws its plots: call it within :func:`fitctl.report.drawing.styled`."""
    run = findings.run
    time = time_axis(run.duration_s, tables.utc(run, form="%H:%M:%S UTC"))
    found: list[Section] = []
    for loop in findings.loops.values():
        if not len(loop.ticks["time_s"]):
            text = "No tick of this loop is in the log, so there is nothing to draw."
            found.append(Section(f"Loop {loop.name}", [], [], text))
            continue
        found.append(
            _star(findings, loop, time)
            if isinstance(loop, StarFindings)
            else _beam(findings, loop, time)
        )
    if findings.fringes is not None:
        found.insert(0, _fringes(findings, findings.fringes, time))
    recorded = [tables.losses(findings), tables.files(run)]
    happened = [tables.modes(findings), tables.events(findings), tables.attempts(findings)]
    rig = run.rig
    designs = {
        loop: json.loads(text).get("parameters")
        for loop, text in run.metadata.get("designs", {}).items()
    }
    return [
        *found,
        Section("Events", [], happened),
        Section("Losses and files", [], recorded),
        Section("Devices", [], [tables.devices(findings)]),
        Section(
            "Configuration and versions",
            [],
            [tables.versions(findings)],
            f"Rig {rig.name}: {rig.description}",
            json.dumps({"rig": rig.model_dump(mode="json"), "designs": designs}, indent=1),
        ),
    ]
