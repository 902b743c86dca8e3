"""The simulated devices of a batched run, and the servo, as :mod:`fitctl.simulation.simulation` has them.

Records as in :mod:`fitctl.simulation.batch.step_kernels`; `c` are the plant's constants, `plant` its state.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.air_path import air_motion
from fitctl.model.compiled import compilable
from fitctl.model.plant_step import move_stacks, stack_piston_m, step_run
from fitctl.simulation.batch.settings import MOST_HISTORY
from fitctl.simulation.batch.step_kernels import (
    following_error_rad,
    mirror_written,
    servo_move_to,
    servo_step,
)

Floats = NDArray[np.float64]
_HISTORY = MOST_HISTORY - 1  # a power of two less one


# ---------------------------------------------------------------- the plant


@compilable()
def air_block(s: Any, w: Any, random: Any, spot: int, motion_px: Floats) -> None:
    """The next block of a spot's air path, drawn as ``Plant`` draws it."""
    for node in range(w.normals.shape[0]):
        for axis in range(2):
            w.normals[node, axis, 0] = random.standard_normal()
            w.normals[node, axis, 1] = random.standard_normal()
    weights = s.air_weights[: s.steps_per_node]
    air_motion(w.air[spot], w.normals, s.air_transition, s.air_noise_gain, weights, motion_px)


@compilable()
def judge_steps(s: Any, r: Any, w: Any, plant: Any) -> None:
    """Add the steps since the last call to what is judged, as far as they are late enough."""
    first = max(r.judged_to, r.judged_from - 1)
    if first < r.steps:
        az_sum, el_sum, row = 0.0, 0.0, first % s.ring_steps
        for _ in range(first, r.steps):
            az_px, el_px = w.trace_px[row, 0] - s.target_px[0], w.trace_px[row, 1] - s.target_px[1]
            az_sum += az_px * az_px
            el_sum += el_px * el_px
            row = row + 1 if row + 1 < s.ring_steps else 0
        steps, piston_m = r.steps - first, stack_piston_m(plant)
        r.true_sum_px2[0] += az_sum
        r.true_sum_px2[1] += el_sum
        r.piston_sum_m += steps * piston_m
        r.piston_sum_m2 += steps * piston_m**2
        r.judged_steps += steps
    r.judged_to = r.steps


@compilable(inline=True)
def advance_to(s: Any, r: Any, w: Any, c: Any, plant: Any) -> None:
    """``Plant.advance`` to now; the air must be there."""
    missing = int(np.rint(r.now_s / c.step_s)) - r.steps
    while missing > 0:
        count = min(missing, s.ring_steps - r.row)
        end = r.row + count
        step_run(c, plant, r.origin_px, w.air_px[r.row : end], w.trace_px[r.row : end])
        r.steps += count
        missing -= count
        r.row += count
        if r.row == s.ring_steps:
            r.row = 0


@compilable(inline=True)
def move_plant_stacks(s: Any, w: Any, c: Any, plant: Any) -> None:
    """Take the stacks to their volts."""
    n = s.plays
    move_stacks(c, plant, w.plays_v[:, :n], s.play_half_v[:n], s.play_gain_m_per_v[:n])


@compilable()
def set_stacks(s: Any, r: Any, w: Any, c: Any, plant: Any) -> None:
    """``SimulatedMirror.send_v``, ``MirrorStage.send`` and ``confirm``."""
    for stack in range(3):
        output_v = np.rint(r.stack_v[stack] / s.dac_step_v) * s.dac_step_v
        plant.stack_v[stack] = min(output_v, s.dac_most_v)
    move_plant_stacks(s, w, c, plant)
    mirror_written(s, r, w)
    entry = r.writes & _HISTORY
    w.written_s[entry] = r.now_s
    w.written_rad[entry, 0], w.written_rad[entry, 1] = r.mirror_rad[0], r.mirror_rad[1]
    r.writes += 1


@compilable()
def mirror_at(s: Any, r: Any, w: Any, time_s: float) -> None:
    """``MirrorStage.at``."""
    oldest = max(0, r.writes - s.writes)
    for write in range(r.writes - 1, oldest - 1, -1):
        entry = write & _HISTORY
        if w.written_s[entry] <= time_s or write == oldest:
            r.seen_mirror_rad[0] = w.written_rad[entry, 0]
            r.seen_mirror_rad[1] = w.written_rad[entry, 1]
            return


# ---------------------------------------------------------------- the siderostat


@compilable(inline=True)
def read_encoders(s: Any, r: Any, w: Any, plant: Any) -> None:
    """``SimulatedAmplifiers.exchange`` but for the command, and ``SiderostatServo._take``."""
    entry = r.readings & _HISTORY
    w.read_s[entry] = r.now_s
    for axis in range(2):
        counts = np.floor(plant.motor_rad[axis] / s.resolution_rad)
        r.position_rad[axis] = counts * s.resolution_rad
        w.read_rad[entry, axis] = r.position_rad[axis]
    r.readings += 1


@compilable(inline=True)
def servo_period(s: Any, r: Any, w: Any, c: Any, plant: Any) -> bool:
    """``SiderostatServo.period``; False where the motors do not follow."""
    if r.wish:
        servo_move_to(s, r)
        r.wish = 0
    servo_step(s, r)
    advance_to(s, r, w, c, plant)
    plant.velocity_rad_s[0], plant.velocity_rad_s[1] = r.velocity_rad_s[0], r.velocity_rad_s[1]
    read_encoders(s, r, w, plant)
    if following_error_rad(r) <= s.following_limit_rad:
        r.followed_s = r.now_s
    return r.now_s - r.followed_s <= s.following_s


@compilable()
def position_at(s: Any, r: Any, w: Any, time_s: float) -> None:
    """``SiderostatServo.position_at``."""
    oldest = max(0, r.readings - s.readings)
    for reading in range(r.readings - 1, oldest, -1):
        after, before = reading & _HISTORY, (reading - 1) & _HISTORY
        t1, t0 = w.read_s[after], w.read_s[before]
        if t0 <= time_s:
            part = min(1.0, (time_s - t0) / (t1 - t0)) if t1 > t0 else 1.0
            for axis in range(2):
                start_rad = w.read_rad[before, axis]
                r.motor_rad[axis] = start_rad + part * (w.read_rad[after, axis] - start_rad)
            return
    for axis in range(2):
        r.motor_rad[axis] = w.read_rad[oldest & _HISTORY, axis]
