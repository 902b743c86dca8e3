"""Making a report: a folder with one page, its plots and its figures."""

from __future__ import annotations

import importlib.metadata
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fitctl.figures.pages import write_json, write_page
from fitctl.report import tables
from fitctl.report.drawing import Plot, draw, styled
from fitctl.report.findings import Findings, LoopFindings, StarFindings
from fitctl.report.page import EVALUATION, SIGNS, Section, first_plot, sections
from fitctl.tui.inks import FAULT, MODE_COLOURS

PAGE = "report.html"


def make_report(findings: Findings, folder: Path) -> Path:
    """Write a run's report into a folder that exists; returns the page.

    Raises
    ------
    OSError
        If something cannot be written.
    """
    run = findings.run
    title = f"{run.rig.name}, {tables.utc(run)}" if run.start_ns else f"{run.name}: no records"
    with styled():
        parts, first = sections(findings), first_plot(findings)
    facts = [f"{len(run.logs)} files" if len(run.logs) > 1 else run.logs[0].path.name]
    facts += [tables.seconds(run.duration_s), f"requirement {findings.word}"]
    cards = [Card(loop, tables.headline(loop)) for loop in findings.loops.values()]
    return write(folder, title, facts, parts, plain(findings), cards, first)


class Card(NamedTuple):
    """What the first screen has of a loop."""

    loop: LoopFindings
    headline: str

    @property
    def sources(self) -> str:
        """Where the error came from, under the last controller; nothing where it is not known."""
        rejections = self.loop.rejections if isinstance(self.loop, StarFindings) else []
        budgets = [found.budget for found in rejections if found.budget is not None]
        return budgets[-1].parts if budgets else ""


def write(
    folder: Path,
    title: str,
    facts: Sequence[str],
    parts: list[Section],
    figures: dict[str, Any],
    cards: Sequence[Card] = (),
    first: Plot | None = None,
) -> Path:
    """Page, plots and ``report.json``; returns the page, which is one file and needs nothing from elsewhere.

    Raises
    ------
    OSError
        If something cannot be written.
    """
    with styled():
        plots = [*([first] if first else []), *(plot for part in parts for plot in part.plots)]
        drawings = {plot.name: draw(plot, folder) for plot in plots}
    page = folder / PAGE
    write_page(
        page,
        "fitctl.report",
        "page.html.j2",
        title=title,
        facts=facts,
        cards=cards,
        first=first,
        modes={name.lower(): color for name, color in MODE_COLOURS.items()} | {"fault": FAULT},
        sections=parts,
        drawings=drawings,
        signs=SIGNS,
        evaluation=EVALUATION,
        version=importlib.metadata.version("fitctl"),
    )
    write_json(folder / "report.json", figures)
    return page


def plain(findings: Findings) -> dict[str, Any]:
    """A run's figures for programs; what is not known is null."""
    run = findings.run
    return {
        "rig": run.rig.name,
        "logs": [str(log.path) for log in run.logs],
        "start_s": run.start_ns / 1e9,
        "duration_s": run.duration_s,
        "verdict": findings.word,
        "records_lost": findings.gathered.lost,
        "records_misdated": findings.gathered.misdated,
        "loops": {name: _plain_loop(loop) for name, loop in findings.loops.items()},
        "fringes": None if findings.fringes is None else findings.fringes.figures._asdict(),
    }


def _plain_loop(loop: LoopFindings) -> dict[str, Any]:
    unit, selection = loop.quantity.unit, loop.selection
    figures = {
        "verdict": loop.verdict.word,
        "why": loop.verdict.why,
        f"requirement_{unit}": loop.requirement,
        "residual": {
            axis: {
                f"rms_{unit}": found.rms,
                f"low_{unit}": found.low,
                f"high_{unit}": found.high,
                "independent": found.independent,
            }
            for axis, found in loop.residual.items()
        },
        f"{loop.quantity.mode.name.lower()}_s": selection.held_s,
        "judged_s": selection.evaluated_s,
        f"{loop.quantity.of}_fraction": selection.measured_fraction,
        "mode_s": loop.mode_s,
        "counts": loop.counts,
        "timing": loop.timing,
    }
    return figures | (_plain_star(loop) if isinstance(loop, StarFindings) else {})


def _plain_star(loop: StarFindings) -> dict[str, Any]:
    moved = loop.stages
    return {
        "sky_arcsec_per_px": loop.sky_arcsec_per_px,
        "fsm_range_mean": moved.range_mean,
        "fsm_range_worst": moved.range_worst,
        "fsm_saturated_fraction": moved.saturated_fraction,
        "piston_rms_m": moved.piston_rms_m,
        "siderostat_moved_px": moved.motor_moved_px.tolist(),
        "command_gap_px": [gap.px for gap in moved.gaps],
        "rms_by_controller": [
            {
                "name": held.controller,
                "judged_s": held.evaluated_s,
                **{f"rms_{axis}_px": found.rms for axis, found in held.residual.items()},
            }
            for held in loop.held_by_controller
        ],
        "controllers": [
            {
                "name": found.controller,
                "judged_s": found.evaluated_s,
                "design_residual_px": math.nan
                if found.predicted is None
                else found.predicted.residual_px,
                "bound_px": math.nan if found.predicted is None else found.predicted.bound_px,
                "error_budget": None
                if found.budget is None
                else {
                    "measured_px": found.budget.measured_px,
                    "expected_px": found.budget.expected_px,
                    "as_expected": found.budget.as_expected,
                    "fractions": found.budget.fractions,
                },
                "rejection": [
                    {"hz": at_hz, "measured": measured, "design": design}
                    for at_hz, measured, design in found.table()
                ],
            }
            for found in loop.rejections
        ],
    }
