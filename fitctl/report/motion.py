"""Plots of what the stages did, and when the loop did it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.identify.drawing import GREEN, PURPLE, SKY
from fitctl.messages.modes import Mode
from fitctl.report.drawing import (
    AZ,
    COLORS,
    EL,
    INK,
    Plot,
    TimeAxis,
    decimal,
    envelope,
    legend_above,
    limit,
    panels,
    span,
    trace,
)
from fitctl.report.findings import AXES, Findings, LoopFindings, StarFindings
from fitctl.report.fringes import FringeFindings
from fitctl.report.selection import last_marked
from fitctl.report.stages import motion_px

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.floating]


def mirror(findings: Findings, loop: StarFindings, time: TimeAxis) -> Plot:
    """How much of its range the mirror uses, and its piston."""
    ticks = loop.ticks
    ready = ticks["mode_number"] >= Mode.COARSE
    figure, (fraction, piston) = panels(2, 3.8)
    at_s = ticks["time_s"][ready]
    trace(fraction, time, at_s, 100 * ticks["fsm_range_fraction"][ready], AZ, "range")
    limit(fraction, 100.0)
    fraction.set(
        title="Range of the fast steering mirror: 100 % is the edge of what three stacks reach",
        ylabel="% of the diamond",
        ylim=(0, 105),
    )
    if loop.stacks is not None:
        trace(piston, time, at_s, 1e9 * loop.stacks.piston_m[ready], PURPLE, "piston")
    else:
        why = "not known: no hysteresis in the rig file"
        piston.text(0.5, 0.5, why, transform=piston.transAxes, ha="center")
    piston.set(title="Piston of the mirror (Eq. 4)", xlabel=time.label, ylabel="nm")
    span([piston], time, findings.run.duration_s)
    source = (
        ""
        if loop.stacks is None
        else f" Piston is by {loop.stacks.source}, from the logged voltages."
    )
    caption = (
        f"From COARSE on.{source} Ideal stacks have none; the middle does not matter, changes do."
    )
    return Plot(f"{loop.name}-mirror", "Mirror: range and piston", caption, figure)


def siderostat(findings: Findings, loop: StarFindings, time: TimeAxis) -> Plot:
    """Where the siderostat is on the sky, and how the mirror hands over to it."""
    ticks = loop.ticks
    mirror_px, motor_px, setpoint_px = motion_px(findings.run.rig, loop.name, ticks)
    figure, (way, *offload) = panels(3, 5.8)
    for number, axis in enumerate(AXES):
        sky = motor_px[:, number] * loop.sky_arcsec_per_px
        trace(way, time, ticks["time_s"], sky, COLORS[axis], axis)
    way.set(title="Siderostat, from where it was first (encoders)", ylabel="arcsec on the sky")
    way.legend(ncols=2, loc="best")
    held = np.flatnonzero(ticks["mode_number"] == Mode.VERNIER)
    # After a slew the siderostat is elsewhere: each stretch of VERNIER has a zero of its own.
    began = last_marked(held, np.diff(held, prepend=-2) > 1)
    for number, (axis, axes) in enumerate(zip(AXES, offload, strict=True)):
        if len(held):
            offloaded_px = setpoint_px[held, number] - setpoint_px[began, number]
            for series, color, label in (
                (mirror_px[held, number], SKY, "mirror"),
                (offloaded_px, INK, "siderostat, set-point"),
            ):
                at_s, low, high = envelope(ticks["time_s"][held], series)
                axes.plot(at_s / time.s_per_unit, (low + high) / 2, color=color, label=label)
        axes.set(
            title=f"Offload in VERNIER, {axis}: motion of the star by either stage", ylabel="px"
        )
    legend_above(offload[0], 2)
    offload[-1].set_xlabel(time.label)
    span(offload[-1:], time, findings.run.duration_s)
    caption = (
        "What lasts goes from the mirror to the siderostat, and the mirror returns to its bias (0). The "
        "siderostat's own way is from where it was when each stretch of VERNIER began; its play is not in its "
        "encoders."
    )
    return Plot(f"{loop.name}-siderostat", "Siderostat and offload", caption, figure)


def tilt(findings: Findings, fringes: FringeFindings, time: TimeAxis) -> Plot:
    """The tilt between two loops' stars, and the visibility that it leaves."""
    overlap = fringes.overlap
    measured = ~np.isnan(overlap["visibility"])
    time_s = overlap["time_s"][measured]
    figure, (tilts, visibility) = panels(2, 4.4)
    for axis in AXES:
        tilt_arcsec = overlap[f"tilt_{axis}_arcsec"][measured]
        trace(tilts, time, time_s, tilt_arcsec, COLORS[axis], axis)
    trace(visibility, time, time_s, overlap["visibility"][measured], GREEN, "visibility")
    one, other = fringes.loops
    if len(fringes.rows):  # before, while a star is pulled in, the tilt is a hundred times larger
        tilts_arcsec = [overlap[f"tilt_{axis}_arcsec"][fringes.rows] for axis in AXES]
        shown = 1.3 * float(np.abs(tilts_arcsec).max())
        tilts.set_ylim(-shown, shown)
    if len(time_s):
        legend_above(tilts, 2)
    tilts.set(title=f"Tilt between the stars: {one} less {other}", ylabel="arcsec on the sky")
    visibility.set(
        title="Fringe visibility that the tilt leaves", xlabel=time.label, ylim=(0, 1.02)
    )
    span([visibility], time, findings.run.duration_s)
    caption = (
        "Each star from its loop's target in the rig file, on every frame on which both loops follow their "
        "stars, in COARSE too. The tilt is measured, so the camera's noise is in it and lowers the visibility "
        "a little."
    )
    return Plot("fringes-tilt", "Tilt and visibility", caption, figure)


def timing(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Age of frames, time of computation, lateness of the servo."""
    ticks = loop.ticks
    seconds = findings.gathered.timing[loop.name]
    frames = ticks["number"] >= 0
    figure, (age, compute, servo, distribution) = panels(2, 4.6, 2)
    at_s = ticks["time_s"][frames]
    age_ms, compute_ms = 1e3 * ticks["frame_age_s"][frames], 1e3 * ticks["compute_s"][frames]
    trace(age, time, at_s, age_ms, AZ, "age")
    trace(compute, time, at_s, compute_ms, GREEN, "compute")
    if len(seconds.get("servo_late_worst_s", ())):
        for name, color in (("worst", EL), ("median", AZ)):
            values = 1e3 * seconds[f"servo_late_{name}_s"]
            servo.plot(seconds["time_s"] / time.s_per_unit, values, color=color, label=name)
        servo.legend(ncols=2, loc="upper right")
    for axes, title in (
        (age, "Frame's age when it was used"),
        (compute, "Tick: from frame to command"),
        (servo, "Servo's wake-ups: late, a second at a time"),
    ):
        axes.set(title=title, xlabel=time.label, ylabel="ms")
    span((age, compute, servo), time, findings.run.duration_s)
    _exceeding(distribution, age_ms, AZ, "age")
    _exceeding(distribution, compute_ms, GREEN, "tick")
    distribution.set(title="How many take longer", xlabel="ms", ylabel="part of the frames")
    distribution.set_yscale("log")
    decimal(distribution.yaxis)
    distribution.legend(loc="upper right")
    caption = (
        "Controllers are designed for one fixed age of the frames. Where the machine stood still, all rise "
        "together."
    )
    return Plot(f"{loop.name}-timing", "Loop timing", caption, figure)


def _exceeding(axes: Axes, values: Floats, color: str, label: str) -> None:
    if len(values) == 0:
        return
    ordered = np.sort(values)
    above = 1 - np.arange(len(ordered)) / len(ordered)
    # All of the tail; of the crowd before it, some.
    last = len(ordered) - 1
    tail = np.arange(max(0, last - 300), last + 1)
    shown = np.unique(np.r_[np.linspace(0, last, 300).astype(int), tail])
    axes.step(ordered[shown], above[shown], color=color, label=label, where="post")
