"""The metrology loop of a batched run: what ``MetrologyLoop`` and ``SimulatedPhotodiodes`` do."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ARCSEC_PER_RAD
from fitctl.controllers.beam_hold import hold_step, pull_in_step
from fitctl.controllers.frame_counts import CONFIRMED, REJECTED, count_sample, look_again
from fitctl.controllers.photodiodes import LOST, MEASURED, beam_state, place_m
from fitctl.controllers.search_rounds import round_fraction
from fitctl.controllers.spiral import spiral_angle_after
from fitctl.loop.metrology import IN_REACH, MOST_TICK_S, OUT_OF_REACH
from fitctl.messages.modes import METROLOGY_TRANSITIONS, Mode, Trigger, transition
from fitctl.model.compiled import compilable
from fitctl.model.image.pixel_noise import GOLDEN, QUANTILE_SHIFT, mix
from fitctl.model.metrology.photodiodes import light_v
from fitctl.model.optics import turned_back
from fitctl.simulation.batch.laws import ACQUISITION, COARSE
from fitctl.simulation.batch.modes import (
    LOCKED,
    OFF,
    begin_residual,
    count_mode_time,
)
from fitctl.simulation.batch.records import MOST_REQUESTS
from fitctl.simulation.batch.siderostat import position_at, siderostat_to

Floats = NDArray[np.float64]
BEAM_FOUND, BEAM_LOST = int(Trigger.BEAM_FOUND), int(Trigger.BEAM_LOST)
BEAM_IN_REACH, BEAM_OUT_OF_REACH = int(Trigger.IN_REACH), int(Trigger.OUT_OF_REACH)
# The mode that each trigger leads to from each mode; its own where the trigger means nothing.
_TARGETS = np.array(
    [
        [
            row.target if (row := transition(mode, trigger, METROLOGY_TRANSITIONS)) else mode
            for trigger in Trigger
        ]
        for mode in Mode
    ],
    dtype=np.int64,
)


@compilable()
def sample(s: Any, r: Any, w: Any, quantiles: Floats) -> None:
    """``SimulatedPhotodiodes.receive`` and ``PhotodiodeArray.beam``."""
    r.has_sample, sampled_s = 0, math.nan
    while r.received < r.requested:
        requested_s = r.requested_s[r.received % MOST_REQUESTS]
        if requested_s + s.round_trip_s > r.now_s + 1e-9:
            break
        sampled_s = requested_s + s.round_trip_s / 2
        r.received += 1
    if math.isnan(sampled_s):
        return
    r.has_sample, r.sampled_s = 1, sampled_s
    r.taken += 1
    row = (max(1, int(np.rint(sampled_s / s.step_s))) - 1) % s.ring_steps
    az_m, el_m = w.offset_m[row, 0], w.offset_m[row, 1]
    number = mix(r.noise_key + np.uint64(r.taken) * GOLDEN)
    brightest_v = highest_v = -math.inf
    dimmest_v = math.inf
    for axis in range(2):
        plus_v = minus_v = 0.0
        for side in range(2):
            diode = 2 * axis + side
            along_m = (az_m if axis == 0 else el_m) * (1 - 2 * side)
            bits = mix(number + np.uint64(diode + 1) * GOLDEN)
            volts = light_v(s.truth, along_m, az_m**2 + el_m**2) + s.truth.ambient_v[diode]
            volts += s.truth.noise_v * quantiles[bits >> QUANTILE_SHIFT]
            volts = np.rint(max(-s.range_v, min(s.range_v, volts)) / s.volt_step) * s.volt_step
            lit_v = volts - s.ambient_v[diode]
            highest_v = max(highest_v, volts)
            brightest_v, dimmest_v = max(brightest_v, lit_v), min(dimmest_v, lit_v)
            plus_v, minus_v = (lit_v, minus_v) if side == 0 else (plus_v, lit_v)
        r.place_m[axis] = place_m(s.array, plus_v, minus_v)
    r.beam_state = beam_state(s.array, brightest_v, dimmest_v, highest_v)
    if r.beam_state != LOST:
        r.samples += 1


# ---------------------------------------------------------------- modes


@compilable()
def fire_beam(ss: Any, b: Any, r: Any, trigger: int) -> None:
    """``MetrologyLoop.fire``."""
    again = r.mode in (COARSE, LOCKED)
    count_mode_time(r)
    r.mode, r.mode_since_s = _TARGETS[r.mode, trigger], r.now_s
    r.lost = r.in_reach = r.out_of_reach = 0
    if r.mode == ACQUISITION:
        for axis in range(2):
            r.spiral_centre_rad[axis] = r.position_rad[axis]
        r.again = 1 if again and b.search_again_s != 0 else 0
        r.has_candidate, r.search_since_s = 0, math.nan
        begin_beam_round(b, r, 0)
    elif r.mode == COARSE and math.isnan(r.acquired_s):
        r.acquired_s = r.now_s
    elif r.mode == LOCKED:
        r.rate_rad_s[0] = r.rate_rad_s[1] = 0.0
        if math.isnan(r.held_s):
            begin_residual(ss, r)


@compilable()
def begin_beam_round(b: Any, r: Any, number: int) -> None:
    """``BeamSearch._begin_round``."""
    fraction = round_fraction(number) if r.again else 1.0
    r.round, r.spiral_angle = number, 0.0
    r.pause_s = fraction * b.search_again_pause_s if r.again else 0.0
    r.spiral_radius_px = fraction * b.search_radius_px + b.spiral.pitch_px / 2


@compilable()
def evaluate_beam_search(ss: Any, b: Any, r: Any) -> bool:
    """``BeamSearch.evaluate``; False where the search has ended without a beam."""
    has_light = r.beam_state != LOST
    if math.isnan(r.search_since_s):
        r.search_since_s = r.sampled_s
    if r.has_candidate:
        outcome = look_again(b.acquisition, r.candidate, has_light, r.sampled_s)
        if outcome == CONFIRMED:
            fire_beam(ss, b, r, BEAM_FOUND)
        elif outcome == REJECTED:
            r.has_candidate = 0
    elif has_light:
        r.has_candidate, r.candidate.since_s, r.candidate.frames = 1, r.sampled_s, 0
        for axis in range(2):
            r.candidate.motor_rad[axis] = r.motor_rad[axis]
    elif r.again and r.sampled_s - r.search_since_s > b.search_again_s:
        return False
    elif b.spiral.growth_px * r.spiral_angle >= r.spiral_radius_px:
        if not r.again:
            return False
        begin_beam_round(b, r, r.round + 1)
    return True


@compilable()
def evaluate_beam(ss: Any, b: Any, r: Any) -> bool:
    """``MetrologyLoop._evaluate_findings``; False where the search has ended without a beam."""
    if not r.has_sample:
        return True
    if r.mode == ACQUISITION:
        return evaluate_beam_search(ss, b, r)
    if r.mode not in (COARSE, LOCKED):
        return True
    error_m = max(abs(r.place_m[0]), abs(r.place_m[1]))
    error = error_m / b.sensor_length_m * ARCSEC_PER_RAD / b.requirement_arcsec
    lost, measured = r.beam_state == LOST, r.beam_state == MEASURED
    count_sample(r, lost, measured, error, IN_REACH, OUT_OF_REACH)
    if r.lost >= b.acquisition.lost_frames:
        fire_beam(ss, b, r, BEAM_LOST)
    elif r.mode == COARSE and r.in_reach >= b.acquisition.found_frames:
        fire_beam(ss, b, r, BEAM_IN_REACH)
    elif r.mode == LOCKED and r.out_of_reach >= b.acquisition.lost_frames:
        fire_beam(ss, b, r, BEAM_OUT_OF_REACH)
    return True


# ---------------------------------------------------------------- control laws


@compilable()
def search_beam(b: Any, r: Any, duration_s: float) -> None:
    """``BeamSearch.advance``, and the siderostat with it."""
    if r.has_candidate:
        siderostat_to(b, r, r.candidate.motor_rad[0], r.candidate.motor_rad[1])
    elif r.pause_s > 0:
        r.pause_s -= duration_s
        siderostat_to(b, r, r.spiral_centre_rad[0], r.spiral_centre_rad[1])
    else:
        angle = r.spiral_angle = spiral_angle_after(b.spiral, r.spiral_angle, duration_s)
        radius_rad = b.rad_per_px * b.spiral.growth_px * angle
        siderostat_to(
            b,
            r,
            r.spiral_centre_rad[0] + radius_rad * math.cos(angle),
            r.spiral_centre_rad[1] + radius_rad * math.sin(angle),
        )


@compilable()
def turn_by(b: Any, r: Any, az_rad: float, el_rad: float) -> None:
    """``MetrologyLoop._turn_beam``."""
    az_rad, el_rad = turned_back(b.turn, az_rad, el_rad)
    siderostat_to(
        b,
        r,
        r.setpoint_rad[0] + az_rad / b.sky_rad_per_motor_rad,
        r.setpoint_rad[1] + el_rad / b.sky_rad_per_motor_rad,
    )


@compilable(inline=True)
def limited(az: float, el: float, most: float) -> tuple[float, float]:
    """``fitctl.loop.metrology.limited``."""
    part = min(1.0, most / max(abs(az), abs(el), 1e-12))
    return az * part, el * part


@compilable()
def hold_beam(b: Any, r: Any, duration_s: float) -> None:
    """``MetrologyLoop._pull_in`` and ``_hold_beam``."""
    has_beam = r.has_sample and r.beam_state != LOST
    az_rad, el_rad = r.place_m[0] / b.sensor_length_m, r.place_m[1] / b.sensor_length_m
    if r.mode == COARSE and has_beam:
        az_rad = pull_in_step(b.hold, az_rad, duration_s)
        el_rad = pull_in_step(b.hold, el_rad, duration_s)
        az_rad, el_rad = limited(az_rad, el_rad, b.pull_in_rad_s * duration_s)
        turn_by(b, r, az_rad, el_rad)
    elif r.mode == LOCKED and has_beam:
        az_rad, el_rad = limited(az_rad, el_rad, b.hold_most_rad)
        az_rad, r.rate_rad_s[0] = hold_step(b.hold, r.rate_rad_s[0], az_rad, duration_s)
        el_rad, r.rate_rad_s[1] = hold_step(b.hold, r.rate_rad_s[1], el_rad, duration_s)
        turn_by(b, r, az_rad, el_rad)
    elif r.mode == LOCKED:
        turn_by(b, r, r.rate_rad_s[0] * duration_s, r.rate_rad_s[1] * duration_s)


@compilable()
def tick_beam(ss: Any, b: Any, r: Any, w: Any, quantiles: Floats) -> bool:
    """One tick; False where the search has ended without a beam."""
    sample(b, r, w, quantiles)
    if r.has_sample:
        position_at(b, r, w, r.sampled_s, r.motor_rad)
    else:
        for axis in range(2):
            r.motor_rad[axis] = r.position_rad[axis]
    if not evaluate_beam(ss, b, r):
        return False
    duration_s = 0.0 if math.isnan(r.ticked_s) else min(r.now_s - r.ticked_s, MOST_TICK_S)
    r.ticked_s = r.now_s
    if r.mode == ACQUISITION:
        search_beam(b, r, duration_s)
    else:
        hold_beam(b, r, duration_s)
    if r.mode != OFF:
        r.requested_s[r.requested % MOST_REQUESTS] = r.now_s
        r.requested += 1
    return True
