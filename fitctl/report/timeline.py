"""Plots against time: modes and events, traces, stages, timing."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.report.drawing import (
    AZ,
    EL,
    FAINT,
    GREEN,
    INK,
    ORANGE,
    PURPLE,
    SKY,
    Plot,
    TimeAxis,
    envelope,
    panels,
    trace,
)
from fitctl.report.findings import AXES, Findings, LoopFindings
from fitctl.report.stages import motion_px
from fitctl.supervisor.modes import Mode

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.floating]
_MODE_COLORS = {
    Mode.OFF: FAINT,
    Mode.STANDBY: SKY,
    Mode.ACQUISITION: ORANGE,
    Mode.COARSE: PURPLE,
    Mode.VERNIER: GREEN,
    Mode.SAFE: EL,
    Mode.EXPERIMENT: AZ,
}
_SIGNS = {3: ("v", ORANGE, "warning"), 4: ("X", EL, "error")}  # by foxglove.Log's level
_COLORS = dict(zip(AXES, (AZ, EL), strict=True))
WINDOW_S = 10.0


def running_rms(loop: LoopFindings) -> tuple[Floats, dict[str, Floats]]:
    """Middles of windows of `WINDOW_S` and the RMS of each axis' error in VERNIER; NaN without a star."""
    ticks = loop.ticks
    held = (ticks["mode_number"] == Mode.VERNIER) & ticks["star_visible"]
    time_s = ticks["time_s"][held]
    if len(time_s) == 0:
        return np.empty(0), {axis: np.empty(0) for axis in AXES}
    window = np.floor(time_s / WINDOW_S).astype(int)
    first, last = window[0], window[-1]
    count = np.bincount(window - first, minlength=last - first + 1)
    rms = {}
    for axis in AXES:
        squares = ticks[f"error_{axis}_px"][held].astype(float) ** 2
        with np.errstate(invalid="ignore"):
            rms[axis] = np.sqrt(np.bincount(window - first, squares) / count)
    return (np.arange(first, last + 1) + 0.5) * WINDOW_S, rms


def timeline(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Modes, events and the residual, ten seconds at a time."""
    figure, (modes, residual) = panels(2, 3.6)
    for begin_s, end_s, mode in _spans(loop):
        modes.barh(
            0,
            (end_s - begin_s) / time.s_per_unit,
            left=begin_s / time.s_per_unit,
            height=0.6,
            color=_MODE_COLORS[mode],
            linewidth=0,
        )
    for mode in dict.fromkeys(mode for *_, mode in _spans(loop)):
        modes.barh(0, 0, color=_MODE_COLORS[mode], label=mode.name)
    for level, (sign, color, label) in _SIGNS.items():
        times_s = [event["time_s"] for event in findings.gathered.events if event["level"] == level]
        if times_s:
            at = np.array(times_s) / time.s_per_unit
            modes.plot(at, np.full(len(at), 0.55), sign, color=color, markersize=6, label=label)
    modes.set_ylim(-0.45, 0.8)
    modes.set_yticks([])
    modes.set_title("Modes and events")
    modes.legend(ncols=9, loc="lower left", bbox_to_anchor=(0.18, 0.98), borderaxespad=0)
    modes.grid(visible=False, axis="y")
    at_s, rms = running_rms(loop)
    for axis in AXES:
        marker = {"marker": "o", "markersize": 3.0} if len(at_s) < 60 else {}
        residual.plot(at_s / time.s_per_unit, rms[axis], color=_COLORS[axis], label=axis, **marker)
    residual.axhline(
        loop.requirement_px, color=INK, linestyle="--", label=f"requirement {loop.requirement_px:g} px"
    )
    residual.set_yscale("log")
    residual.set_ylabel("px")
    residual.set_title(f"RMS of the measured error in VERNIER, {WINDOW_S:g} s at a time")
    residual.set_xlabel(time.label)
    residual.legend(ncols=3, loc="best")
    caption = (
        "Above: the loop's mode; marks are warnings and errors of the whole instrument. Below: RMS about the "
        "target, steps and hand-over included."
    )
    return Plot(f"{loop.name}-timeline", "Timeline", caption, figure)


def _spans(loop: LoopFindings) -> list[tuple[float, float, Mode]]:
    ticks = loop.ticks
    numbers, time_s = ticks["mode_number"], ticks["time_s"]
    if len(numbers) == 0:
        return []
    apart = (np.diff(numbers) != 0) | (np.diff(time_s) > 1.0)
    begins = np.flatnonzero(np.r_[True, apart])
    ends = np.r_[begins[1:], len(numbers) - 1]
    # Up to the next tick, but not over a time without any.
    return [
        (time_s[begin], min(time_s[end], time_s[max(begin, end - 1)] + 1.0), Mode(int(numbers[begin])))
        for begin, end in zip(begins, ends, strict=True)
    ]


def traces(loop: LoopFindings, time: TimeAxis) -> Plot:
    """Error, target and flux."""
    ticks = loop.ticks
    frames = ticks["star_visible"]
    held = frames & (ticks["mode_number"] == Mode.VERNIER)
    figure, (error, target, flux) = panels(3, 5.4)
    for axis in AXES:
        series = (ticks["time_s"][held], ticks[f"error_{axis}_px"][held])
        trace(error, time, series, _COLORS[axis], axis)
        tracked = ticks["mode_number"] >= Mode.ACQUISITION
        trace(
            target,
            time,
            (ticks["time_s"][tracked], ticks[f"target_{axis}_px"][tracked]),
            _COLORS[axis],
            axis,
        )
    for sign in (-1, 1):
        error.axhline(sign * loop.requirement_px, color=INK, linestyle="--", linewidth=0.9)
    _limit(error, loop, held)
    trace(flux, time, (ticks["time_s"][frames], ticks["star_flux_dn"][frames]), GREEN, "flux")
    error.set_title("Error in VERNIER: star less target")
    error.set_ylabel("px")
    target.set_title("Target, as filtered")
    target.set_ylabel("px")
    flux.set_title("Light in the window")
    flux.set_ylabel("DN")
    flux.set_xlabel(time.label)
    error.legend(ncols=2, loc="upper right")
    caption = (
        "Dashed: the requirement, either side, for comparison with the error's size. Long series are bands from "
        "the lowest to the highest value of each piece of time."
    )
    return Plot(f"{loop.name}-traces", "Traces", caption, figure)


def _limit(axes: Axes, loop: LoopFindings, held: NDArray[np.bool_]) -> None:
    """So that a few frames of hand-over do not flatten the rest; what is beyond is said."""
    if not held.any():
        return
    errors = np.abs(np.concatenate([loop.ticks[f"error_{axis}_px"][held] for axis in AXES]))
    shown_px = max(1.3 * loop.requirement_px, 1.2 * float(np.quantile(errors, 0.995)))
    worst_px = float(errors.max())
    axes.set_ylim(-shown_px, shown_px)
    if worst_px > shown_px:
        axes.text(
            0.01, 0.04, f"up to {worst_px:.2f} px beyond", transform=axes.transAxes, fontsize=8
        )


def mirror(loop: LoopFindings, time: TimeAxis) -> Plot:
    """How much of its range the mirror uses, and its piston."""
    ticks = loop.ticks
    ready = ticks["mode_number"] >= Mode.COARSE
    figure, (fraction, piston) = panels(2, 3.8)
    trace(
        fraction,
        time,
        (ticks["time_s"][ready], 100 * ticks["fsm_range_fraction"][ready]),
        AZ,
        "range",
    )
    fraction.axhline(100.0, color=INK, linestyle="--", linewidth=0.9)
    fraction.set_ylim(0, 105)
    fraction.set_ylabel("% of the diamond")
    fraction.set_title("Range of the fast steering mirror: 100 % is the edge of what three stacks reach")
    if loop.stacks is not None:
        series = (ticks["time_s"][ready], 1e9 * loop.stacks.piston_m[ready])
        trace(piston, time, series, PURPLE, "piston")
    else:
        piston.text(
            0.5, 0.5, "not known: no hysteresis in the rig file", transform=piston.transAxes, ha="center"
        )
    piston.set_ylabel("nm")
    piston.set_title("Piston of the mirror (Eq. 4)")
    piston.set_xlabel(time.label)
    source = "" if loop.stacks is None else f" Piston is by {loop.stacks.source}, from the logged voltages."
    caption = f"From COARSE on.{source} Ideal stacks have none; the middle does not matter, changes do."
    return Plot(f"{loop.name}-mirror", "Mirror: range and piston", caption, figure)


def siderostat(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Where the siderostat is on the sky, and how the mirror hands over to it."""
    ticks = loop.ticks
    mirror_px, motor_px, setpoint_px = motion_px(findings.run.rig, loop.name, ticks)
    figure, (way, *offload) = panels(3, 5.8)
    for number, axis in enumerate(AXES):
        sky = motor_px[:, number] * loop.sky_arcsec_per_px
        trace(way, time, (ticks["time_s"], sky), _COLORS[axis], axis)
    way.set_title("Siderostat, from where it was first (encoders)")
    way.set_ylabel("arcsec on the sky")
    way.legend(ncols=2, loc="best")
    held = np.flatnonzero(ticks["mode_number"] == Mode.VERNIER)
    for number, (axis, axes) in enumerate(zip(AXES, offload, strict=True)):
        if len(held):
            from_px = setpoint_px[held[0], number]
            for series, color, label in (
                (mirror_px[held, number], SKY, "mirror"),
                (setpoint_px[held, number] - from_px, INK, "siderostat, set-point"),
            ):
                at_s, low, high = envelope(ticks["time_s"][held], series)
                axes.plot(at_s / time.s_per_unit, (low + high) / 2, color=color, label=label)
        axes.set_title(f"Offload in VERNIER, {axis}: motion of the star by either stage")
        axes.set_ylabel("px")
    offload[0].legend(ncols=2, loc="best")
    offload[-1].set_xlabel(time.label)
    caption = (
        "What lasts goes from the mirror to the siderostat, and the mirror returns to its bias (0). The "
        "siderostat's own way is from where it was when VERNIER first began; its play is not in its encoders."
    )
    return Plot(f"{loop.name}-siderostat", "Siderostat and offload", caption, figure)


def timing(findings: Findings, loop: LoopFindings, time: TimeAxis) -> Plot:
    """Age of frames, time of computation, lateness of the servo."""
    ticks = loop.ticks
    seconds = findings.gathered.timing[loop.name]
    frames = ticks["number"] >= 0
    figure, (age, compute, servo, distribution) = panels(2, 4.6, 2)
    at_s = ticks["time_s"][frames]
    trace(age, time, (at_s, 1e3 * ticks["frame_age_s"][frames]), AZ, "age")
    age.set_title("Frame's age when it was used")
    trace(compute, time, (at_s, 1e3 * ticks["compute_s"][frames]), GREEN, "compute")
    compute.set_title("Tick: from frame to command")
    if len(seconds.get("servo_late_worst_s", ())):
        for name, color in (("worst", EL), ("median", AZ)):
            values = 1e3 * seconds[f"servo_late_{name}_s"]
            servo.plot(seconds["time_s"] / time.s_per_unit, values, color=color, label=name)
        servo.legend(ncols=2, loc="upper right")
    servo.set_title("Servo's wake-ups: late, a second at a time")
    for axes in (age, compute, servo):
        axes.set_ylabel("ms")
        axes.set_xlabel(time.label)
    _exceeding(distribution, 1e3 * ticks["frame_age_s"][frames], AZ, "age")
    _exceeding(distribution, 1e3 * ticks["compute_s"][frames], GREEN, "tick")
    distribution.set_title("How many take longer")
    distribution.set_xlabel("ms")
    distribution.set_ylabel("part of the frames")
    distribution.set_yscale("log")
    distribution.legend(loc="upper right")
    caption = (
        "Controllers are designed for one fixed age of the frames. Where the machine stood still, all rise together."
    )
    return Plot(f"{loop.name}-timing", "Loop timing", caption, figure)


def _exceeding(axes: Axes, values: Floats, color: str, label: str) -> None:
    if len(values) == 0:
        return
    ordered = np.sort(values)
    above = 1 - np.arange(len(ordered)) / len(ordered)
    # All of the tail; of the crowd before it, some.
    shown = np.unique(np.r_[np.linspace(0, len(ordered) - 1, 300), len(ordered) - 1 - np.arange(min(300, len(ordered)))].astype(int))
    axes.step(ordered[shown], above[shown], color=color, label=label, where="post")
