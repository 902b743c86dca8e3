"""One run of a batch, compiled: what supervisor, loops, servos and simulated devices do, frame by frame.

It models the way from STANDBY to VERNIER or LOCKED, and back where a star or a beam is lost or goes out of
reach. It stops at what it does not model (a following error, a search that finds nothing), and the run is
simulated instead. `tests/simulation/test_batch.py` keeps both within 1e-9.

Everything is in records, which cost nothing to pass on, where numba counts references to an array: `s`, what
does not change (:mod:`fitctl.simulation.batch.settings`); `r`, the state of a loop (STAR or BEAM); `w`, what it
works with; `c` and `plant`, the plant's constants and state. Where these letters are doubled, they are the
records of all loops, with one of each stellar loop in `stars` and one of each metrology loop in `beams`. Axes
are azimuth and elevation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.model.compiled import compilable
from fitctl.simulation.batch.beam import fire_beam, tick_beam
from fitctl.simulation.batch.laws import command
from fitctl.simulation.batch.mirror import mirror_at, next_write_s, write_later, write_stacks
from fitctl.simulation.batch.modes import (
    ACQUIRE,
    OFF,
    POWER_UP,
    STANDBY,
    count_mode_time,
    evaluate,
    evaluate_waiting,
    fire,
    follow_link,
    follow_sky,
    linked_rad,
    observe,
    rest_search,
    use_design,
)
from fitctl.simulation.batch.plant import (
    advance_to,
    draw_own_air,
    draw_shared_air,
    keep_tilts,
    move_plant_stacks,
    noise_at,
    sum_beam_steps,
    sum_measured,
    sum_steps,
)
from fitctl.simulation.batch.records import DONE, FOLLOWING_ERROR, NOT_FOUND
from fitctl.simulation.batch.sensor import WHOLE_FRAME, find, sense
from fitctl.simulation.batch.siderostat import position_at, read_encoders, servo_period

Floats = NDArray[np.float64]


@compilable()
def power_up(ss: Any, rr: Any, ww: Any, pp: Any) -> None:
    """Devices open, which reads the encoders twice, and the siderostats are held where they are."""
    for i in range(len(ss.stars)):
        s, r = ss.stars[i], rr.stars[i]
        read_encoders(s, r, ww.stars[i], pp.stars[i])
        read_encoders(s, r, ww.stars[i], pp.stars[i])
        fire(ss, rr, i, POWER_UP)
        r.setpoint_is_new = 1
    for i in range(len(ss.beams)):
        b, r = ss.beams[i], rr.beams[i]
        read_encoders(b, r, ww.beams[i], pp.beams[i])
        read_encoders(b, r, ww.beams[i], pp.beams[i])
        fire_beam(ss, b, r, POWER_UP)
        r.setpoint_is_new = 1


@compilable()
def acquire(ss: Any, rr: Any) -> None:
    """All loops begin to search, the metrology loops first, or wait until they may."""
    for i in range(len(ss.beams)):
        fire_beam(ss, ss.beams[i], rr.beams[i], ACQUIRE)
    for i in range(len(ss.stars)):
        fire(ss, rr, i, ACQUIRE)


@compilable(inline=True)
def run_servos(ss: Any, rr: Any, ww: Any, pp: Any, now_s: float) -> bool:
    """A period of all servos; False where motors do not follow."""
    follow = True
    for i in range(len(ss.stars)):
        rr.stars[i].now_s = now_s
        follow &= servo_period(ss.stars[i], rr.stars[i], ww.stars[i], pp.stars[i])
    for i in range(len(ss.beams)):
        rr.beams[i].now_s = now_s
        follow &= servo_period(ss.beams[i], rr.beams[i], ww.beams[i], pp.beams[i])
    return follow


@compilable()
def expose(ss: Any, rr: Any, ww: Any, exposed_s: float) -> None:
    """A frame came: where the spots and the stages were at its exposure."""
    for i in range(len(ss.stars)):
        s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
        r.frames += 1
        r.exposed_s = exposed_s
        for instant in range(ss.instants):
            seen_s = exposed_s + ss.instants_s[instant]
            r.exposed_step[instant] = max(1, int(np.rint(seen_s / ss.step_s)))
            row = (r.exposed_step[instant] - 1) % ss.ring_steps
            for axis in range(2):
                r.exposed_px[instant, axis] = w.trace_px[row, axis]
        r.noise_dn = noise_at(ss, int(np.rint(exposed_s / ss.step_s)))
        position_at(s, r, w, exposed_s, r.motor_rad)
        mirror_at(s, r, w, exposed_s)


@compilable()
def read_beam(ss: Any, rr: Any, ww: Any, i: int, time_s: float) -> None:
    """Motor angles that turn a star as far as all siderostats did when its own motors were read."""
    s, r = ss.stars[i], rr.stars[i]
    r.sky_time_s = time_s
    if s.link >= 0:
        b = s.link
        position_at(ss.beams[b], rr.beams[b], ww.beams[b], time_s, r.link_motor_rad)
    r.beam_rad[0], r.beam_rad[1] = linked_rad(s, r, r.motor_rad[0], r.motor_rad[1])


@compilable()
def tick_star(
    ss: Any,
    rr: Any,
    ww: Any,
    i: int,
    exposed_s: float,
    air_random: Any,
    frame_dn: Floats,
    search_dn: Floats,
) -> bool:
    """One tick with a frame, up to the D/A; False where the search has ended without a star."""
    s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
    r.later_left = 0
    sensed = sense(ss, rr, ww, i)
    while sensed < 0:
        draw_own_air(ss, rr, ww, air_random, -sensed)
        sensed = sense(ss, rr, ww, i)
    if sensed == WHOLE_FRAME:
        find(ss, rr, ww, i, frame_dn, search_dn)
    observe(s, r)
    evaluate_waiting(ss, rr, i)
    if not r.waits and not evaluate(ss, rr, i, exposed_s):
        return False
    if s.link >= 0:
        follow_link(s, r, rr)
    follow_sky(s, r, rr)
    if not rest_search(s, r):
        command(s, r, w)
        r.later_s = exposed_s + s.later_after_s
    return True


@compilable()
def wait_for_frame(ss: Any, rr: Any, ww: Any, i: int) -> None:
    """One tick without a frame."""
    s, r = ss.stars[i], rr.stars[i]
    r.later_left = 0
    for axis in range(2):
        r.motor_rad[axis] = r.position_rad[axis]
    read_beam(ss, rr, ww, i, r.now_s)
    evaluate_waiting(ss, rr, i)
    if s.link >= 0:
        follow_link(s, r, rr)
    follow_sky(s, r, rr)
    rest_search(s, r)


@compilable()
def begin(ss: Any, rr: Any, ww: Any, cc: Any, pp: Any) -> None:
    """The stacks are at their bias."""
    for i in range(len(ss.stars)):
        move_plant_stacks(ss.stars[i], rr.stars[i], ww.stars[i], cc.stars[i], pp.stars[i])


@compilable()
def first_write_s(ss: Any, rr: Any) -> float:
    """When the next write of a D/A between frames is due; infinite without one."""
    due_s = math.inf
    for i in range(len(ss.stars)):
        due_s = min(due_s, next_write_s(rr.stars[i]))
    return due_s


@compilable()
def write_mirrors(ss: Any, rr: Any, ww: Any, cc: Any, pp: Any, now_s: float) -> None:
    """Write the D/As that are due between frames."""
    for i in range(len(ss.stars)):
        s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
        if next_write_s(r) <= now_s:
            r.now_s = now_s
            write_later(s, r, w, cc.stars[i], pp.stars[i])


@compilable(inline=True)
def tick(
    ss: Any,
    rr: Any,
    ww: Any,
    cc: Any,
    pp: Any,
    designs: Any,
    came: bool,
    exposed_s: float,
    air_random: Any,
    frame_dn: Floats,
    search_dn: Floats,
) -> bool:
    """A tick of all loops, the metrology loops first; False where a search has ended with nothing found."""
    if came:
        for d in range(len(designs)):
            if designs[d].frame == rr.stars[designs[d].star].frames:
                use_design(ss.stars[designs[d].star], rr, designs[d])
    for i in range(len(ss.beams)):
        if not tick_beam(ss, ss.beams[i], rr.beams[i], ww.beams[i], ss.stars[0].quantiles):
            return False
    if came:  # for all: a loop subtracts what others look at, where their stages had it
        for i in range(len(ss.stars)):
            read_beam(ss, rr, ww, i, exposed_s)
    for i in range(len(ss.stars)):
        s, r, w = ss.stars[i], rr.stars[i], ww.stars[i]
        if not came:
            wait_for_frame(ss, rr, ww, i)
        elif not tick_star(ss, rr, ww, i, exposed_s, air_random, frame_dn, search_dn):
            return False
        write_stacks(s, r, w, cc.stars[i], pp.stars[i])
        if came:
            sum_measured(r)
    return True


@compilable(inline=True)
def sum_residuals(ss: Any, rr: Any, ww: Any, pp: Any, now_s: float, tilt_px: Floats) -> None:
    """The plant has come to now: count what it did since the last call."""
    before = rr.stars[0].summed_to
    for i in range(len(ss.stars)):
        rr.stars[i].now_s = now_s
        sum_steps(ss.stars[i], rr.stars[i], ww.stars[i], pp.stars[i])
    for i in range(len(ss.beams)):
        rr.beams[i].now_s = now_s
        sum_beam_steps(ss.beams[i], rr.beams[i], ww.beams[i])
    if tilt_px.shape[0] > 0:
        keep_tilts(ss, rr, ww, before, tilt_px)


@compilable()
def finish(rr: Any) -> None:
    """The run is over: the last modes end."""
    for i in range(len(rr.stars)):
        count_mode_time(rr.stars[i])
    for i in range(len(rr.beams)):
        count_mode_time(rr.beams[i])


@compilable()
def keep_run(
    ss: Any, rr: Any, ww: Any, first: int, ticks: Any, true_px: Floats, samples: Any, beam_m: Floats
) -> None:
    """Keep a frame's states and the true places since the step `first`, as far as there is room."""
    frames, steps = rr.stars[0].frames, rr.stars[0].steps
    for i in range(len(ss.stars)):
        if 0 < frames <= ticks.shape[0]:
            ticks[frames - 1, i] = rr.stars[i]
        for step in range(first, min(steps, true_px.shape[0])):
            for axis in range(2):
                true_px[step, i, axis] = ww.stars[i].trace_px[step % ss.ring_steps, axis]
    for i in range(len(ss.beams)):
        if 0 < frames <= samples.shape[0]:
            samples[frames - 1, i] = rr.beams[i]
        for step in range(first, min(steps, beam_m.shape[0])):
            for axis in range(2):
                beam_m[step, i, axis] = ww.beams[i].offset_m[step % ss.ring_steps, axis]


@compilable()
def run(
    settings: Any,
    state: Any,
    work: Any,
    constants: Any,
    plant_state: Any,
    designs: Any,
    rates: Any,
    air_random: Any,
    array_m: Floats,
    star_rad: Floats,
    frame_dn: Floats,
    search_dn: Floats,
    tilt_px: Floats,
    ticks: Any,
    true_px: Floats,
    samples: Any,
    beam_m: Floats,
    duration_s: float,
) -> int:
    """One whole run: power up, acquire, hold.

    Parameters
    ----------
    settings, state, work, constants, plant_state : structured arrays, shape (1,)
        Of all loops. The state is the result; designs that change are written into the settings.
    designs : structured array of DESIGN, shape (n,)
        That replace those before them, in the order of their frames.
    rates : structured array of RATE, shape (n,)
        Of the camera, likewise; before them it runs as the rig file says.
    air_random : tuple of Generator
        One for each spot of the camera, then one for each metrology beam.
    array_m, star_rad : arrays, shape (steps, 2)
        Where the collector has the photodiodes, and how far it turns the starlight, after each step; the last
        for all steps that come after it.
    frame_dn, search_dn : arrays, shape (height, width)
        Room for whole frames.
    tilt_px : array, shape (n, 2)
        Receives how far the stars of the fringes are apart; its length is 0 without any.
    ticks : structured array of STAR, shape (frames, stars), true_px : array, shape (steps, stars, 2)
        Receive the states after each frame, and the true spots after each step, as far as there is room.
    samples : structured array of BEAM, shape (frames, beams), beam_m : array, shape (steps, beams, 2)
        Likewise of the beams.

    Returns
    -------
    int
        DONE, FOLLOWING_ERROR or NOT_FOUND.
    """
    ss, rr, ww, cc, pp = settings[0], state[0], work[0], constants[0], plant_state[0]
    drawn = frames = 0
    begin(ss, rr, ww, cc, pp)
    due_s = first_s = math.inf
    now_s, period_s = 0.0, ss.period_s
    mode = OFF
    while mode in (OFF, STANDBY) or now_s < duration_s:
        # Devices open in the first step, a period after the beginning; then frames come.
        exposed_s = first_s + frames * period_s
        came = exposed_s + ss.delay_s <= now_s + 2 * ss.period_s + 1e-9
        waited_s = ss.period_s if mode == OFF else 2 * ss.period_s
        until_s = exposed_s + ss.delay_s if came else now_s + waited_s
        while drawn * ss.step_s < until_s + ss.step_s:
            draw_shared_air(ss, rr, ww, air_random, drawn)
            drawn += ss.block_steps
        write_s = first_write_s(ss, rr)
        while min(due_s, write_s) <= until_s:
            now_s = max(now_s, min(due_s, write_s))
            advance_to(ss, rr, ww, cc, pp, now_s, array_m, star_rad)
            if due_s <= write_s:
                if not run_servos(ss, rr, ww, pp, now_s):
                    return FOLLOWING_ERROR
                due_s += ss.servo_period_s
            else:
                write_mirrors(ss, rr, ww, cc, pp, now_s)
                write_s = first_write_s(ss, rr)
        now_s = max(now_s, until_s)
        advance_to(ss, rr, ww, cc, pp, now_s, array_m, star_rad)
        before = rr.stars[0].summed_to
        sum_residuals(ss, rr, ww, pp, now_s, tilt_px)
        if mode == OFF:
            power_up(ss, rr, ww, pp)
            first_s, due_s = now_s + ss.exposure_s / 2, now_s + ss.servo_period_s
        elif mode == STANDBY:
            acquire(ss, rr)
        if came:
            frames += 1
            expose(ss, rr, ww, exposed_s)
            for n in range(len(rates)):
                if rates[n].frames == frames:  # the next is exposed a new period later
                    first_s += (frames - 1) * (period_s - rates[n].period_s)
                    period_s = rates[n].period_s
        if not tick(ss, rr, ww, cc, pp, designs, came, exposed_s, air_random, frame_dn, search_dn):
            return NOT_FOUND
        keep_run(ss, rr, ww, before, ticks, true_px, samples, beam_m)
        mode = rr.stars[0].mode
    finish(rr)
    return DONE
