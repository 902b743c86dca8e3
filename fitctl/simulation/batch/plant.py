"""The plant of a batched run, and the sums over its steps. `c` are its constants, `plant` its state."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.air_path import air_motion
from fitctl.model.compiled import compilable
from fitctl.model.image.pixel_noise import GOLDEN, QUANTILE_SHIFT, mix
from fitctl.model.lines import line_motion
from fitctl.model.metrology.part import turn_beam
from fitctl.model.plant_step import move_stacks, stack_piston_m, step_creeping_run, step_run
from fitctl.simulation.batch.records import BLOCK_NODES

Floats = NDArray[np.float64]


@compilable(inline=True)
def epoch_at(s: Any, node: int) -> int:
    """Number of the epoch in which a node is."""
    number = 0
    while s.epochs[number + 1].from_node <= node:
        number += 1
    return number


@compilable()
def noise_at(ss: Any, step: int) -> float:
    """``Plant.pixel_noise_dn`` of a frame exposed at a step."""
    number = 0
    while ss.noises[number + 1].from_step <= step:
        number += 1
    return float(ss.noises[number].dn)


@compilable()
def draw_normals(w: Any, random: Any) -> None:
    """What moves the air in the next block."""
    for node in range(w.normals.shape[0]):
        for axis in range(2):
            w.normals[node, axis, 0] = random.standard_normal()
            w.normals[node, axis, 1] = random.standard_normal()


@compilable()
def draw_air(s: Any, w: Any, random: Any, path: int, motion: Floats) -> None:
    """The next block of a beam's air, drawn as ``Plant`` draws it."""
    draw_normals(w, random)
    weights = s.air_weights[: s.steps_per_node]
    air_motion(w.air[path], w.normals, s.air_transition, s.air_noise_gain, weights, motion)


@compilable()
def draw_star_air(
    s: Any, w: Any, random: Any, path: int, first_node: int, motion_px: Floats
) -> None:
    """The next block of the air of a star or one of its spots, which may change within it."""
    draw_normals(w, random)
    steps, nodes, node = s.steps_per_node, w.normals.shape[0], 0
    weights = s.air_weights[:steps]
    while node < nodes:
        number = epoch_at(s, first_node + node)
        end = min(nodes, s.epochs[number + 1].from_node - first_node)
        epoch = s.epochs[number]
        air_motion(
            w.air[path], w.normals[node:end], epoch.air_transition, epoch.air_noise_gain, weights,
            motion_px[node * steps : end * steps],
        )  # fmt: skip
        node = end


@compilable()
def draw_own_air(ss: Any, rr: Any, ww: Any, air_random: Any, number: int) -> None:
    """The next block of what the spot of that number on the camera has of its own."""
    for i in range(len(ss.stars)):
        s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
        spot = number - s.first_spot
        if 0 <= spot < s.spots:
            first_node = r.own_blocks[spot] * BLOCK_NODES
            row = first_node * s.steps_per_node % s.ring_steps
            own_px = w.own_px[spot, row : row + s.block_steps]
            draw_star_air(s, w, air_random[number], spot, first_node, own_px)
            r.own_blocks[spot] += 1


@compilable()
def add_lines(s: Any, r: Any, w: Any, first_node: int, step_s: float, motion_px: Floats) -> None:
    """``StellarPart._add_lines``, over a block."""
    steps, nodes, node = s.steps_per_node, w.kicks.shape[0], 0
    while node < nodes:
        number = epoch_at(s, first_node + node)
        end = min(nodes, s.epochs[number + 1].from_node - first_node)
        epoch = s.epochs[number]
        n = epoch.line_count
        for row in range(node, end):
            word = mix(r.line_key + np.uint64(first_node + row + 1) * GOLDEN)
            for line in range(n):
                bits = mix(word + np.uint64(line + 1) * GOLDEN)
                w.kicks[row, line] = s.quantiles[bits >> QUANTILE_SHIFT]
        since_s = (first_node + node - epoch.from_node) * steps * step_s
        line_motion(
            epoch.lines[:n], w.lines[:n], w.kicks[node:end, :n], since_s, steps, step_s,
            motion_px[node * steps : end * steps],
        )  # fmt: skip
        node = end


@compilable()
def draw_shared_air(ss: Any, rr: Any, ww: Any, air_random: Any, drawn: int) -> None:
    """The next block of what moves all spots of a star, and of the air that moves a beam.

    `drawn` is the number of steps for which that is done.
    """
    row = drawn % ss.ring_steps
    for i in range(len(ss.stars)):
        s, w = ss.stars[i], ww.stars[i]
        motion_px = w.air_px[row : row + s.block_steps]
        first_node = drawn // s.steps_per_node
        draw_star_air(s, w, air_random[s.first_spot], 0, first_node, motion_px)
        add_lines(s, rr.stars[i], w, first_node, ss.step_s, motion_px)
        if s.star_moves:
            for step in range(s.block_steps):
                for axis in range(2):
                    time_s = (drawn + step + 1) * ss.step_s
                    motion_px[step, axis] += time_s * s.star_rate_px_s[axis]
    for i in range(len(ss.beams)):
        b, x = ss.beams[i], ww.beams[i]
        draw_air(b, x, air_random[b.air_number], 0, x.air_rad[row : row + b.block_steps])


@compilable(inline=True)
def at_step(course: Floats, step: int, axis: int) -> float:
    """One axis of what is known at each step; the last for all that come after it."""
    return float(course[min(step, course.shape[0] - 1), axis])


@compilable()
def step_beam(
    s: Any, r: Any, w: Any, c: Any, plant: Any, row: int, end: int, array_m: Floats
) -> None:
    """``MetrologyPart.step``; `array_m` is where the collector has the photodiodes at each step."""
    turn_beam((c,), (plant,), r.misaligned_rad, w.beam_rad[row:end])
    for step in range(row, end):
        for axis in range(2):
            beam_rad = w.beam_rad[step, 0, axis] + w.air_rad[step, axis]
            array = at_step(array_m, r.steps + step - row, axis)
            w.offset_m[step, axis] = s.link_length_m * beam_rad - array
    r.steps += end - row
    r.row = end if end < s.ring_steps else 0


@compilable()
def turn_light(s: Any, r: Any, w: Any, beams: Any, row: int, end: int, star_rad: Floats) -> None:
    """``StellarPart.step``, before the step itself: what turns a star's light on its way over the link."""
    for step in range(row, end):
        for axis in range(2):
            turned_rad = beams[s.link].beam_rad[step, 0, axis]
            turned_rad += at_step(star_rad, r.steps + step - row, axis)
            w.air_px[step, axis] += s.sky_px_per_rad * turned_rad


@compilable(inline=True)
def advance_to(
    ss: Any, rr: Any, ww: Any, cc: Any, pp: Any, now_s: float, array_m: Floats, star_rad: Floats
) -> None:
    """``Plant.advance``; the air must be there."""
    missing = int(np.rint(now_s / ss.step_s)) - rr.stars[0].steps
    while missing > 0:
        row = rr.stars[0].row
        count = min(missing, ss.ring_steps - row)
        end = row + count
        for i in range(len(ss.beams)):
            step_beam(
                ss.beams[i], rr.beams[i], ww.beams[i], cc.beams[i], pp.beams[i], row, end, array_m
            )
        for i in range(len(ss.stars)):
            s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
            if s.link >= 0:
                turn_light(s, r, w, ww.beams, row, end, star_rad)
            c, air_px, trace_px = cc.stars[i], w.air_px[row:end], w.trace_px[row:end]
            if c.creep_per_decade > 0:
                piston_m = w.piston_m[row:end]
                step_creeping_run(c, pp.stars[i], r.origin_px, air_px, trace_px, piston_m, r.steps)
            else:
                step_run(c, pp.stars[i], r.origin_px, air_px, trace_px)
            r.steps += count
            r.row = end if end < ss.ring_steps else 0
        missing -= count


@compilable(inline=True)
def move_plant_stacks(s: Any, r: Any, w: Any, c: Any, plant: Any) -> None:
    """Take the stacks to their volts, with the hysteresis that they have now (``StellarPart._begin_epoch``)."""
    n, number = s.plays, epoch_at(s, r.steps // s.steps_per_node)
    gains = s.epochs[number].play_gain_m_per_v
    if number != r.hysteresis_epoch:
        before = s.epochs[r.hysteresis_epoch].play_gain_m_per_v
        for stack in range(3):
            for play in range(n):
                carried_m = (before[play] - gains[play]) * w.plays_v[stack, play]
                plant.carried_m[stack] += carried_m
        r.hysteresis_epoch = number
    move_stacks(c, plant, w.plays_v[:, :n], s.play_half_v[:n], gains[:n])


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
        r.true_sum2[0] += az_sum
        r.true_sum2[1] += el_sum
        r.piston_sum_m += steps * piston_m
        r.piston_sum_m2 += steps * piston_m**2
        r.residual_steps += steps
    r.summed_to = r.steps


@compilable()
def sum_beam_steps(s: Any, r: Any, w: Any) -> None:
    """:func:`sum_steps` of a beam."""
    first = max(r.summed_to, r.residual_from - 1)
    for step in range(first, r.steps):
        for axis in range(2):
            r.true_sum2[axis] += w.offset_m[step % s.ring_steps, axis] ** 2
    r.residual_steps += max(0, r.steps - first)
    r.summed_to = r.steps


@compilable()
def sum_measured(r: Any) -> None:
    """Add a tick to the sums of the measured residual, if it is late enough."""
    if r.star_visible and r.now_s >= r.residual_from_s:
        for axis in range(2):
            error_px = r.star_px[axis] - r.command_px[axis]
            r.measured_sum_px2[axis] += error_px * error_px
        r.residual_frames += 1


@compilable()
def keep_tilts(ss: Any, rr: Any, ww: Any, before: int, tilt_px: Floats) -> None:
    """Keep how far the stars of the fringes are apart beside their targets, every few steps while both hold."""
    one, other = ss.fringe_stars[0], ss.fringe_stars[1]
    start = max(rr.stars[one].residual_from, rr.stars[other].residual_from) - 1
    for step in range(max(before, start), rr.stars[one].steps):
        kept, beside = divmod(step - start, ss.tilt_every)
        if beside == 0 and kept < tilt_px.shape[0]:
            row = step % ss.ring_steps
            for axis in range(2):
                one_px = ww.stars[one].trace_px[row, axis] - ss.stars[one].target_px[axis]
                other_px = ww.stars[other].trace_px[row, axis] - ss.stars[other].target_px[axis]
                tilt_px[kept, axis] = one_px - other_px
            rr.tilts = kept + 1
