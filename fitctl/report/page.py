"""From findings to a page: which tables and plots stand where."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from typing import NamedTuple

from fitctl.logging.schemas import designs_of
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
    f"Evaluated: VERNIER (LOCKED for a metrology loop), from {SETTLE_S:g} s after it began and "
    f"{TARGET_SETTLE_S:g} s after the target last moved, on frames with a star or samples with a beam. "
    "The error is measured, so it includes the sensor's noise. The interval allows for the correlation of "
    "neighbouring frames, by the number of independent values. Met: the intervals of both axes are within "
    "the requirement. Not met: the whole interval of one axis is above it. Otherwise, or if the record is too "
    "short: not known."
)


_LINE_COLUMNS = 100


class Section(NamedTuple):
    """A part of a page.

    Attributes
    ----------
    title : str
    plots : list of Plot
    tables : list of Table
        After the plots.
    lead : list of Table
        Before them.
    text : str
    fold : str
        Long text that is opened on demand.
    """

    title: str
    plots: list[Plot]
    tables: list[Table]
    lead: Sequence[Table] = ()
    text: str = ""
    fold: str = ""

    @property
    def anchor(self) -> str:
        """For links."""
        return re.sub(r"\W+", "-", self.title.lower())


def _star(findings: Findings, loop: StarFindings, time: TimeAxis) -> Section:
    plots = [
        *_own_timeline(findings, loop, time),
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
    lead = [
        tables.residual(loop),
        tables.by_controller(loop),
        tables.error_budget(loop),
        tables.key_figures(loop),
    ]
    return Section(f"Loop {loop.name}", plots, measured, lead, " ".join(texts))


def _beam(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Section:
    plots = [
        *_own_timeline(findings, loop, time),
        timeline.beam_traces(findings, loop, time),
        frequency.beam_spectrum(loop, findings.run.rig.camera.period_s),
        motion.timing(findings, loop, time),
    ]
    lead = [tables.residual(loop), tables.key_figures(loop)]
    return Section(f"Loop {loop.name}", plots, [tables.timings(loop)], lead)


def _own_timeline(findings: Findings, loop: LoopFindings, time: TimeAxis) -> list[Plot]:
    """A loop's own timeline; a run's only loop has it on the first screen."""
    return [timeline.timeline(findings, loop, time)] if len(findings.loops) > 1 else []


def first_plot(findings: Findings) -> Plot | None:
    """The timeline of the whole run, for the first screen; None for a run without ticks."""
    loops = [loop for loop in findings.loops.values() if len(loop.ticks["time_s"])]
    if not loops:
        return None
    time = time_axis(findings.run.duration_s, tables.utc(findings.run, form="%H:%M:%S UTC"))
    if len(findings.loops) == 1:
        return timeline.timeline(findings, loops[0], time)
    return timeline.overview(findings, time)


def _fringes(findings: Findings, fringes: FringeFindings, time: TimeAxis) -> Section:
    if not len(fringes.overlap["time_s"]):
        text = "No frame with a measured tilt is in the log, so there is nothing to draw."
        return Section("Fringes", [], [], text=text)
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
            lead = [tables.residual(loop), tables.key_figures(loop)]
            found.append(Section(f"Loop {loop.name}", [], [], lead, text))
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
    designs = {loop: each.get("parameters") for loop, each in designs_of(run.metadata).items()}
    return [
        *found,
        Section("Events", [], happened),
        Section("Losses and files", [], recorded),
        Section("Devices", [], [tables.devices(findings)]),
        Section(
            "Configuration and versions",
            [],
            [tables.versions(findings)],
            text=f"Rig {rig.name}: {rig.description}",
            fold=_json({"rig": rig.model_dump(mode="json"), "designs": designs}),
        ),
    ]


def _json(value: object) -> str:
    """JSON for people: lists of plain values, and small objects of them, each stand on one line."""

    def in_one_line(found: re.Match[str]) -> str:
        line = " ".join(found[0].split())
        return line if line[0] == "[" or len(line) <= _LINE_COLUMNS else found[0]

    return re.sub(r"[\[{][^\[\]{}]*[\]}]", in_one_line, json.dumps(value, indent=1))
