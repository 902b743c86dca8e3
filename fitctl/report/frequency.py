"""Plots of what the loop did by frequency, and of the hysteresis that its commands show."""

from __future__ import annotations

import itertools
import math

import numpy as np

from fitctl.identify.drawing import GREEN
from fitctl.report.drawing import AZ, EL, FAINT, INK, SERIES, Plot, decimal, nothing, panels
from fitctl.report.findings import AXES, LoopFindings

_POINTS = 900  # of a path in the plane
_DIRECTIONS = (
    (1, "^", AZ, "came from below"),
    (-1, "v", EL, "came from above"),
    (0, "o", FAINT, "did not move"),
)


def spectra(loop: LoopFindings) -> Plot:
    """Spectral densities before and after, and what they add up to."""
    figure, (density, sums) = panels(1, 3.8, 2)
    for found, color in zip(loop.rejections, itertools.cycle(SERIES), strict=False):
        frequency_hz = found.spectra.frequency_hz
        for what, line in (("disturbance", "--"), ("error", "-")):
            power, label = getattr(found.spectra, what), f"{what}, {found.controller}"
            density.loglog(frequency_hz, power, line, color=color, label=label)
            total = np.sqrt(np.cumsum(power) * frequency_hz[0])
            sums.semilogx(frequency_hz, total, line, color=color)
    sums.axhline(loop.requirement_px, color=INK, linestyle=":")
    density.set(title="Power spectral density", xlabel="Hz", ylabel="px²/Hz")
    sums.set(title="Cumulative RMS: of all below a frequency", xlabel="Hz", ylabel="px")
    sums.set_yscale("log")
    for axis in (density.xaxis, density.yaxis, sums.xaxis, sums.yaxis):
        decimal(axis)
    if loop.rejections:
        density.legend(loc="lower left")
    else:
        nothing(density)
    caption = (
        "Mean of both axes, Welch's method, segments of 8 s. Dashed: the disturbance, which is the open loop "
        "rebuilt from the log, the error less where both stages had moved the star at mid-exposure. Solid: "
        "the error that was left. Both hold the camera's noise."
    )
    return Plot(f"{loop.name}-psd", "Before and after", caption, figure)


def rejection(loop: LoopFindings) -> Plot:
    """Measured rejection over the design's."""
    figure, (axes,) = panels(1, 3.8)
    for found, color in zip(loop.rejections, itertools.cycle(SERIES), strict=False):
        name, frequency_hz = found.controller, found.spectra.frequency_hz
        axes.loglog(frequency_hz, found.measured, color=color, label=f"measured, {name}")
        if found.predicted is not None:
            predicted = found.predicted.rejection
            axes.loglog(frequency_hz, predicted, "--", color=color, label=f"design, {name}")
    axes.axhline(1.0, color=FAINT, linewidth=0.9)
    axes.set(
        title="Disturbance rejection: above 1 the loop helps, below it makes worse",
        xlabel="Hz",
        ylabel="disturbance over error",
    )
    decimal(axes.xaxis, dense=True)
    decimal(axes.yaxis, dense=True)
    if loop.rejections:
        axes.legend(loc="upper right")
    else:
        nothing(axes)
    caption = (
        "Root of the ratio of both spectra, beside the sensitivity of the linear sampled loop of the logged "
        "design. Eq. 20 knows nothing of the stacks' hysteresis, which takes from its gain."
    )
    return Plot(f"{loop.name}-rejection", "Rejection against the design", caption, figure)


def hysteresis(loop: LoopFindings) -> Plot:
    """Command against target, and displacement against voltage."""
    figure, (*commands, stack) = panels(1, 3.6, 3)
    dwells_of = [gap.dwells for gap in loop.stages.gaps] or [[], []]
    for axis, axes, dwells in zip(AXES, commands, dwells_of, strict=True):
        moved = any(dwell.direction for dwell in dwells)
        middle_px = float(np.mean([dwell.command_px for dwell in dwells])) if dwells else 0.0
        for direction, sign, color, label in _DIRECTIONS if moved else ():
            its = [dwell for dwell in dwells if dwell.direction == direction]
            axes.plot(
                [dwell.target_px for dwell in its],
                [dwell.command_px - middle_px for dwell in its],
                sign,
                color=color,
                markersize=5,
                label=label,
            )
        if moved:
            axes.legend(loc="best")
        else:
            nothing(axes, *(["the target did not move"] if dwells else []))
        axes.set(
            title=f"Command where it stood, {axis}",
            xlabel="target (px)",
            ylabel="stages told, from their mean (px)",
        )
    rows = loop.selection.rows
    if loop.stacks is not None and len(rows):
        some = rows[np.linspace(0, len(rows) - 1, min(_POINTS, len(rows))).astype(int)]
        for number, color in enumerate((AZ, EL, GREEN)):
            stack.plot(
                loop.ticks[f"stack{number + 1}_v"][some],
                1e6 * loop.stacks.displacement_m[some, number],
                ".",
                color=color,
                markersize=1.6,
                label=f"stack {number + 1}",
            )
        stack.legend(loc="upper left", markerscale=4)
    else:
        nothing(stack)
    stack.set(title="Stacks, by their model", xlabel="voltage told (V)", ylabel="displacement (µm)")
    return Plot(f"{loop.name}-hysteresis", "Hysteresis in the commands", _gap_text(loop), figure)


def _gap_text(loop: LoopFindings) -> str:
    gaps = [
        f"{axis} {gap.px:+.3f} px"
        + ("" if math.isnan(gap.error_px) else f" (standard error {gap.error_px:.3f})")
        for axis, gap in zip(AXES, loop.stages.gaps, strict=False)
        if not math.isnan(gap.px)
    ]
    found = (
        "Difference of the commands at one place of the target, come from below less come from above: "
        f"{', '.join(gaps)}."
        if gaps
        else "The target did not come to one place from both sides, so the commands cannot show hysteresis."
    )
    return (
        "Left, middle: what both stages were told in the mean while the target stood; if it depends on where "
        f"the target came from, that is hysteresis and backlash, within what the air adds. {found} Right: what "
        "their model makes of the voltages; the width of each path is its hysteresis."
    )
