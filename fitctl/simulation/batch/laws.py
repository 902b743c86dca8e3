"""Control laws of a batched run: search, COARSE, and the pair of a design, behind one prefilter."""

from __future__ import annotations

import math
from typing import Any

from fitctl.controllers.prefilter import filtered
from fitctl.controllers.spiral import spiral_angle_after
from fitctl.messages.modes import Mode
from fitctl.model.compiled import compilable
from fitctl.model.optics import turned
from fitctl.simulation.batch.mirror import held_rad, mirror_px, mirror_to, mirror_to_bias
from fitctl.simulation.batch.siderostat import motor_rad, siderostat_to

ACQUISITION, COARSE, VERNIER = int(Mode.ACQUISITION), int(Mode.COARSE), int(Mode.VERNIER)
NOT_DUE, ANEW, AGAIN = -1, 0, 1  # a search that waits until it may begin


@compilable()
def step_prefilter(s: Any, r: Any) -> None:
    """``Prefilter.step`` towards the target."""
    for axis in range(2):
        r.command_px[axis], r.command_rate[axis] = filtered(
            s.target_px[axis],
            r.command_px[axis],
            r.command_rate[axis],
            s.prefilter.periods,
            s.prefilter.decay,
        )


@compilable()
def spiral_place_rad(s: Any, r: Any) -> tuple[float, float]:
    """``Search._spiral_place_rad``."""
    radius_px = s.spiral.growth_px * r.spiral_angle
    az_rad, el_rad = motor_rad(
        s, radius_px * math.cos(r.spiral_angle), radius_px * math.sin(r.spiral_angle)
    )
    return r.spiral_centre_rad[0] + az_rad, r.spiral_centre_rad[1] + el_rad


@compilable()
def has_arrived(s: Any, r: Any) -> bool:
    """``Search.has_arrived``."""
    if not r.has_arrived:
        away_rad = 0.0
        spiral_rad = spiral_place_rad(s, r)
        for axis in range(2):
            beside_rad = r.beam_rad[axis] - r.motor_rad[axis]
            own_rad = max(-s.travel_rad, min(s.travel_rad, spiral_rad[axis] - beside_rad))
            away_rad = max(away_rad, abs(r.motor_rad[axis] - own_rad))
        r.has_arrived = away_rad * s.scale.motor_px_per_rad <= s.near_px
    return bool(r.has_arrived)


@compilable()
def search_at(s: Any, r: Any, az_rad: float, el_rad: float) -> None:
    """The siderostat to where the search wants all that turns the star to be; link and sky are there."""
    r.beyond_rad[0] = r.beyond_rad[1] = 0.0
    siderostat_to(
        s,
        r,
        az_rad - (r.undone_rad[0] - r.link_origin_rad[0]) - r.sky_undone_rad[0],
        el_rad - (r.undone_rad[1] - r.link_origin_rad[1]) - r.sky_undone_rad[1],
    )


@compilable()
def advance_search(s: Any, r: Any) -> None:
    """``Search.advance`` by one frame, and the siderostat with it."""
    if r.has_candidate:
        search_at(s, r, r.candidate.motor_rad[0], r.candidate.motor_rad[1])
    elif not has_arrived(s, r):
        az_rad, el_rad = spiral_place_rad(s, r)
        search_at(s, r, az_rad, el_rad)
    elif r.pause_s > 0:
        r.pause_s -= s.period_s
        search_at(s, r, r.spiral_centre_rad[0], r.spiral_centre_rad[1])
    else:
        r.spiral_angle = spiral_angle_after(s.spiral, r.spiral_angle, s.period_s)
        az_rad, el_rad = spiral_place_rad(s, r)
        search_at(s, r, az_rad, el_rad)


@compilable()
def step_coarse(s: Any, r: Any) -> None:
    """``Pointing.step_coarse``, and the siderostat with it."""
    az_px, el_px = turned(
        s.scale.siderostat_back, r.star_px[0] - r.command_px[0], r.star_px[1] - r.command_px[1]
    )
    siderostat_to(
        s,
        r,
        r.setpoint_rad[0] - s.coarse_step_rad_per_px * az_px,
        r.setpoint_rad[1] - s.coarse_step_rad_per_px * el_px,
    )


@compilable()
def start_pair(s: Any, r: Any, beam_az_rad: float, beam_el_rad: float) -> None:
    """``Pair.start`` from where the mirror is, and all siderostats together."""
    az_rad, el_rad = held_rad(s, r)
    held_px = mirror_px(s, az_rad, el_rad)
    for axis in range(2):
        for state in range(s.pair_states - 1):
            r.pair_state[axis, state] = held_px[axis] * s.pair_at_rest[state]
        r.pair_state[axis, s.pair_states - 1] = held_px[axis] * s.pair_left_at_rest
        r.excess_px[axis] = 0.0
        r.motor_origin_rad[axis] = beam_az_rad if axis == 0 else beam_el_rad
        r.target_origin_px[axis] = r.command_px[axis]


@compilable()
def step_pair(s: Any, r: Any, w: Any) -> None:
    """``Pair.step``, and both stages with it."""
    mirrors = turned(s.scale.mirror_turn, r.exposed_mirror_rad[0], r.exposed_mirror_rad[1])
    motors = turned(
        s.scale.siderostat_turn,
        r.beam_rad[0] - r.motor_origin_rad[0],
        r.beam_rad[1] - r.motor_origin_rad[1],
    )
    wanted_az = wanted_el = step_az = step_el = 0.0
    for axis in range(2):
        w.pair_inputs[0] = r.star_px[axis] - r.command_px[axis]
        w.pair_inputs[1] = r.excess_px[axis]
        w.pair_inputs[2] = mirrors[axis]
        w.pair_inputs[3] = motors[axis]
        w.pair_inputs[4] = r.command_px[axis] - r.target_origin_px[axis]
        for state in range(s.pair_states):
            w.pair_inputs[5 + state] = r.pair_state[axis, state]
        for row in range(2 + s.pair_states):
            total = 0.0
            for column in range(5 + s.pair_states):
                total += s.pair_system[row, column] * w.pair_inputs[column]
            if row >= 2:
                r.pair_state[axis, row - 2] = total
            elif row == 0:
                wanted_az, wanted_el = (total, wanted_el) if axis == 0 else (wanted_az, total)
            else:
                step_az, step_el = (total, step_el) if axis == 0 else (step_az, total)
        for write in range(s.later_writes):
            total = 0.0
            for column in range(5 + s.pair_states):
                total += s.pair_later[write, column] * w.pair_inputs[column]
            r.later_rad[write, axis] = total
    step_az, step_el = turned(s.scale.siderostat_back, step_az, step_el)
    siderostat_to(s, r, r.setpoint_rad[0] + step_az, r.setpoint_rad[1] + step_el)
    wanted_az, wanted_el = turned(s.scale.mirror_back, wanted_az, wanted_el)
    within = min(1.0, s.range_rad / max(abs(wanted_az) + abs(wanted_el), 1e-300))
    beyond = 1.0 - within
    r.excess_px[0], r.excess_px[1] = mirror_px(s, wanted_az * beyond, wanted_el * beyond)
    mirror_to(s, r, w, wanted_az * within, wanted_el * within)
    for write in range(s.later_writes):
        later_az, later_el = turned(
            s.scale.mirror_back, r.later_rad[write, 0], r.later_rad[write, 1]
        )
        within = min(1.0, s.range_rad / max(abs(later_az) + abs(later_el), 1e-300))
        r.later_rad[write, 0], r.later_rad[write, 1] = later_az * within, later_el * within
    r.later, r.later_left = 0, s.later_writes


@compilable()
def command(s: Any, r: Any, w: Any) -> None:
    """The mode's control law."""
    if r.mode != VERNIER:
        mirror_to_bias(s, r)
    if r.mode == ACQUISITION:
        advance_search(s, r)
        return
    step_prefilter(s, r)
    if r.star_visible and r.mode == COARSE:
        step_coarse(s, r)
    elif r.star_visible:
        step_pair(s, r, w)
