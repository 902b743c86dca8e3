"""The model's inner loops compiled by numba, one scalar at a time.

Each does what a NumPy function named in its docstring does, and a test holds the two together. Import
this module through :func:`fitctl.model.compiled.kernels`, which is None where numba is not installed.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import jit, jit_fused, jit_inlined
from fitctl.model.light import PER_SIGMA, REACH_SIGMAS

Floats = NDArray[np.float64]
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_MIX1, _MIX2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_S27, _S30, _S31, _S48 = np.uint64(27), np.uint64(30), np.uint64(31), np.uint64(48)


@jit_fused
def air_motion(
    state: Floats,
    normals: Floats,
    transition: Floats,
    noise_gain: Floats,
    weights: Floats,
    motion_px: Floats,
) -> None:
    """:func:`fitctl.model.air_path.air_motion`, into `motion_px`, shape (nodes * steps, 2)."""
    nodes, steps = normals.shape[0], weights.shape[0]
    for axis in range(2):
        x0, v0 = state[axis, 0], state[axis, 1]
        for node in range(nodes):
            n0, n1 = normals[node, axis, 0], normals[node, axis, 1]
            x1 = transition[0, 0] * x0 + transition[0, 1] * v0
            x1 += noise_gain[0, 0] * n0 + noise_gain[0, 1] * n1
            v1 = transition[1, 0] * x0 + transition[1, 1] * v0
            v1 += noise_gain[1, 0] * n0 + noise_gain[1, 1] * n1
            for step in range(steps):
                motion_px[node * steps + step, axis] = (
                    weights[step, 0] * x0
                    + weights[step, 1] * v0
                    + weights[step, 2] * x1
                    + weights[step, 3] * v1
                )
            x0, v0 = x1, v1
        state[axis, 0], state[axis, 1] = x0, v0


@jit_inlined
def turned(turn: Floats, az: float, el: float) -> Any:
    """A pair, by a matrix of shape (2, 2)."""
    return turn[0, 0] * az + turn[0, 1] * el, turn[1, 0] * az + turn[1, 1] * el


@jit_inlined
def turned_back(turn: Floats, az: float, el: float) -> Any:
    """A pair, by the transpose of a matrix of shape (2, 2)."""
    return turn[0, 0] * az + turn[1, 0] * el, turn[0, 1] * az + turn[1, 1] * el


@jit_inlined
def play_output(plays: Floats, value: float, half_width: Floats, gain: Floats) -> float:
    """Output of parallel plays, shape (n,) each, after they met `value`; they are moved on."""
    total = 0.0
    for element in range(plays.shape[0]):
        half = half_width[element]
        output = max(value - half, min(value + half, plays[element]))
        plays[element] = output
        total += output * gain[element]
    return total


@jit_inlined
def move_stacks(c: Any, s: Any, plays_v: Floats, half_v: Floats, gain_m_per_v: Floats) -> None:
    """Take the stacks of one run to their volts. They are static: without a change nothing moves."""
    for stack in range(3):
        volts = s.stack_v[stack]
        if volts != s.stacks_at_v[stack]:
            s.stacks_at_v[stack] = volts
            output_m = play_output(plays_v[stack], volts, half_v, gain_m_per_v)
            s.displacement_m[stack] = output_m - c.mid_stroke_m


@jit_fused
def step_run(c: Any, s: Any, origin_px: Floats, air_px: Floats, spot_px: Floats) -> None:
    """A step for each row, of one run and its first spot; stacks stand still. Shapes (2,), twice (rows, 2).

    Both axes and modes go side by side: each is a chain of dependent sums, and four run in the time of
    one.
    """
    mirror_az = (s.displacement_m[1] - s.displacement_m[2]) / (2 * c.stack_radius_m)
    mirror_el = (s.displacement_m[0] - s.displacement_m[1]) / (2 * c.stack_radius_m)
    # On the focal plane: what of the mirror does not go through the modes, and each mode's part.
    turned_az, turned_el = turned(c.mirror_turn, mirror_az, mirror_el)
    still_az_px = origin_px[0] + c.mirror_px_per_rad * (1 - c.participation) * turned_az
    still_el_px = origin_px[1] + c.mirror_px_per_rad * (1 - c.participation) * turned_el
    mode_px = c.mirror_px_per_rad * c.participation
    shape_az1, shape_el1 = turned(c.mirror_turn, c.mode_shape[0, 0], c.mode_shape[0, 1])
    shape_az2, shape_el2 = turned(c.mirror_turn, c.mode_shape[1, 0], c.mode_shape[1, 1])
    az_px1, el_px1 = mode_px * shape_az1, mode_px * shape_el1
    az_px2, el_px2 = mode_px * shape_az2, mode_px * shape_el2
    drive1 = mirror_az * c.mode_shape[0, 0] + mirror_el * c.mode_shape[0, 1]
    drive2 = mirror_az * c.mode_shape[1, 0] + mirror_el * c.mode_shape[1, 1]
    a1, b1, c1, d1 = (
        c.mode_transition[0, 0, 0], c.mode_transition[0, 0, 1],
        c.mode_transition[0, 1, 0], c.mode_transition[0, 1, 1],
    )  # fmt: skip
    a2, b2, c2, d2 = (
        c.mode_transition[1, 0, 0], c.mode_transition[1, 0, 1],
        c.mode_transition[1, 1, 0], c.mode_transition[1, 1, 1],
    )  # fmt: skip
    to_place1, to_rate1 = c.mode_gain[0, 0] * drive1, c.mode_gain[0, 1] * drive1
    to_place2, to_rate2 = c.mode_gain[1, 0] * drive2, c.mode_gain[1, 1] * drive2
    place1, rate1 = s.modes[0, 0], s.modes[0, 1]
    place2, rate2 = s.modes[1, 0], s.modes[1, 1]
    decay, half, motor_px = c.amplifier_decay, c.backlash_half_rad, c.motor_px_per_rad
    catch_up_s = c.amplifier_lag_s * (1 - decay)
    command_az, command_el = s.velocity_rad_s[0], s.velocity_rad_s[1]
    moved_az, moved_el = command_az * c.step_s, command_el * c.step_s
    motor_az, lead_az, beam_az = s.motor_rad[0], s.motor_rad_s[0] - command_az, s.beam_motor_rad[0]
    motor_el, lead_el, beam_el = s.motor_rad[1], s.motor_rad_s[1] - command_el, s.beam_motor_rad[1]
    for row in range(spot_px.shape[0]):
        place1, rate1 = to_place1 + b1 * rate1 + a1 * place1, to_rate1 + d1 * rate1 + c1 * place1
        place2, rate2 = to_place2 + b2 * rate2 + a2 * place2, to_rate2 + d2 * rate2 + c2 * place2
        motor_az += moved_az + lead_az * catch_up_s
        motor_el += moved_el + lead_el * catch_up_s
        lead_az *= decay
        lead_el *= decay
        beam_az = max(motor_az - half, min(motor_az + half, beam_az))
        beam_el = max(motor_el - half, min(motor_el + half, beam_el))
        turned_az, turned_el = turned(c.siderostat_turn, beam_az, beam_el)
        spot_px[row, 0] = (
            still_az_px + az_px1 * place1 + az_px2 * place2 + motor_px * turned_az
            + air_px[row, 0]
        )  # fmt: skip
        spot_px[row, 1] = (
            still_el_px + el_px1 * place1 + el_px2 * place2 + motor_px * turned_el
            + air_px[row, 1]
        )  # fmt: skip
    s.modes[0, 0], s.modes[0, 1], s.modes[1, 0], s.modes[1, 1] = place1, rate1, place2, rate2
    s.motor_rad[0], s.motor_rad_s[0], s.beam_motor_rad[0] = motor_az, command_az + lead_az, beam_az
    s.motor_rad[1], s.motor_rad_s[1], s.beam_motor_rad[1] = motor_el, command_el + lead_el, beam_el


@jit
def piston_m(s: Any) -> float:
    """Eq. 4: the origin lies midway between stacks 1 and 3, so that it is their mean."""
    return (s.displacement_m[0] + s.displacement_m[2]) / 2


@jit
def advance(
    constants: Any,
    play_half_v: Floats,
    play_gain_m_per_v: Floats,
    state: Any,
    plays_v: Floats,
    origin_px: Floats,
    air_px: Floats,
    trace_px: Floats,
    trace_piston_m: Floats,
    air_from: int,
    trace_from: int,
    steps: int,
) -> None:
    """:func:`fitctl.model.plant_step.advance_reference`."""
    c = constants[0]
    for run in range(trace_px.shape[1]):
        s = state[run]
        move_stacks(c, s, plays_v[run], play_half_v, play_gain_m_per_v)
        step_run(
            c, s, origin_px[run, 0], air_px[air_from : air_from + steps, run, 0],
            trace_px[trace_from : trace_from + steps, run, 0],
        )  # fmt: skip
        trace_piston_m[trace_from : trace_from + steps, run] = piston_m(s)
        for spot in range(1, trace_px.shape[2]):
            for axis in range(2):
                apart_px = origin_px[run, spot, axis] - origin_px[run, 0, axis]
                for row in range(steps):
                    trace_px[trace_from + row, run, spot, axis] = (
                        trace_px[trace_from + row, run, 0, axis]
                        + apart_px
                        + air_px[air_from + row, run, spot, axis]
                    )


@jit_inlined
def mix(word: Any) -> Any:
    """SplitMix64's finalizer."""
    word = (word ^ (word >> _S30)) * _MIX1
    word = (word ^ (word >> _S27)) * _MIX2
    return word ^ (word >> _S31)


@jit_inlined
def light_fractions(
    first: int, centre_px: float, sigma_px: float, table: Floats, fraction: Floats
) -> Any:
    """Part of a spot's light on pixels ``first + k``; returns the first and the end of those that get any.

    What :func:`fitctl.model.light.light_below` says of the edges.
    """
    reach_px = REACH_SIGMAS * sigma_px
    low = max(0, math.ceil(centre_px - reach_px - 0.5) - first)
    high = min(len(fraction), math.floor(centre_px + reach_px + 0.5) - first + 1)
    below = 0.0
    for edge in range(low, high + 1):
        distance = (first + edge - 0.5 - centre_px) / sigma_px
        place = (min(max(distance, -REACH_SIGMAS), REACH_SIGMAS) + REACH_SIGMAS) * PER_SIGMA
        interval = min(int(place), len(table) - 1)
        x = place - interval
        c3, c2, c1, c0 = (
            table[interval, 0], table[interval, 1], table[interval, 2], table[interval, 3],
        )  # fmt: skip
        above = ((c3 * x + c2) * x + c1) * x + c0
        if edge > low:
            fraction[edge - 1] = above - below
        below = above
    return low, max(low, high)


@jit_inlined
def render(
    light_dn: Floats,
    first_row: int,
    first_column: int,
    width_px: int,
    positions_px: Floats,
    flux_dn: Floats,
    sigma_px: Floats,
    spots: int,
    bias_dn: float,
    noise_dn: float,
    full_dn: float,
    key: Any,
    number: int,
    table: Floats,
    light: Floats,
    down: Floats,
    across: Floats,
) -> None:
    """:meth:`fitctl.model.scene.Scene.frame`, or a part of it, whole numbers into `light_dn`.

    A spot at NaN is left out. `down` and `across` are room for a column and a row.
    """
    rows, columns = light_dn.shape
    for row in range(rows):
        for column in range(columns):
            light_dn[row, column] = bias_dn
    for spot in range(spots):
        az_px, el_px = positions_px[spot, 0], positions_px[spot, 1]
        if math.isnan(az_px):
            continue
        left, right = light_fractions(first_column, az_px, sigma_px[spot], light, across)
        if left >= right:
            continue
        top, bottom = light_fractions(first_row, el_px, sigma_px[spot], light, down)
        for row in range(top, bottom):
            row_dn = flux_dn[spot] * down[row]
            for column in range(left, right):
                light_dn[row, column] += row_dn * across[column]
    frame = mix(key + np.uint64(number) * _GOLDEN)
    for row in range(rows):
        pixel = (first_row + row) * width_px + first_column + 1
        for column in range(columns):
            bits = mix(frame + np.uint64(pixel + column) * _GOLDEN)
            noisy = light_dn[row, column] + noise_dn * table[bits >> _S48]
            light_dn[row, column] = min(max(np.rint(noisy), 0.0), full_dn)
