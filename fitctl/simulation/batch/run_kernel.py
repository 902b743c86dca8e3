"""One run of a batch, compiled: what supervisor, loop, servo and simulated devices do, frame by frame.

It knows the way from STANDBY to VERNIER, and back where the star is lost or goes out of reach. What it does
not know (a following error, a search that finds nothing) it leaves to the simulation itself: it stops,
and says so. A test holds the two together.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX
from fitctl.model.compiled import compilable
from fitctl.model.light import REACH_SIGMAS
from fitctl.model.optics import turned_back
from fitctl.simulation.batch.device_kernels import (
    advance_to,
    air_block,
    judge_steps,
    mirror_at,
    move_plant_stacks,
    position_at,
    read_encoders,
    servo_period,
    set_stacks,
)
from fitctl.simulation.batch.mode_kernels import (
    ACQUISITION,
    COARSE,
    OFF,
    STANDBY,
    VERNIER,
    change_mode,
    count_measured,
    judge,
    start_search,
)
from fitctl.simulation.batch.settings import DONE, FOLLOWING_ERROR, NOT_FOUND, SIDE_PX
from fitctl.simulation.batch.step_kernels import (
    find,
    measure,
    mirror_to,
    mirror_to_bias,
    pair_step,
    prefilter_step,
    siderostat_to,
    spiral_advance,
    spiral_is_there,
    stages_px,
    window_about,
)

Floats = NDArray[np.float64]
_SEEN, _LOOK = 1_000_001, 1_000_002


@compilable()
def power_up(s: Any, r: Any, w: Any, plant: Any) -> None:
    """Devices open, which reads the encoders twice, and the siderostat is held where it is."""
    read_encoders(s, r, w, plant)
    read_encoders(s, r, w, plant)
    change_mode(r, STANDBY)
    r.wish = 1


@compilable()
def spots_over(s: Any, r: Any, w: Any, left: int, top: int, width: int, height: int) -> int:
    """Spots of an exposure with light on some pixels: how many; NaN for the others.

    Where a further spot, whose own air has not been drawn so far, might matter: minus its number.
    """
    lit, block = 0, s.block_steps
    row = r.exposed_step - 1
    for spot in range(s.spots):
        az_px = r.exposed_px[0] + s.spot_offset_px[spot, 0]
        el_px = r.exposed_px[1] + s.spot_offset_px[spot, 1]
        reach_px = REACH_SIGMAS * s.sigma_px[spot] + 1.0 + (s.own_reach_px if spot > 0 else 0.0)
        if not (
            left - reach_px < az_px < left + width - 1 + reach_px
            and top - reach_px < el_px < top + height - 1 + reach_px
        ):
            w.spots_px[spot, 0] = w.spots_px[spot, 1] = math.nan
            continue
        if spot > 0:
            if r.own_blocks[spot] <= row // block:
                return -spot
            az_px += w.own_px[spot, row % block, 0] * s.air_relative
            el_px += w.own_px[spot, row % block, 1] * s.air_relative
        w.spots_px[spot, 0], w.spots_px[spot, 1] = az_px, el_px
        lit += 1
    return lit


@compilable()
def sense(s: Any, r: Any, w: Any) -> int:
    """``StellarLoop._find`` as far as a window tells: SEEN, or whether the whole frame must be looked at.

    Negative: the number of a spot that might matter, and needs more air first.
    """
    r.star_visible = 0
    if r.mode == ACQUISITION and not spiral_is_there(s, r):
        return _SEEN
    if (r.mode in (COARSE, VERNIER)) and r.lost == 0:
        az_px, el_px = stages_px(s, r)
        az = window_about(r.star_origin_px[0] + az_px, s.largest_az_px)
        el = window_about(r.star_origin_px[1] + el_px, s.largest_el_px)
        left, top = az - HALF_WINDOW_PX, el - HALF_WINDOW_PX
        lit = spots_over(s, r, w, left, top, SIDE_PX, SIDE_PX)
        if lit < 0:
            return lit
        if measure(s, r, w, az, el):
            return _SEEN
    lit = spots_over(s, r, w, 0, 0, s.width_px, s.height_px)
    if lit > 0 or (lit == 0 and not s.noise_is_dark):
        return _LOOK
    # Nothing but noise is there, and that alone finds no star.
    return lit


@compilable()
def command(s: Any, r: Any, w: Any) -> None:
    """The mode's control law."""
    if r.mode == VERNIER:
        prefilter_step(s, r)
        if r.star_visible:
            az_rad, el_rad = pair_step(s, r, w)
            mirror_to(s, r, w, az_rad, el_rad)
        return
    mirror_to_bias(s, r)
    if r.mode == COARSE:
        prefilter_step(s, r)
        if r.star_visible:
            error_az_px, error_el_px = turned_back(
                s.siderostat_turn, r.star_px[0] - r.command_px[0], r.star_px[1] - r.command_px[1]
            )
            siderostat_to(s, r, 0, r.setpoint_rad[0] - s.coarse_rad_per_px * error_az_px)
            siderostat_to(s, r, 1, r.setpoint_rad[1] - s.coarse_rad_per_px * error_el_px)
    elif r.mode == ACQUISITION and r.sighted:
        siderostat_to(s, r, 0, r.sighting_rad[0])
        siderostat_to(s, r, 1, r.sighting_rad[1])
    elif r.mode == ACQUISITION:
        spiral_advance(s, r)


@compilable()
def keep_run(s: Any, r: Any, w: Any, first: int, ticks: Any, true_px: Floats) -> None:
    """Keep a frame's state and the true spot since the step `first`, as far as there is room."""
    if 0 < r.frames <= ticks.shape[0]:
        ticks[r.frames - 1] = r
    for step in range(first, min(r.steps, true_px.shape[0])):
        for axis in range(2):
            true_px[step, axis] = w.trace_px[step % s.ring_steps, axis]


@compilable()
def run(
    settings: Any,
    state: Any,
    work: Any,
    constants: Any,
    plant_state: Any,
    air_random: Any,
    frame_dn: Floats,
    search_dn: Floats,
    ticks: Any,
    true_px: Floats,
    duration_s: float,
    settle_s: float,
) -> int:
    """One whole run: power up, acquire, hold.

    Parameters
    ----------
    settings, state, work : structured arrays, shape (1,)
        Of :func:`~fitctl.simulation.batch.settings.batch_settings`, RUN and WORK. The state is the
        result.
    constants, plant_state : structured arrays, shape (1,)
        As ``Plant`` has them.
    air_random : tuple of Generator
        One for each spot.
    frame_dn, search_dn : arrays, shape (height, width)
        Room for whole frames.
    ticks : structured array of RUN, true_px : array, shape (steps, 2)
        Receive the state after each frame, and the true spot after each step, as far as there is room.

    Returns
    -------
    int
        DONE, FOLLOWING_ERROR or NOT_FOUND.
    """
    s, r, w, c, plant = settings[0], state[0], work[0], constants[0], plant_state[0]
    drawn = 0
    move_plant_stacks(s, w, c, plant)
    due_s = first_s = math.inf
    while r.mode in (OFF, STANDBY) or r.now_s < duration_s:
        # Devices open in the first step, a period after the beginning; then frames come.
        exposed_s = first_s + r.frames * s.period_s
        came = exposed_s + s.delay_s <= r.now_s + 2 * s.period_s + 1e-9
        waited_s = s.period_s if r.mode == OFF else 2 * s.period_s
        until_s = exposed_s + s.delay_s if came else r.now_s + waited_s
        while drawn * c.step_s < until_s + c.step_s:
            row = drawn % s.ring_steps
            air_block(s, w, air_random[0], 0, w.air_px[row : row + s.block_steps])
            drawn += s.block_steps
        while due_s <= until_s:
            r.now_s = max(r.now_s, due_s)
            if not servo_period(s, r, w, c, plant):
                return FOLLOWING_ERROR
            due_s += s.servo_period_s
        r.now_s = max(r.now_s, until_s)
        advance_to(s, r, w, c, plant)
        before = r.judged_to
        judge_steps(s, r, w, plant)
        if r.mode == OFF:
            power_up(s, r, w, plant)
            first_s, due_s = r.now_s + s.exposure_s / 2, r.now_s + s.servo_period_s
        elif r.mode == STANDBY:
            start_search(s, r)
        if came:
            r.frames += 1
            r.exposed_step = max(1, int(np.rint(exposed_s / c.step_s)))
            row = (r.exposed_step - 1) % s.ring_steps
            r.exposed_px[0], r.exposed_px[1] = w.trace_px[row, 0], w.trace_px[row, 1]
            position_at(s, r, w, exposed_s)
            mirror_at(s, r, w, exposed_s)
            seen = sense(s, r, w)
            while seen < 0:
                air_block(s, w, air_random[-seen], -seen, w.own_px[-seen, : s.block_steps])
                r.own_blocks[-seen] += 1
                seen = sense(s, r, w)
            if seen == _LOOK:
                find(s, r, w, frame_dn, search_dn)
            if not judge(s, r, exposed_s, c.step_s, settle_s):
                return NOT_FOUND
            command(s, r, w)
        set_stacks(s, r, w, c, plant)
        if came:
            count_measured(r, settle_s)
        keep_run(s, r, w, before, ticks, true_px)
    change_mode(r, r.mode)
    return DONE
