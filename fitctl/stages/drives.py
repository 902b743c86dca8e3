"""Whether an experiment's motions are ones that a rig can make."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.model.drives import FSM, SIDEROSTAT, STACKS, Drive, experiment_s
from fitctl.model.optics import scales
from fitctl.stages.injector import PERIOD_S, stack_v_per_px

MOST_S = 600.0
MOST_HZ = 0.5 / PERIOD_S  # quicker, the voltages written would show another motion
_SLACK = 1 + 1e-9


def refused_drives(rig: Rig, loop_name: str, drives: list[Drive]) -> str:
    """Why the motions cannot be made, or nothing: too long, too quick, or beyond a stage's range.

    Motions at the same time are taken at their largest together.
    """
    why_not = _refused_numbers(drives)
    if why_not:
        return why_not
    loop = rig.stellar_loops[loop_name]
    scale = scales(rig, loop)
    fsm = loop.fsm
    per_px = stack_v_per_px(fsm.stack_radius_m, fsm.stack_scale_m_per_v, scale.mirror_px_per_rad)
    reach_v = min(fsm.bias_v, fsm.dac.full_scale_v - fsm.bias_v)
    travel_px = loop.siderostat.travel_sky_arcsec / scale.sky_arcsec_per_px
    for drive in drives:
        together = [other for other in drives if _overlap(drive, other)]
        swing_v = _largest(together, STACKS) + np.abs(per_px) @ _largest(together, FSM)
        if swing_v.max() > reach_v * _SLACK:
            return f"a stack would swing {swing_v.max():.2f} V about its bias; it has {reach_v:g} V"
        if _largest(together, SIDEROSTAT).max() > travel_px:
            return f"the siderostat would leave its travel of {travel_px:.0f} px"
    return ""


def _refused_numbers(drives: list[Drive]) -> str:
    """Why no rig could make the motions, or nothing."""
    if not all(math.isfinite(value) for drive in drives for value in _numbers(drive)):
        return "every number of a motion must be finite"
    if any(drive.start_s < 0 or drive.duration_s <= 0 for drive in drives):
        return "a motion must begin with the experiment or later, and last"
    duration_s = experiment_s(drives)
    if not 0 < duration_s <= MOST_S:
        return f"it would take {duration_s:g} s; up to {MOST_S:g} s are allowed"
    if not all(0 <= hz <= MOST_HZ for drive in drives for hz in _frequencies_hz(drive)):
        return f"frequencies must lie in 0 to {MOST_HZ:.1f} Hz"
    return ""


def _numbers(drive: Drive) -> list[float]:
    return [
        drive.amplitude,
        drive.end_amplitude or 0.0,
        *_frequencies_hz(drive),
        drive.start_s,
        drive.duration_s,
    ]


def _frequencies_hz(drive: Drive) -> tuple[float, float]:
    return drive.frequency_hz, drive.end_frequency_hz or 0.0


def _overlap(one: Drive, other: Drive) -> bool:
    return (
        one.start_s < other.start_s + other.duration_s
        and other.start_s < one.start_s + one.duration_s
    )


def _largest(drives: list[Drive], channels: tuple[str, ...]) -> NDArray[np.float64]:
    """The largest that the drives together ask of each channel."""
    most = np.zeros(len(channels))
    for drive in drives:
        if drive.channel in channels:
            most[channels.index(drive.channel)] += max(
                abs(drive.amplitude), abs(drive.end_amplitude or 0.0)
            )
    return most
