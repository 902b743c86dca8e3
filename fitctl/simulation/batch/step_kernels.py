"""The tick of a batched run, part by part: what it does is what the classes named in each docstring do.

Everything is in records, which cost nothing to hand on, where an array in numba is counted: `s`, what does
not change (:func:`fitctl.simulation.batch.settings.batch_settings`); `r`, the state of a run (RUN); `w`,
what it works with (WORK). Axes are azimuth and elevation.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import HALF_WINDOW_PX
from fitctl.controllers.centroid import EDGE_PX, LARGEST_PEAK, MAX_CANDIDATES
from fitctl.model.compiled import compilable
from fitctl.model.hysteresis import play_output
from fitctl.model.optics import turned, turned_back
from fitctl.model.scene import render
from fitctl.simulation.batch.settings import SIDE_PX

Floats = NDArray[np.float64]


# ---------------------------------------------------------------- position servo


@compilable(inline=True)
def limited(value: float, most: float) -> float:
    """`value` within +-`most`."""
    return most if value > most else -most if value < -most else value


@compilable()
def servo_move_to(s: Any, r: Any) -> None:
    """``PositionServo.move_to`` the set-point."""
    for axis in range(2):
        r.servo_target_rad[axis] = r.setpoint_rad[axis]
        step_rad = (r.setpoint_rad[axis] - r.servo_reference_rad[axis]) / s.servo_periods
        r.servo_step_rad[axis] = limited(step_rad, s.velocity_limit_rad_s * s.servo_period_s)


@compilable(inline=True)
def servo_step(s: Any, r: Any) -> None:
    """``PositionServo.step``, from the last reading to a velocity command."""
    for axis in range(2):
        if abs(r.servo_target_rad[axis] - r.servo_reference_rad[axis]) <= abs(
            r.servo_step_rad[axis]
        ):
            r.servo_reference_rad[axis] = r.servo_target_rad[axis]
        else:
            r.servo_reference_rad[axis] += r.servo_step_rad[axis]
        error_rad = r.servo_reference_rad[axis] - r.position_rad[axis]
        if abs(error_rad) < s.resolution_rad:
            error_rad = 0.0
        wanted = limited(s.servo_gain_per_s * error_rad, s.velocity_limit_rad_s)
        r.velocity_rad_s[axis] += limited(
            wanted - r.velocity_rad_s[axis], s.acceleration_limit_rad_s2 * s.servo_period_s
        )


@compilable(inline=True)
def following_error_rad(r: Any) -> float:
    """``PositionServo.following_error_rad``."""
    return max(
        abs(r.servo_reference_rad[0] - r.position_rad[0]),
        abs(r.servo_reference_rad[1] - r.position_rad[1]),
    )


# ---------------------------------------------------------------- what a frame shows


@compilable(inline=True)
def centroid(
    s: Any, light_dn: Floats, first_row: int, first_column: int, window_az: int, window_el: int
) -> Any:
    """``StarSensor._centroid`` about a window on a part of the frame: azimuth, elevation, flux.

    All nan where there is no light, or one pixel has most of it.
    """
    top, left = window_el - HALF_WINDOW_PX - first_row, window_az - HALF_WINDOW_PX - first_column
    window_dn = light_dn[top : top + SIDE_PX, left : left + SIDE_PX]
    flux = az_moment = el_moment = peak = 0.0
    for row in range(SIDE_PX):
        # A sum of its own for each row: one long sum would wait for itself.
        row_dn = row_moment = 0.0
        for column in range(SIDE_PX):
            dn = window_dn[row, column] - s.bias_dn
            peak = max(peak, dn)
            row_dn += dn
            row_moment += dn * (column - HALF_WINDOW_PX)
        flux += row_dn
        az_moment += row_moment
        el_moment += row_dn * (row - HALF_WINDOW_PX)
    if flux <= 0 or peak > LARGEST_PEAK * flux:
        return math.nan, math.nan, math.nan
    return window_az + az_moment / flux, window_el + el_moment / flux, flux


@compilable()
def window_about(px: float, largest: int) -> int:
    """The nearest pixel about which the window fits."""
    return min(max(int(np.rint(px)), HALF_WINDOW_PX), largest)


@compilable()
def accepted(s: Any, flux_dn: float) -> bool:
    """``StarSensor._accepted``."""
    return s.flux_low_dn <= flux_dn <= s.flux_high_dn


@compilable()
def see(s: Any, r: Any, az_px: float, el_px: float) -> None:
    """A star is on the frame."""
    r.star_visible = 1
    r.star_px[0], r.star_px[1] = az_px, el_px


@compilable()
def measure(s: Any, r: Any, w: Any, window_az: int, window_el: int) -> bool:
    """``StarSensor.measure``; False where the whole frame must decide (``StarSensor.follow``)."""
    first_row, first_column = window_el - HALF_WINDOW_PX, window_az - HALF_WINDOW_PX
    render(
        w.window_dn, first_row, first_column, s.width_px, w.spots_px, s.flux_dn, s.sigma_px, s.spots,
        s.bias_dn, s.noise_dn, s.full_dn, r.pixel_key, r.frames, s.quantiles, s.light,
        w.down, w.across,
    )  # fmt: skip
    az_px, el_px, flux = centroid(s, w.window_dn, first_row, first_column, window_az, window_el)
    if not accepted(s, flux):
        return False
    if abs(az_px - window_az) > EDGE_PX or abs(el_px - window_el) > EDGE_PX:
        return False
    see(s, r, az_px, el_px)
    return True


@compilable()
def find(s: Any, r: Any, w: Any, frame_dn: Floats, search_dn: Floats) -> None:
    """``StarSensor.find`` over a whole frame."""
    render(
        frame_dn, 0, 0, s.width_px, w.spots_px, s.flux_dn, s.sigma_px, s.spots,
        s.bias_dn, s.noise_dn, s.full_dn, r.pixel_key, r.frames, s.quantiles, s.light,
        search_dn[:, 0], search_dn[0],
    )  # fmt: skip
    search_dn[:] = frame_dn
    for _ in range(MAX_CANDIDATES):
        el, az = divmod(np.argmax(search_dn), s.width_px)
        if search_dn[el, az] - s.bias_dn < s.threshold_dn:
            return
        window_az, window_el = window_about(az, s.largest_az_px), window_about(el, s.largest_el_px)
        az_px, el_px, flux = centroid(s, frame_dn, 0, 0, window_az, window_el)
        if flux > 0:
            window_az = window_about(az_px, s.largest_az_px)
            window_el = window_about(el_px, s.largest_el_px)
            az_px, el_px, flux = centroid(s, frame_dn, 0, 0, window_az, window_el)
        centred = abs(az_px - window_az) <= 1.0 and abs(el_px - window_el) <= 1.0
        if accepted(s, flux) and centred:
            see(s, r, az_px, el_px)
            return
        top, left = max(0, el - HALF_WINDOW_PX), max(0, az - HALF_WINDOW_PX)
        search_dn[top : el + HALF_WINDOW_PX + 1, left : az + HALF_WINDOW_PX + 1] = 0.0


# ---------------------------------------------------------------- where the stages are


@compilable(inline=True)
def motor_px(s: Any, az_rad: float, el_rad: float) -> Any:
    """``Scales.motor_px``."""
    az, el = turned(s.siderostat_turn, az_rad, el_rad)
    return s.motor_px_per_rad * az, s.motor_px_per_rad * el


@compilable(inline=True)
def motor_rad(s: Any, az_px: float, el_px: float) -> Any:
    """``Scales.motor_rad``."""
    az, el = turned_back(s.siderostat_turn, az_px, el_px)
    return az / s.motor_px_per_rad, el / s.motor_px_per_rad


@compilable(inline=True)
def mirror_px(s: Any, az_rad: float, el_rad: float) -> Any:
    """``Scales.mirror_px``."""
    az, el = turned(s.mirror_turn, az_rad, el_rad)
    return s.mirror_px_per_rad * az, s.mirror_px_per_rad * el


@compilable()
def stages_px(s: Any, r: Any) -> Any:
    """``StarEstimator.stages_px`` at the exposure."""
    az_px, el_px = motor_px(s, r.motor_rad[0], r.motor_rad[1])
    mirror_az_px, mirror_el_px = mirror_px(s, r.seen_mirror_rad[0], r.seen_mirror_rad[1])
    return az_px + mirror_az_px, el_px + mirror_el_px


@compilable()
def star_in_the_middle_rad(s: Any, r: Any) -> Any:
    """``Search._star_in_the_middle_rad``."""
    return motor_rad(s, s.middle_px[0] - r.star_origin_px[0], s.middle_px[1] - r.star_origin_px[1])


@compilable()
def known_output(s: Any, w: Any, stack: int, volts: float) -> float:
    """Displacement of a stack by its identified hysteresis, once it has met `volts`."""
    n = s.known_plays
    return play_output(
        w.known_plays_v[stack, :n], volts, s.known_half_v[:n], s.known_gains[stack, :n]
    )


@compilable()
def angle_of_volts(s: Any, r: Any, axis: int) -> float:
    """Eq. 5: a mirror angle of the voltages at the D/A."""
    angle_rad = 0.0
    for stack in range(3):
        angle_rad += s.angles_per_v[axis, stack] * (r.stack_v[stack] - s.bias_v)
    return angle_rad


@compilable()
def mirror_written(s: Any, r: Any, w: Any) -> None:
    """``Mirror.written`` and ``Mirror.angles_rad``."""
    v1, v2, v3 = r.stack_v[0], r.stack_v[1], r.stack_v[2]
    if s.hysteresis_known:
        d1 = known_output(s, w, 0, v1) - s.zero_m[0]
        d2 = known_output(s, w, 1, v2) - s.zero_m[1]
        d3 = known_output(s, w, 2, v3) - s.zero_m[2]
        r.mirror_rad[0] = (d2 - d3) / (2 * s.stack_radius_m)
        r.mirror_rad[1] = (d1 - d2) / (2 * s.stack_radius_m)
    else:
        r.mirror_rad[0], r.mirror_rad[1] = angle_of_volts(s, r, 0), angle_of_volts(s, r, 1)


@compilable()
def inverse_volts(s: Any, w: Any, stack: int, wanted_m: float) -> float:
    """:func:`fitctl.model.hysteresis.inverse_volts` of one stack."""
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
        r.stack_v[stack] += limited(s.bias_v - r.stack_v[stack], s.slew_v)
    r.mirror_command_rad[0], r.mirror_command_rad[1] = r.mirror_rad[0], r.mirror_rad[1]


@compilable()
def siderostat_to(s: Any, r: Any, axis: int, setpoint_rad: float) -> None:
    """``SiderostatStage.move_to``, one axis."""
    r.setpoint_rad[axis] = limited(setpoint_rad, s.travel_rad)
    r.wish = 1


# ---------------------------------------------------------------- controllers


@compilable()
def prefilter_step(s: Any, r: Any) -> None:
    """``Prefilter.step`` towards the target."""
    for axis in range(2):
        distance = r.command_px[axis] - s.target_px[axis]
        rate = r.command_rate[axis]
        r.command_px[axis] = (
            s.target_px[axis] + s.prefilter[0, 0] * distance + s.prefilter[0, 1] * rate
        )
        r.command_rate[axis] = s.prefilter[1, 0] * distance + s.prefilter[1, 1] * rate


@compilable()
def angular_rate(s: Any, angle: float) -> float:
    """``Spiral._angular_rate``."""
    length_per_angle = s.spiral_growth_px * math.sqrt(1 + angle**2)
    curvature_radius = s.spiral_growth_px * (1 + angle**2) ** 1.5 / (2 + angle**2)
    speed = min(s.spiral_speed_px_s, math.sqrt(s.spiral_acceleration_px_s2 * curvature_radius))
    return speed / length_per_angle


@compilable()
def spiral_is_there(s: Any, r: Any) -> bool:
    """``Search.has_arrived``."""
    if not r.spiral_there:
        away_rad = 0.0
        for axis in range(2):
            middle_rad = limited(r.spiral_centre_rad[axis], s.travel_rad)
            away_rad = max(away_rad, abs(r.motor_rad[axis] - middle_rad))
        r.spiral_there = away_rad * s.motor_px_per_rad <= s.spiral_near_px
    return bool(r.spiral_there)


@compilable()
def spiral_advance(s: Any, r: Any) -> None:
    """``Search.advance`` by one frame, and the siderostat with it."""
    if not spiral_is_there(s, r):
        siderostat_to(s, r, 0, r.spiral_centre_rad[0])
        siderostat_to(s, r, 1, r.spiral_centre_rad[1])
        return
    ahead = r.spiral_angle + angular_rate(s, r.spiral_angle) * s.period_s
    r.spiral_angle += angular_rate(s, ahead) * s.period_s
    radius_px = s.spiral_growth_px * r.spiral_angle
    az_px = radius_px * math.cos(r.spiral_angle)
    el_px = radius_px * math.sin(r.spiral_angle)
    az_rad, el_rad = motor_rad(s, az_px, el_px)
    siderostat_to(s, r, 0, r.spiral_centre_rad[0] + az_rad)
    siderostat_to(s, r, 1, r.spiral_centre_rad[1] + el_rad)


@compilable()
def pair_start(s: Any, r: Any) -> None:
    """``Pair.start`` from where the stages are, and ``Mirror.held_rad``."""
    ideal_rad_per_v = s.scale_m_per_v / (2 * s.stack_radius_m)
    if s.inverse_wanted and s.hysteresis_known:
        held_px = mirror_px(s, r.mirror_rad[0], r.mirror_rad[1])
    else:
        held_px = mirror_px(
            s,
            (r.stack_v[1] - r.stack_v[2]) * ideal_rad_per_v,
            (r.stack_v[0] - r.stack_v[1]) * ideal_rad_per_v,
        )
    for axis in range(2):
        for state in range(s.states):
            r.pair_state[axis, state] = held_px[axis] * s.pair_at_rest[state]
        r.held_px[axis] = held_px[axis] * s.pair_left_at_rest
        r.excess_px[axis] = 0.0
        r.motor_origin_rad[axis] = r.position_rad[axis]
        r.target_origin_px[axis] = r.command_px[axis]


@compilable()
def pair_step(s: Any, r: Any, w: Any) -> Any:
    """``Pair.step``: from the error to the siderostat's set-point, and the mirror's angles."""
    columns = s.states + 5
    mirrors_px = mirror_px(s, r.seen_mirror_rad[0], r.seen_mirror_rad[1])
    motors_px = motor_px(
        s, r.motor_rad[0] - r.motor_origin_rad[0], r.motor_rad[1] - r.motor_origin_rad[1]
    )
    step_az_px = step_el_px = 0.0
    for axis in range(2):
        w.pair_inputs[0] = r.star_px[axis] - r.command_px[axis]
        w.pair_inputs[1] = r.excess_px[axis]
        w.pair_inputs[2] = mirrors_px[axis]
        w.pair_inputs[3] = motors_px[axis]
        w.pair_inputs[4] = r.command_px[axis] - r.target_origin_px[axis]
        for state in range(s.states):
            w.pair_inputs[5 + state] = r.pair_state[axis, state]
        for row in range(s.states + 2):
            total = 0.0
            for column in range(columns):
                total += s.pair_system[row, column] * w.pair_inputs[column]
            if row == 0:
                r.wanted_px[axis] = total + r.held_px[axis]
            elif row == 1:
                handed_px = r.held_px[axis] * (1 - s.pair_kept)
                r.held_px[axis] -= handed_px
                if axis == 0:
                    step_az_px = total + handed_px
                else:
                    step_el_px = total + handed_px
            else:
                r.pair_state[axis, row - 2] = total
    step_az_rad, step_el_rad = motor_rad(s, step_az_px, step_el_px)
    siderostat_to(s, r, 0, r.setpoint_rad[0] + step_az_rad)
    siderostat_to(s, r, 1, r.setpoint_rad[1] + step_el_rad)
    az_px, el_px = turned_back(s.mirror_turn, r.wanted_px[0], r.wanted_px[1])
    az_rad, el_rad = az_px / s.mirror_px_per_rad, el_px / s.mirror_px_per_rad
    scale = min(1.0, s.range_rad / max(abs(az_rad) + abs(el_rad), 1e-300))
    az_rad, el_rad = az_rad * scale, el_rad * scale
    az_px, el_px = mirror_px(s, az_rad, el_rad)
    r.excess_px[0], r.excess_px[1] = r.wanted_px[0] - az_px, r.wanted_px[1] - el_px
    return az_rad, el_rad
