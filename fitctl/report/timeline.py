"""Plots of the whole run: modes and events, residual, traces."""

from __future__ import annotations

import itertools
from collections import defaultdict
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.identify.drawing import GREEN, ORANGE, SKY
from fitctl.messages.modes import Mode, Trigger
from fitctl.report.drawing import (
    AZ,
    COLORS,
    EL,
    FAINT,
    SERIES,
    Plot,
    TimeAxis,
    decimal,
    legend_above,
    limit,
    panels,
    span,
    trace,
)
from fitctl.report.findings import AXES, Findings, LoopFindings, StarFindings
from fitctl.report.tables import UNKNOWN
from fitctl.tui.inks import FAULT, MODE_COLOURS

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.floating]
_SIGNS = {3: ("v", ORANGE, "warning"), 4: ("X", EL, "error")}  # by foxglove.Log's level
WINDOW_S = 10.0
DIODES = ("az_plus", "az_minus", "el_plus", "el_minus")


def running_rms(loop: LoopFindings) -> tuple[Floats, dict[str, Floats]]:
    """Mean times in windows of `WINDOW_S` and the RMS of each axis' error while held.

    Windows that do not follow each other have one NaN between them, however far they are apart.
    """
    held = loop.held
    time_s = loop.ticks["time_s"][held]
    if len(time_s) == 0:
        return np.empty(0), {axis: np.empty(0) for axis in AXES}
    windows, row = np.unique(np.floor(time_s / WINDOW_S).astype(int), return_inverse=True)
    gaps = np.flatnonzero(np.diff(windows) > 1) + 1

    def mean(values: Floats) -> Floats:
        return np.insert(np.bincount(row, values) / np.bincount(row), gaps, np.nan)

    rms = {axis: np.sqrt(mean(loop.error(axis)[held].astype(float) ** 2)) for axis in AXES}
    return mean(time_s), rms


def timeline(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Modes, events and the residual, ten seconds at a time."""
    figure, (modes, residual) = panels(2, 3.2, heights=(1, 2.6))
    _modes_and_events(modes, findings, [loop], time)
    at_s, rms = running_rms(loop)
    for axis in AXES:
        line = "o-" if len(at_s) < 60 else "-"
        shown = at_s / time.s_per_unit
        residual.plot(shown, rms[axis], line, ms=3, color=COLORS[axis], label=axis)
    unit = loop.quantity.unit
    limit(residual, loop.requirement, f"requirement {loop.requirement:g} {unit}")
    residual.set_yscale("log")
    decimal(residual.yaxis, dense=True)
    residual.set(
        title=f"RMS of the measured error in {loop.quantity.mode.name}, {WINDOW_S:g} s at a time",
        xlabel=time.label,
        ylabel=unit,
    )
    legend_above(residual, 3)
    span([residual], time, findings.run.duration_s)
    caption = (
        "Above: the loop's mode; marks are warnings and errors of the whole instrument. Below: RMS about the "
        "target, steps and hand-over included."
    )
    return Plot(f"{loop.name}-timeline", "Timeline", caption, figure)


def overview(findings: Findings, time: TimeAxis) -> Plot:
    """Modes of all loops below each other, events, and each loop's residual as a part of its requirement."""
    loops = [loop for loop in findings.loops.values() if len(loop.ticks["time_s"])]
    figure, (modes, residual) = panels(2, 2.6 + 0.3 * len(loops), heights=(len(loops), 4))
    _modes_and_events(modes, findings, loops, time)
    modes.set(yticks=-np.arange(len(loops)), yticklabels=[loop.name for loop in loops])
    for loop, color in zip(loops, itertools.cycle(SERIES), strict=False):
        at_s, rms = running_rms(loop)
        worse = np.fmax(rms["az"], rms["el"]) / loop.requirement
        residual.plot(at_s / time.s_per_unit, 100 * worse, color=color, label=loop.name)
    limit(residual, 100.0)
    residual.set_yscale("log")
    decimal(residual.yaxis, dense=True)
    residual.set(
        title=f"RMS of the worse axis, {WINDOW_S:g} s at a time",
        xlabel=time.label,
        ylabel="% of requirement",
    )
    legend_above(residual, len(loops))
    span([residual], time, findings.run.duration_s)
    caption = (
        "Above: modes; marks are warnings and errors of the whole instrument. Below: while a loop holds its "
        "star or beam, steps and hand-over included."
    )
    return Plot("timeline", "Timeline", caption, figure)


def _modes_and_events(
    axes: Axes, findings: Findings, loops: Sequence[LoopFindings], time: TimeAxis
) -> None:
    """Bars of modes, a row a loop, and the warnings and errors above them."""
    labels: dict[str, str] = {}
    bars: defaultdict[tuple[int, str], list[tuple[float, float]]] = defaultdict(list)
    for row, loop in enumerate(loops):
        faults_s = [
            change["time_s"]
            for change in findings.gathered.modes
            if change["loop"] == loop.name and change["trigger"] == Trigger.FAULT.name
        ]
        for begin_s, end_s, mode in _spans(loop):
            fault = mode is Mode.SAFE and any(abs(at_s - begin_s) < 1.0 for at_s in faults_s)
            label, color = _label_and_color(mode, fault=fault)
            labels[label] = color
            bars[row, color].append(
                (begin_s / time.s_per_unit, (end_s - begin_s) / time.s_per_unit)
            )
    for (row, color), spans in bars.items():  # a bar for each span takes milliseconds
        axes.broken_barh(spans, (-row - 0.3, 0.6), color=color, linewidth=0)
    for label, color in labels.items():
        axes.barh(0, 0, color=color, label=label)
    for level, (sign, color, label) in _SIGNS.items():
        times_s = [event["time_s"] for event in findings.gathered.events if event["level"] == level]
        if times_s:
            at = np.array(times_s) / time.s_per_unit
            axes.plot(at, np.full(len(at), 0.55), sign, color=color, markersize=6, label=label)
    axes.set(title="Modes and events", ylim=(-len(loops) + 0.55, 0.8), yticks=[])
    axes.legend(ncols=9, loc="lower left", bbox_to_anchor=(0.18, 0.98), borderaxespad=0)
    axes.grid(visible=False, axis="y")


def _label_and_color(mode: Mode | None, *, fault: bool) -> tuple[str, str]:
    if mode is None:
        return f"mode {UNKNOWN}", FAINT
    if fault:
        return "SAFE after a fault", FAULT.light
    return mode.name, MODE_COLOURS[mode.name].light


def _spans(loop: LoopFindings) -> list[tuple[float, float, Mode | None]]:
    """When each mode began and ended; None is one that this version does not know."""
    known = {int(mode): mode for mode in Mode}
    ticks = loop.ticks
    numbers, time_s = ticks["mode_number"], ticks["time_s"]
    if len(numbers) == 0:
        return []
    apart = (np.diff(numbers) != 0) | (np.diff(time_s) > 1.0)
    begins = np.flatnonzero(np.r_[True, apart])
    ends = np.r_[begins[1:], len(numbers) - 1]
    # Up to the next tick, but not over a time without any.
    return [
        (
            time_s[begin],
            min(time_s[end], time_s[max(begin, end - 1)] + 1.0),
            known.get(int(numbers[begin])),
        )
        for begin, end in zip(begins, ends, strict=True)
    ]


def traces(findings: Findings, loop: StarFindings, time: TimeAxis) -> Plot:
    """Error, target and flux."""
    ticks = loop.ticks
    frames = ticks["star_visible"]
    held = loop.held
    figure, (error, target, flux) = panels(3, 5.4)
    time_s, tracked = ticks["time_s"], ticks["mode_number"] >= Mode.ACQUISITION
    for axis in AXES:
        target_px = ticks[f"target_{axis}_px"]
        trace(error, time, time_s[held], loop.error(axis)[held], COLORS[axis], axis)
        trace(target, time, time_s[tracked], target_px[tracked], COLORS[axis], axis)
    beyond = _limit(error, loop, held)
    trace(flux, time, time_s[frames], ticks["star_flux_dn"][frames], GREEN, "flux")
    error.set(title=f"Error in VERNIER: star less target{beyond}", ylabel="px")
    target.set(title="Target, as filtered", ylabel="px")
    flux.set(title="Light in the window", xlabel=time.label, ylabel="DN")
    legend_above(error, 2)
    span([flux], time, findings.run.duration_s)
    caption = (
        "Dashed: the requirement, either side, for comparison with the error's size. Long series are bands "
        "from the lowest to the highest value of each piece of time."
    )
    return Plot(f"{loop.name}-traces", "Traces", caption, figure)


def beam_traces(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Error of the beam, the siderostat that holds it, and light."""
    ticks, held = loop.ticks, loop.held
    time_s, sampled = ticks["time_s"], ~np.isnan(ticks["diode_az_plus_v"])
    figure, (error, siderostat, light) = panels(3, 5.4)
    for axis in AXES:
        trace(error, time, time_s[held], loop.error(axis)[held], COLORS[axis], axis)
        sky_arcsec = ticks[f"siderostat_{axis}_sky_arcsec"]
        trace(siderostat, time, time_s, sky_arcsec, COLORS[axis], axis)
    beyond = _limit(error, loop, held)
    for diode, color in zip(DIODES, (AZ, SKY, EL, ORANGE), strict=True):
        volts = ticks[f"diode_{diode}_v"][sampled]
        trace(light, time, time_s[sampled], volts, color, diode.replace("_", " "))
    error.set(title=f"Error in LOCKED: beam less centre{beyond}", ylabel="arcsec")
    siderostat.set(title="Siderostat, by its encoders", ylabel="arcsec on the sky")
    light.set(title="Photodiodes", xlabel=time.label, ylabel="V")
    legend_above(error, 2)
    legend_above(light, 4)
    span([light], time, findings.run.duration_s)
    caption = (
        "Dashed: the requirement, either side. The siderostat follows the collector across the link: what it "
        "turns here, a star that comes over the link turns too."
    )
    return Plot(f"{loop.name}-traces", "Traces", caption, figure)


def _limit(axes: Axes, loop: LoopFindings, held: NDArray[np.bool_]) -> str:
    """Draw the requirement, and keep a few frames of hand-over from flattening the rest; returns the worst."""
    for sign in (-1, 1):
        limit(axes, sign * loop.requirement)
    if not held.any():
        return ""
    errors = np.abs(np.concatenate([loop.error(axis)[held] for axis in AXES]))
    shown = max(1.3 * loop.requirement, 1.2 * float(np.quantile(errors, 0.995)))
    worst = float(errors.max())
    axes.set_ylim(-shown, shown)
    return f"; at worst {worst:.2f} {loop.quantity.unit}, not shown" if worst > shown else ""
