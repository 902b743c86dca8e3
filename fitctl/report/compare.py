"""Nights side by side: the same figures in columns, the same curves in one plot."""

from __future__ import annotations

import itertools
import math
import string
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np

from fitctl.error_budget import CAUSES
from fitctl.report import tables
from fitctl.report.drawing import SERIES, Plot, decimal, limit, panels, styled
from fitctl.report.findings import AXES, Findings, LoopFindings, StarFindings
from fitctl.report.make import plain, write
from fitctl.report.page import SIGNS, Section
from fitctl.report.residual import Estimate
from fitctl.report.tables import Table, number, seconds
from fitctl.report.timeline import WINDOW_S, running_rms

Night = tuple[str, LoopFindings]


def make_comparison(nights: Sequence[Findings], folder: Path) -> Path:
    """Write a comparison of runs into a folder that exists; returns the page.

    Raises
    ------
    OSError
        If something cannot be written.
    """
    lettered = list(zip(string.ascii_uppercase, nights, strict=False))
    # A name may be of a star in one night, and of a beam in another.
    loops: dict[tuple[str, str], list[Night]] = {}
    for letter, of in lettered:
        for name, loop in of.loops.items():
            loops.setdefault((name, loop.quantity.of), []).append((letter, loop))
    with styled():
        parts = [_loop(name, its) for (name, _), its in loops.items()]
    parts.insert(0, Section("Verdicts", [], [_nights(lettered)]))
    figures = {"nights": [{"letter": letter, **plain(night)} for letter, night in lettered]}
    facts = [f"{letter}: {night.run.name}" for letter, night in lettered]
    return write(folder, "Nights side by side", facts, parts, figures)


def _nights(lettered: Sequence[tuple[str, Findings]]) -> Table:
    rows = [
        [
            letter,
            night.run.name,
            night.run.rig.name,
            tables.utc(night.run),
            seconds(night.run.duration_s),
            night.run.metadata.get("versions", {}).get("fitctl", tables.UNKNOWN),
            f"{SIGNS[night.word]} {night.word}",
            tables.UNKNOWN if night.gathered.lost is None else str(night.gathered.lost),
        ]
        for letter, night in lettered
    ]
    head = ["night", "log", "rig", "begins", "lasts", "fitctl", "requirement", "records lost"]
    return Table("Nights", head, rows)


def _loop(name: str, nights: list[Night]) -> Section:
    quantity = nights[0][1].quantity
    stars = [(letter, loop) for letter, loop in nights if isinstance(loop, StarFindings)]
    plots = [_spectra(name, stars)] if stars else []
    plots.append(_residuals(f"{name}-{quantity.of}", nights))
    title = f"Loop {name}" if stars else f"Loop {name}: {quantity.of}"
    return Section(title, plots, [_figures(nights), *([_budgets(stars)] if stars else [])])


def _figures(nights: list[Night]) -> Table:
    """What was measured, a row each."""
    held = nights[0][1].quantity
    kinds: dict[str, Callable[[LoopFindings], str]] = {
        "requirement": lambda loop: f"{SIGNS[loop.verdict.word]} {loop.verdict.word}",
        f"RMS az, {held.unit} (95 %)": lambda loop: _rms(loop.residual["az"]),
        f"RMS el, {held.unit} (95 %)": lambda loop: _rms(loop.residual["el"]),
        f"time in {held.mode.name}": lambda loop: seconds(loop.selection.held_s),
        "of it judged": lambda loop: seconds(loop.selection.evaluated_s),
        f"{held.of} measured": lambda loop: number(
            loop.selection.measured_fraction, ".2f", "%", 100
        ),
        "frames": lambda loop: str(loop.counts["frames"]),
        "frames lost": lambda loop: str(loop.counts["frames_lost"]),
        "late ticks": lambda loop: str(loop.counts["late_ticks"]),
        "frame's age, median": lambda loop: number(loop.timing["age_median_s"], ".2f", "ms", 1e3),
        "tick, worst": lambda loop: number(loop.timing["compute_worst_s"], ".2f", "ms", 1e3),
    }
    rows = [[what, *(text(loop) for _, loop in nights)] for what, text in kinds.items()]
    stars = [loop for _, loop in nights if isinstance(loop, StarFindings)]
    if stars:
        rows += [[what, *map(text, stars)] for what, text in _OF_STARS.items()]
    return Table("Measured", ["what", *(letter for letter, _ in nights)], rows)


def _rms(found: Estimate) -> str:
    text = number(found.rms, ".4f")
    return text if math.isnan(found.rms) else f"{text} ({tables.interval(found)})"


def _at_1_hz(loop: StarFindings) -> str:
    measured = [of for one in loop.rejections for at_hz, of, _ in one.table() if at_hz == 1.0]
    return ", ".join(f"{of:.2f}" for of in measured) or tables.UNKNOWN


_OF_STARS: dict[str, Callable[[StarFindings], str]] = {
    "controllers": lambda loop: (
        ", ".join(one.controller for one in loop.rejections) or tables.UNKNOWN
    ),
    "rejection at 1 Hz": _at_1_hz,
    "mirror's range, mean": lambda loop: number(loop.stages.range_mean, ".1f", "%", 100),
    "mirror's range, worst": lambda loop: number(loop.stages.range_worst, ".1f", "%", 100),
    "piston, RMS": lambda loop: number(loop.stages.piston_rms_m, ".1f", "nm", 1e9),
}


def _budgets(nights: list[tuple[str, StarFindings]]) -> Table:
    """The error budget of each night, under each controller."""
    budgets = [
        (f"{letter}, {one.controller}", one.budget)
        for letter, loop in nights
        for one in loop.rejections
        if one.budget is not None
    ]
    rows = [
        ["RMS of an axis, px", *(f"{b.measured_px:.4f} ({b.expected_px:.4f})" for _, b in budgets)]
    ]
    rows += [
        [
            cause,
            *(
                f"{b.percent[cause]} % ({100 * b.expected_fractions[cause]:.0f} %)"
                for _, b in budgets
            ),
        ]
        for cause in CAUSES
    ]
    title = "Where the error comes from: parts of its mean square, and in brackets what design and rig expect"
    return Table(title, ["cause", *(name for name, _ in budgets)], rows if budgets else [])


def _spectra(name: str, nights: list[tuple[str, StarFindings]]) -> Plot:
    figure, (density, rejection) = panels(1, 3.8, 2)
    its = [(letter, one) for letter, loop in nights for one in loop.rejections]
    for (letter, one), color in zip(its, itertools.cycle(SERIES), strict=False):
        frequency_hz, label = one.spectra.frequency_hz, f"{letter}, {one.controller}"
        density.loglog(frequency_hz, one.spectra.disturbance, "--", color=color)
        density.loglog(frequency_hz, one.spectra.error, color=color, label=label)
        rejection.loglog(frequency_hz, one.measured, color=color, label=label)
    density.set(
        title="Power spectral density: error, and disturbance (dashed)",
        xlabel="Hz",
        ylabel="px²/Hz",
    )
    rejection.set(
        title="Disturbance rejection, measured", xlabel="Hz", ylabel="disturbance over error"
    )
    for axes in (density, rejection) if its else ():
        decimal(axes.xaxis)
        decimal(axes.yaxis)
        axes.legend(loc="best")
    caption = "Mean of both axes. The disturbance is the open loop, rebuilt from the log."
    return Plot(f"{name}-spectra", "Spectra", caption, figure)


def _residuals(name: str, nights: list[Night]) -> Plot:
    figure, axes = panels(2, 4.4)
    quantity = nights[0][1].quantity
    for index, (letter, loop) in enumerate(nights):
        at_s, rms = running_rms(loop)
        held = np.flatnonzero(loop.ticks["mode_number"] == loop.quantity.mode)
        if len(held):
            after_min = (at_s - loop.ticks["time_s"][held[0]]) / 60
            for one, axis in zip(axes, AXES, strict=True):
                one.plot(after_min, rms[axis], color=SERIES[index % len(SERIES)], label=letter)
    for one, axis in zip(axes, AXES, strict=True):
        limit(one, min(loop.requirement for _, loop in nights))
        one.set_yscale("log")
        decimal(one.yaxis, dense=True)
        title = (
            f"RMS of the measured error in {quantity.mode.name}, {axis}, {WINDOW_S:g} s at a time"
        )
        one.set(title=title, ylabel=quantity.unit)
    if axes[0].lines[1:]:
        axes[0].legend(ncols=len(nights), loc="best")
    axes[-1].set_xlabel(f"min after {quantity.mode.name} first began")
    caption = "Dashed: the requirement. Steps and hand-over are in it."
    return Plot(f"{name}-residuals", "Residual over the night", caption, figure)
