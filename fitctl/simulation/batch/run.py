"""One run of a batch, compiled: what supervisor, loop, servo and simulated devices do, frame by frame.

It models the way from STANDBY to VERNIER, and back where the star is lost or goes out of reach. It stops at
what it does not model (a following error, a search that finds nothing), and the run is simulated instead.
`tests/simulation/test_batch.py` keeps both within 1e-9.

Everything is in records, which cost nothing to pass on, where numba counts references to an array: `s`, what
does not change (:func:`fitctl.simulation.batch.settings.batch_settings`); `r`, the state of a run (RUN); `w`,
what it works with (WORK). Axes are azimuth and elevation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable
from fitctl.simulation.batch.laws import command
from fitctl.simulation.batch.mirror import mirror_at, write_stacks
from fitctl.simulation.batch.modes import (
    ACQUIRE,
    OFF,
    POWER_UP,
    STANDBY,
    count_mode_time,
    evaluate,
    fire,
)
from fitctl.simulation.batch.plant import (
    advance_to,
    draw_air,
    move_plant_stacks,
    sum_measured,
    sum_steps,
)
from fitctl.simulation.batch.records import DONE, FOLLOWING_ERROR, NOT_FOUND
from fitctl.simulation.batch.sensor import WHOLE_FRAME, find, sense
from fitctl.simulation.batch.siderostat import position_at, read_encoders, servo_period

Floats = NDArray[np.float64]


@compilable()
def power_up(s: Any, r: Any, w: Any, plant: Any) -> None:
    """Devices open, which reads the encoders twice, and the siderostat is held where it is."""
    read_encoders(s, r, w, plant)
    read_encoders(s, r, w, plant)
    fire(s, r, POWER_UP)
    r.setpoint_is_new = 1


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
            draw_air(s, w, air_random[0], 0, w.air_px[row : row + s.block_steps])
            drawn += s.block_steps
        while due_s <= until_s:
            r.now_s = max(r.now_s, due_s)
            if not servo_period(s, r, w, c, plant):
                return FOLLOWING_ERROR
            due_s += s.servo.period_s
        r.now_s = max(r.now_s, until_s)
        advance_to(s, r, w, c, plant)
        before = r.summed_to
        sum_steps(s, r, w, plant)
        if r.mode == OFF:
            power_up(s, r, w, plant)
            first_s, due_s = r.now_s + s.exposure_s / 2, r.now_s + s.servo.period_s
        elif r.mode == STANDBY:
            fire(s, r, ACQUIRE)
        if came:
            r.frames += 1
            r.exposed_step = max(1, int(np.rint(exposed_s / c.step_s)))
            row = (r.exposed_step - 1) % s.ring_steps
            r.exposed_px[0], r.exposed_px[1] = w.trace_px[row, 0], w.trace_px[row, 1]
            position_at(s, r, w, exposed_s)
            mirror_at(s, r, w, exposed_s)
            sensed = sense(s, r, w)
            while sensed < 0:
                draw_air(s, w, air_random[-sensed], -sensed, w.own_px[-sensed, : s.block_steps])
                r.own_blocks[-sensed] += 1
                sensed = sense(s, r, w)
            if sensed == WHOLE_FRAME:
                find(s, r, w, frame_dn, search_dn)
            if not evaluate(s, r, exposed_s):
                return NOT_FOUND
            command(s, r, w)
        write_stacks(s, r, w, c, plant)
        if came:
            sum_measured(r, s.residual_settle_s)
        keep_run(s, r, w, before, ticks, true_px)
    count_mode_time(r)
    return DONE
