"""Plots of what the stages did, and when the loop did it."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.identify.drawing import GREEN, PURPLE, SKY
from fitctl.messages.modes import FOLLOWING, Mode
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
    """How much of its range the mirror uses, and its piston where that is known."""
    ticks, found = loop.ticks, loop.stacks
    following = np.isin(ticks["mode_number"], sorted(FOLLOWING))
    name, title = f"{loop.name}-mirror", "Mirror: range and piston"
    if not following.any():
        return Plot(name, title, "the loop never held its star.", None)
    figure, axes = panels(1 if found is None else 2, 2.2 if found is None else 3.8)
    at_s = ticks["time_s"][following]
    trace(axes[0], time, at_s, 100 * ticks["fsm_range_fraction"][following], AZ, "range")
    limit(axes[0], 100.0)
    axes[0].set(
        title="Range of the fast steering mirror: 100 % is the edge of what three stacks reach",
        ylabel="% of the diamond",
        ylim=(0, 105),
    )
    source = " Piston is not known: the rig file has no hysteresis."
    if found is not None:
        piston_nm = 1e9 * found.piston_m
        trace(axes[1], time, at_s, piston_nm[following], PURPLE, "piston")
        axes[1].set(title="Piston of the mirror (Eq. 4)", ylabel="nm")
        # What counts sets the scale, and no ramp from a fault or to a star.
        shown_nm = (
            piston_nm[loop.selection.rows] if len(loop.selection.rows) else piston_nm[following]
        )
        low_nm, high_nm = float(shown_nm.min()), float(shown_nm.max())
        room_nm = max(1.0, 0.15 * (high_nm - low_nm))
        axes[1].set_ylim(low_nm - room_nm, high_nm + room_nm)
        source = (
            f" Piston is by {found.source}, from the logged voltages, on the scale of the evaluated part."
            " Ideal stacks have no piston. Only its changes matter, not its mean."
        )
    axes[-1].set_xlabel(time.label)
    span(axes[-1:], time, findings.run.duration_s)
    return Plot(name, title, f"In COARSE and VERNIER.{source}", figure)


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
        "The siderostat takes over lasting offsets from the mirror, which returns to its bias (0). The "
        "siderostat's own motion begins at 0 in each stretch of VERNIER; its encoders do not show its play."
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
        "stars, in COARSE too. The tilt is measured, so it includes camera noise, which lowers the "
        "visibility a little."
    )
    return Plot("fringes-tilt", "Tilt and visibility", caption, figure)


def timing(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Age of frames, time of computation, and lateness of the servo where it is logged."""
    ticks = loop.ticks
    seconds = findings.gathered.timing[loop.name]
    frames = ticks["number"] >= 0
    name, title = f"{loop.name}-timing", "Loop timing"
    if not frames.any():
        return Plot(name, title, "no frame came.", None)
    with_servo = bool(np.isfinite(seconds.get("servo_late_worst_s", np.empty(0))).any())
    figure, (age, compute, distribution, *servo) = (
        panels(2, 4.6, 2) if with_servo else panels(1, 2.6, 3)
    )
    at_s = ticks["time_s"][frames]
    age_ms, compute_ms = 1e3 * ticks["frame_age_s"][frames], 1e3 * ticks["compute_s"][frames]
    trace(age, time, at_s, age_ms, AZ, "age")
    trace(compute, time, at_s, compute_ms, GREEN, "compute")
    age.set_title("Frame's age when it was used")
    compute.set_title("Tick: from frame to command")
    for its in servo:
        for which, color in (("worst", EL), ("median", AZ)):
            values = 1e3 * seconds[f"servo_late_{which}_s"]
            its.plot(seconds["time_s"] / time.s_per_unit, values, color=color, label=which)
        its.legend(ncols=2, loc="upper right")
        its.set_title("Servo's wake-ups: late, a second at a time")
    over_time = (age, compute, *servo)
    for its in over_time:
        its.set(xlabel=time.label, ylabel="ms")
    span(over_time, time, findings.run.duration_s)
    _exceeding(distribution, age_ms, AZ, "age")
    _exceeding(distribution, compute_ms, GREEN, "tick")
    distribution.set(title="How many take longer", xlabel="ms", ylabel="part of the frames")
    distribution.set_yscale("log")
    decimal(distribution.yaxis)
    distribution.legend(loc="upper right")
    caption = (
        "Controllers are designed for one fixed age of the frames. All of them rise together "
        "when the machine stalls."
    )
    return Plot(name, title, caption, figure)


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
