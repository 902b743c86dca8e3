"""The plant of a batched run, and the sums over its steps. `c` are its constants, `plant` its state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.air_path import air_motion
from fitctl.model.compiled import compilable
from fitctl.model.plant_step import move_stacks, stack_piston_m, step_run

Floats = NDArray[np.float64]


@compilable()
def draw_air(s: Any, w: Any, random: Any, spot: int, motion_px: Floats) -> None:
    """The next block of a spot's air path, drawn as ``Plant`` draws it."""
    for node in range(w.normals.shape[0]):
        for axis in range(2):
            w.normals[node, axis, 0] = random.standard_normal()
            w.normals[node, axis, 1] = random.standard_normal()
    weights = s.air_weights[: s.steps_per_node]
    air_motion(w.air[spot], w.normals, s.air_transition, s.air_noise_gain, weights, motion_px)


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
def sum_steps(s: Any, r: Any, w: Any, plant: Any) -> None:
    """Add the steps since the last call to the sums of the residual, as far as they are late enough."""
    first = max(r.summed_to, r.residual_from - 1)
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
        r.residual_steps += steps
    r.summed_to = r.steps


@compilable()
def sum_measured(r: Any, settle_s: float) -> None:
    """Add a tick to the sums of the measured residual, if it is late enough."""
    if r.star_visible and r.now_s >= r.vernier_s + settle_s:
        for axis in range(2):
            error_px = r.star_px[axis] - r.command_px[axis]
            r.measured_sum_px2[axis] += error_px * error_px
        r.residual_frames += 1
