"""The fast steering mirror of a batched run: what ``Mirror``, ``MirrorStage`` and ``SimulatedMirror`` do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fitctl.model.compiled import compilable
from fitctl.model.hysteresis import play_output
from fitctl.model.optics import turned
from fitctl.simulation.batch.plant import move_plant_stacks
from fitctl.simulation.batch.records import MOST_HISTORY

_HISTORY = MOST_HISTORY - 1  # a power of two less one


@compilable(inline=True)
def mirror_px(s: Any, az_rad: float, el_rad: float) -> tuple[float, float]:
    """``Scales.mirror_px``."""
    az, el = turned(s.scale.mirror_turn, az_rad, el_rad)
    return s.scale.mirror_px_per_rad * az, s.scale.mirror_px_per_rad * el


@compilable()
def known_displacement_m(s: Any, w: Any, stack: int, volts: float) -> float:
    """Displacement of a stack from its zero by its identified hysteresis, once it has met `volts`."""
    n = s.known_plays
    gains = s.known_gains[stack, :n]
    return (
        play_output(w.known_plays_v[stack, :n], volts, s.known_half_v[:n], gains) - s.zero_m[stack]
    )


@compilable()
def mirror_written(s: Any, r: Any, w: Any) -> None:
    """``Mirror.written`` and ``Mirror.angles_rad``."""
    if s.hysteresis_known:
        d1 = known_displacement_m(s, w, 0, r.stack_v[0])
        d2 = known_displacement_m(s, w, 1, r.stack_v[1])
        d3 = known_displacement_m(s, w, 2, r.stack_v[2])
        r.mirror_rad[0] = (d2 - d3) / (2 * s.stack_radius_m)
        r.mirror_rad[1] = (d1 - d2) / (2 * s.stack_radius_m)
        return
    for axis in range(2):
        r.mirror_rad[axis] = 0.0
        for stack in range(3):
            r.mirror_rad[axis] += s.rad_per_stack_v[axis, stack] * (r.stack_v[stack] - s.bias_v)


@compilable()
def held_rad(s: Any, r: Any) -> tuple[float, float]:
    """``Mirror.held_rad``."""
    if s.inverse_wanted and s.hysteresis_known:
        return r.mirror_rad[0], r.mirror_rad[1]
    ideal_rad_per_v = s.scale_m_per_v / (2 * s.stack_radius_m)
    return (
        (r.stack_v[1] - r.stack_v[2]) * ideal_rad_per_v,
        (r.stack_v[0] - r.stack_v[1]) * ideal_rad_per_v,
    )


@compilable()
def inverse_volts(s: Any, w: Any, stack: int, wanted_m: float) -> float:
    """``Mirror.volts_for`` of one stack, by the inverse operator."""
    moved_m = 0.0
    for play in range(s.known_plays):
        moved_m += s.known_gains[stack, play] * w.known_plays_v[stack, play]
    slope = spread_m = before_m = inverse_slope = volts = 0.0
    for play in range(s.known_plays):
        gain, half_v = s.known_gains[stack, play], s.known_half_v[play]
        play_v = w.known_plays_v[stack, play]
        slope += gain
        spread_m += gain * half_v
        before_m += gain * play_v
        half_m = slope * half_v - spread_m
        state_m = slope * play_v + moved_m - before_m
        output_m = max(wanted_m - half_m, min(wanted_m + half_m, state_m))
        volts += output_m * (1.0 / slope - inverse_slope)
        inverse_slope = 1.0 / slope
    return volts


@compilable()
def mirror_to(s: Any, r: Any, w: Any, az_rad: float, el_rad: float) -> None:
    """``Mirror.volts_for``."""
    r.mirror_command_rad[0], r.mirror_command_rad[1] = az_rad, el_rad
    for stack in range(3):
        moved_m = s.stack_matrix[stack, 0] * az_rad + s.stack_matrix[stack, 1] * el_rad
        if s.inverse_wanted and s.hysteresis_known:
            volts = inverse_volts(s, w, stack, s.zero_m[stack] + moved_m)
        else:
            volts = moved_m / s.scale_m_per_v + s.bias_v
        r.stack_v[stack] = min(max(volts, 0.0), s.full_scale_v)


@compilable()
def mirror_to_bias(s: Any, r: Any) -> None:
    """``MirrorStage.step_to_bias``."""
    for stack in range(3):
        left_v = s.bias_v - r.stack_v[stack]
        r.stack_v[stack] += max(-s.slew_v, min(s.slew_v, left_v))
    r.mirror_command_rad[0], r.mirror_command_rad[1] = r.mirror_rad[0], r.mirror_rad[1]


@compilable()
def write_stacks(s: Any, r: Any, w: Any, c: Any, plant: Any) -> None:
    """``SimulatedMirror.send_v``, ``MirrorStage.send`` and ``confirm``."""
    for stack in range(3):
        output_v = np.rint(r.stack_v[stack] / s.dac_step_v) * s.dac_step_v
        plant.stack_v[stack] = min(output_v, s.dac_most_v)
    move_plant_stacks(s, r, w, c, plant)
    mirror_written(s, r, w)
    entry = r.writes & _HISTORY
    w.written_s[entry] = r.now_s
    w.written_rad[entry, 0], w.written_rad[entry, 1] = r.mirror_rad[0], r.mirror_rad[1]
    r.writes += 1


@compilable()
def next_write_s(r: Any) -> float:
    """When the next write between frames is due; infinite without one."""
    return float(r.later_s) if r.later_left > 0 else math.inf


@compilable()
def write_later(s: Any, r: Any, w: Any, c: Any, plant: Any) -> None:
    """``MirrorStage.write_due``."""
    mirror_to(s, r, w, r.later_rad[r.later, 0], r.later_rad[r.later, 1])
    write_stacks(s, r, w, c, plant)
    r.mirror_command_rad[0], r.mirror_command_rad[1] = r.mirror_rad[0], r.mirror_rad[1]
    r.later += 1
    r.later_left -= 1
    r.later_s += s.later_every_s


@compilable()
def mirror_at(s: Any, r: Any, w: Any, time_s: float) -> None:
    """``MirrorStage.at``."""
    oldest = max(0, r.writes - s.writes)
    for write in range(r.writes - 1, oldest - 1, -1):
        entry = write & _HISTORY
        if w.written_s[entry] <= time_s or write == oldest:
            r.exposed_mirror_rad[0] = w.written_rad[entry, 0]
            r.exposed_mirror_rad[1] = w.written_rad[entry, 1]
            return
