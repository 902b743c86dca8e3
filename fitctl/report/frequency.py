"""Plots of what the loop did by frequency, and of the hysteresis that its commands show."""

from __future__ import annotations

import itertools
import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.identify.drawing import GREEN
from fitctl.report.drawing import (
    AZ,
    COLORS,
    EL,
    FAINT,
    INK,
    SERIES,
    Plot,
    decimal,
    panels,
)
from fitctl.report.findings import AXES, LoopFindings, StarFindings
from fitctl.report.fringes import FringeFindings, density

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TOO_SHORT = "no evaluated stretch is as long as a segment of 8 s."
_POINTS = 900  # of a path in the plane
_DIRECTIONS = (
    (1, "^", AZ, "came from below"),
    (-1, "v", EL, "came from above"),
    (0, "o", FAINT, "did not move"),
)


def spectra(loop: StarFindings) -> Plot:
    """Spectral densities before and after, and what they add up to."""
    if not loop.rejections:
        return Plot(f"{loop.name}-psd", "Before and after", TOO_SHORT, None)
    figure, (densities, sums) = panels(1, 3.8, 2)
    for found, color in zip(loop.rejections, itertools.cycle(SERIES), strict=False):
        frequency_hz = found.spectra.frequency_hz
        for what, line in (("disturbance", "--"), ("error", "-")):
            power, label = getattr(found.spectra, what), f"{what}, {found.controller}"
            densities.loglog(frequency_hz, power, line, color=color, label=label)
            total = np.sqrt(np.cumsum(power) * frequency_hz[0])
            sums.semilogx(frequency_hz, total, line, color=color)
    sums.axhline(loop.requirement, color=INK, linestyle=":")
    densities.set(title="Power spectral density", xlabel="Hz", ylabel="px²/Hz")
    sums.set(title="Cumulative RMS: of all lower frequencies", xlabel="Hz", ylabel="px")
    sums.set_yscale("log")
    for axis in (densities.xaxis, densities.yaxis, sums.xaxis, sums.yaxis):
        decimal(axis)
    densities.legend(loc="lower left")
    caption = (
        "Mean of both axes, Welch's method, segments of 8 s. Dashed: the disturbance, which is the open loop "
        "rebuilt from the log, the error less where both stages had moved the star at mid-exposure. Solid: "
        "the error that was left. Both hold the camera's noise."
    )
    return Plot(f"{loop.name}-psd", "Before and after", caption, figure)


def beam_spectrum(loop: LoopFindings, period_s: float) -> Plot:
    """Spectral density of the error of a metrology loop."""
    errors = np.column_stack([loop.error(axis) for axis in AXES]).astype(float)
    found = density(loop.ticks["time_s"], errors, loop.selection.rows, period_s)
    caption = (
        "Welch's method, segments of 8 s. The error is measured, so it includes the photodiodes' noise. "
        "Dotted: the requirement."
    )
    if not len(found[0]):
        return Plot(f"{loop.name}-psd", "Spectrum of the error", TOO_SHORT, None)
    figure = _axes_spectra(*found, loop.requirement)
    return Plot(f"{loop.name}-psd", "Spectrum of the error", caption, figure)


def tilt_spectrum(fringes: FringeFindings) -> Plot:
    """Spectral density of the tilt between two stars."""
    caption = "Welch's method, segments of 8 s. The measured tilt includes the camera noise of both stars."
    if not len(fringes.frequency_hz):
        return Plot("fringes-psd", "Spectrum of the tilt", TOO_SHORT, None)
    figure = _axes_spectra(fringes.frequency_hz, fringes.density, math.nan)
    return Plot("fringes-psd", "Spectrum of the tilt", caption, figure)


def _axes_spectra(
    frequency_hz: NDArray[np.floating], power: NDArray[np.floating], requirement: float
) -> Figure:
    """Both axes' densities, arcsec²/Hz, and what they add up to."""
    figure, (densities, sums) = panels(1, 3.8, 2)
    for number, axis in enumerate(AXES):
        densities.loglog(frequency_hz, power[:, number], color=COLORS[axis], label=axis)
        total = np.sqrt(np.cumsum(power[:, number]) * frequency_hz[0])
        sums.loglog(frequency_hz, total, color=COLORS[axis], label=axis)
    densities.set(title="Power spectral density", xlabel="Hz", ylabel="arcsec²/Hz")
    sums.set(title="Cumulative RMS: of all lower frequencies", xlabel="Hz", ylabel="arcsec")
    if not math.isnan(requirement):
        sums.axhline(requirement, color=INK, linestyle=":")
    densities.legend(loc="lower left")
    for axes in (densities, sums):
        decimal(axes.xaxis)
        decimal(axes.yaxis, dense=True)
    return figure


def rejection(loop: StarFindings) -> Plot:
    """Measured rejection over the design's."""
    if not loop.rejections:
        return Plot(f"{loop.name}-rejection", "Rejection against the design", TOO_SHORT, None)
    figure, (axes,) = panels(1, 3.8)
    for found, color in zip(loop.rejections, itertools.cycle(SERIES), strict=False):
        name, frequency_hz = found.controller, found.spectra.frequency_hz
        axes.loglog(frequency_hz, found.measured, color=color, label=f"measured, {name}")
        if found.predicted is not None:
            predicted = found.predicted.rejection
            axes.loglog(frequency_hz, predicted, "--", color=color, label=f"design, {name}")
    axes.axhline(1.0, color=FAINT, linewidth=0.9)
    axes.set(
        title="Disturbance rejection: the loop helps above 1 and amplifies below",
        xlabel="Hz",
        ylabel="disturbance over error",
    )
    decimal(axes.xaxis, dense=True)
    decimal(axes.yaxis, dense=True)
    axes.legend(loc="upper right")
    caption = (
        "Root of the ratio of both spectra, beside the sensitivity of the linear sampled loop of the logged "
        "design. Eq. 20 does not include the stacks' hysteresis, which lowers its gain."
    )
    return Plot(f"{loop.name}-rejection", "Rejection against the design", caption, figure)


def hysteresis(loop: StarFindings) -> Plot:
    """Command against target, and displacement against voltage; of these, what there is."""
    moved = [
        (axis, gap.dwells)
        for axis, gap in zip(AXES, loop.stages.gaps, strict=False)
        if any(dwell.direction for dwell in gap.dwells)
    ]
    rows = loop.selection.rows
    stacks = loop.stacks if len(rows) else None
    name, title = f"{loop.name}-hysteresis", "Hysteresis in the commands"
    columns = len(moved) + (stacks is not None)
    if not columns:
        return Plot(
            name, title, "the target did not move, and no model of the stacks is known.", None
        )
    figure, axes = panels(1, 3.4, columns)
    for (axis, dwells), its in zip(moved, axes, strict=False):
        middle_px = float(np.mean([dwell.command_px for dwell in dwells]))
        for direction, sign, color, label in _DIRECTIONS:
            some = [dwell for dwell in dwells if dwell.direction == direction]
            its.plot(
                [dwell.target_px for dwell in some],
                [dwell.command_px - middle_px for dwell in some],
                sign,
                color=color,
                markersize=5,
                label=label,
            )
        its.legend(loc="best")
        its.set(
            title=f"Command where it stood, {axis}",
            xlabel="target (px)",
            ylabel="command, from its mean (px)",
        )
    if stacks is not None:
        shown = rows[np.linspace(0, len(rows) - 1, min(_POINTS, len(rows))).astype(int)]
        for number, color in enumerate((AZ, EL, GREEN)):
            axes[-1].plot(
                loop.ticks[f"stack{number + 1}_v"][shown],
                1e6 * stacks.displacement_m[shown, number],
                ".",
                color=color,
                markersize=1.6,
                label=f"stack {number + 1}",
            )
        axes[-1].legend(loc="upper left", markerscale=4)
        axes[-1].set(
            title="Stacks, by their model", xlabel="voltage (V)", ylabel="displacement (µm)"
        )
    return Plot(name, title, _gap_text(loop), figure)


def _gap_text(loop: StarFindings) -> str:
    gaps = [
        f"{axis} {gap.px:+.3f} px"
        + ("" if math.isnan(gap.error_px) else f" (standard error {gap.error_px:.3f})")
        for axis, gap in zip(AXES, loop.stages.gaps, strict=False)
        if not math.isnan(gap.px)
    ]
    found = (
        "Difference of the commands at one place of the target, reached from below less from above: "
        f"{', '.join(gaps)}."
        if gaps
        else "The target did not reach one place from both sides, so the commands cannot show hysteresis."
    )
    of_commands = (
        "Mean commands to both stages while the target stood still. If they depend on the direction from which "
        f"the target came, the cause is hysteresis and backlash, apart from the motion of the air. {found}"
    )
    of_stacks = "Positions of the stacks by their model of the voltages; the width of a path is its hysteresis."
    moved = any(dwell.direction for gap in loop.stages.gaps for dwell in gap.dwells)
    return " ".join([of_commands] * moved + [of_stacks] * (loop.stacks is not None) or [found])
