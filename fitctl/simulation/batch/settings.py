"""What a batched run needs of a rig, and what it remembers: records, which compiled code takes as one.

Arrays in a record have a fixed size, so that one compilation serves every rig and every design; a rig with
more than fits is simulated instead.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import HALF_WINDOW_PX, Rig
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.pair import HAND_OVER_S, left_at_rest, rest_state
from fitctl.controllers.spiral import plan_spiral
from fitctl.loop.search import NEAR
from fitctl.messages.modes import Mode
from fitctl.model.hysteresis import raised_displacement
from fitctl.model.light import light_table
from fitctl.model.optics import mirror_angles, scales, stack_matrix
from fitctl.model.pixel_noise import quantiles
from fitctl.model.plant_constants import PlantConstants
from fitctl.model.scene import FULL_WELL_DN
from fitctl.simulation.batch.interlocks import acting_interlocks
from fitctl.stages.injector import PERIOD_S
from fitctl.stages.mirror import HISTORY_S as MIRROR_HISTORY_S
from fitctl.stages.servo import FOLLOWING_S, HISTORY_S

Floats = NDArray[np.float64]
DONE, FOLLOWING_ERROR, NOT_FOUND = 0, 1, 2  # how a run ends; others than the first are simulated
MOST_SPOTS, MOST_PLAYS, MOST_STATES, MOST_HISTORY = 8, 32, 32, 1024
RING_STEPS, BLOCK_NODES, SIDE_PX = 1024, 8, 2 * HALF_WINDOW_PX + 1
_OWN_SIGMAS = 10.0  # a spot is never farther than this from where it should be beside the first

RUN = np.dtype(
    [
        ("now_s", "f8"),
        ("mode", "i8"),
        ("mode_since_s", "f8"),
        ("mode_times_s", "f8", (len(Mode),)),
        ("acquired_s", "f8"),
        ("vernier_s", "f8"),
        # a frame: its spots, where the stages were, and the star
        ("pixel_key", "u8"),
        ("exposed_step", "i8"),
        ("exposed_px", "f8", (2,)),
        ("wanted_spot", "i8"),
        ("own_blocks", "i8", (MOST_SPOTS,)),
        ("motor_rad", "f8", (2,)),
        ("seen_mirror_rad", "f8", (2,)),
        ("star_visible", "i8"),
        ("star_px", "f8", (2,)),
        # StellarLoop's findings, sighting and spiral
        ("lost", "i8"),
        ("in_reach", "i8"),
        ("out_of_reach", "i8"),
        ("sighted", "i8"),
        ("sighted_s", "f8"),
        ("sighting_frames", "i8"),
        ("sighting_rad", "f8", (2,)),
        ("spiral_there", "i8"),
        ("spiral_angle", "f8"),
        ("spiral_centre_rad", "f8", (2,)),
        # StarEstimator, Prefilter, Mirror, Pair
        ("star_known", "i8"),
        ("star_origin_px", "f8", (2,)),
        ("command_px", "f8", (2,)),
        ("command_rate", "f8", (2,)),
        ("stack_v", "f8", (3,)),
        ("mirror_rad", "f8", (2,)),
        ("mirror_command_rad", "f8", (2,)),
        ("pair_state", "f8", (2, MOST_STATES)),
        ("wanted_px", "f8", (2,)),
        ("excess_px", "f8", (2,)),
        ("held_px", "f8", (2,)),
        ("motor_origin_rad", "f8", (2,)),
        ("target_origin_px", "f8", (2,)),
        # SiderostatServo and PositionServo
        ("setpoint_rad", "f8", (2,)),
        ("wish", "i8"),
        ("position_rad", "f8", (2,)),
        ("followed_s", "f8"),
        ("servo_target_rad", "f8", (2,)),
        ("servo_reference_rad", "f8", (2,)),
        ("servo_step_rad", "f8", (2,)),
        ("velocity_rad_s", "f8", (2,)),
        # what is judged
        ("steps", "i8"),
        ("row", "i8"),
        ("judged_to", "i8"),
        ("origin_px", "f8", (2,)),
        ("writes", "i8"),
        ("readings", "i8"),
        ("frames", "i8"),
        ("judged_from", "i8"),
        ("judged_frames", "i8"),
        ("judged_steps", "i8"),
        ("true_sum_px2", "f8", (2,)),
        ("measured_sum_px2", "f8", (2,)),
        ("piston_sum_m", "f8"),
        ("piston_sum_m2", "f8"),
    ]
)


# What a run works with beside its state: rings, plays and room for what is computed.
WORK = np.dtype(
    [
        ("plays_v", "f8", (3, MOST_PLAYS)),
        ("known_plays_v", "f8", (3, MOST_PLAYS)),
        ("pair_inputs", "f8", (MOST_STATES + 5,)),
        ("written_s", "f8", (MOST_HISTORY,)),
        ("written_rad", "f8", (MOST_HISTORY, 2)),
        ("read_s", "f8", (MOST_HISTORY,)),
        ("read_rad", "f8", (MOST_HISTORY, 2)),
        ("air", "f8", (MOST_SPOTS, 2, 2)),
        ("normals", "f8", (BLOCK_NODES, 2, 2)),
        ("air_px", "f8", (RING_STEPS, 2)),
        ("own_px", "f8", (MOST_SPOTS, RING_STEPS, 2)),
        ("trace_px", "f8", (RING_STEPS, 2)),
        ("spots_px", "f8", (MOST_SPOTS, 2)),
        ("window_dn", "f8", (SIDE_PX, SIDE_PX)),
        ("down", "f8", (SIDE_PX,)),
        ("across", "f8", (SIDE_PX,)),
    ]
)


class BatchRefusalError(Exception):
    """Why the batch cannot run a rig; :func:`fitctl.simulation.simulation.simulate` can."""


def batch_settings(rig: Rig, loop_name: str, constants: PlantConstants) -> NDArray[np.void]:
    """Everything that all ticks of all runs share, named as the classes name it; shape (1,).

    Raises
    ------
    BatchRefusalError
    """
    acting = acting_interlocks(rig, loop_name)
    if acting:
        msg = f"interlock {acting[0]} may act, and the batch has no interlocks"
        raise BatchRefusalError(msg)
    loop, camera = rig.loops[loop_name], rig.true_camera
    truth, _ = rig.mock_parts()
    if truth.hot_pixels or camera.dark_file is not None:
        msg = "its pixels differ (hot pixels or a dark file), and the batch makes all pixels alike"
        raise BatchRefusalError(msg)
    plant = truth.loops[loop_name]
    fsm, siderostat, acquisition = loop.fsm, loop.siderostat, loop.acquisition
    scale, plan = scales(rig, loop), plan_spiral(rig, loop_name)
    design = design_for(rig, loop_name)
    at_rest = rest_state(design)
    largest_az_px, largest_el_px = camera.largest_window_px
    threshold_dn = acquisition.detection_sigma * camera.pixel_noise_dn
    x = camera.period_s / loop.prefilter.time_constant_s
    known = fsm.hysteresis
    known_half_v = np.asarray(known.half_widths_v if known else [0.0])
    known_gains = np.asarray(known.gains_m_per_v if known else [[1.0]] * 3)
    geometry = (fsm.stack_radius_m, fsm.stack_scale_m_per_v, 0.0)
    servo_period_s = 1.0 / siderostat.servo.rate_hz
    spots = [[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots]
    block_steps = BLOCK_NODES * len(constants.air.weights)
    # What one frame needs lies between its exposure and two periods after its arrival.
    needed_s = camera.frame_delay_s + 3 * camera.period_s
    if needed_s / constants.step_s + 2 * block_steps > RING_STEPS:
        steps = needed_s / constants.step_s + 2 * block_steps
        msg = f"frame_delay_s and step_s give {steps:.0f} steps to remember; the batch holds {RING_STEPS}"
        raise BatchRefusalError(msg)
    values = {
        "width_px": camera.width_px,
        "height_px": camera.height_px,
        "period_s": camera.period_s,
        "exposure_s": camera.exposure_s,
        "delay_s": camera.frame_delay_s,
        "bias_dn": camera.bias_dn,
        "noise_dn": camera.pixel_noise_dn,
        "full_dn": float(FULL_WELL_DN),
        "quantiles": quantiles(),
        "light": light_table(),
        "spots": len(spots),
        "spot_offset_px": _padded(np.array(spots) - spots[0], MOST_SPOTS, 2),
        "air_transition": constants.air.transition,
        "air_noise_gain": constants.air.noise_gain,
        "steps_per_node": len(constants.air.weights),
        "air_weights": _padded(constants.air.weights, RING_STEPS, 4),
        "block_steps": block_steps,
        "ring_steps": RING_STEPS // block_steps * block_steps,
        "air_relative": constants.air.relative,
        "plays": len(constants.play_half_v),
        "play_half_v": _padded(constants.play_half_v, MOST_PLAYS),
        "play_gain_m_per_v": _padded(constants.play_gain_m_per_v, MOST_PLAYS),
        "own_reach_px": _OWN_SIGMAS * plant.air_path.relative_rms_px,
        "flux_dn": _padded([spot.flux_dn for spot in plant.spots], MOST_SPOTS),
        "sigma_px": _padded([spot.diameter_px / 4 for spot in plant.spots], MOST_SPOTS),
        "threshold_dn": threshold_dn,
        # Rounding to whole DN adds half of one, and so does a bias that is not whole.
        "noise_is_dark": bool(camera.pixel_noise_dn * quantiles()[-1] + 1.0 < threshold_dn),
        "flux_low_dn": loop.flux_range.low * loop.star_flux_dn,
        "flux_high_dn": loop.flux_range.high * loop.star_flux_dn,
        "largest_az_px": largest_az_px,
        "largest_el_px": largest_el_px,
        "target_px": np.array([loop.target_px.az, loop.target_px.el]),
        "middle_px": np.array([camera.width_px - 1, camera.height_px - 1]) / 2,
        "motor_px_per_rad": scale.motor_px_per_rad,
        "mirror_px_per_rad": scale.mirror_px_per_rad,
        "siderostat_turn": scale.siderostat_turn,
        "mirror_turn": scale.mirror_turn,
        "range_rad": fsm.range_rad,
        "travel_rad": siderostat.travel_sky_arcsec / scale.motor_sky_arcsec_per_rad,
        "settle_s": acquisition.settle_s,
        "confirm_s": acquisition.confirm_timeout_s,
        "found_frames": acquisition.found_frames,
        "lost_frames": acquisition.lost_frames,
        "reach_fraction": loop.coarse.reach_fraction,
        "reach_frames": loop.coarse.reach_frames,
        "coarse_rad_per_px": loop.coarse.gain_rad_per_m * scale.pixel_size_m * camera.period_s,
        "prefilter": math.exp(-x) * np.array([[1 + x, x], [-x, 1 - x]]),
        "spiral_growth_px": plan.pitch_px / (2 * math.pi),
        "spiral_speed_px_s": plan.speed_px_s,
        "spiral_acceleration_px_s2": plan.acceleration_px_s2,
        "spiral_radius_px": plan.radius_px,
        "spiral_near_px": NEAR * plan.field_radius_px,
        "writes": math.ceil(MIRROR_HISTORY_S / min(camera.period_s, PERIOD_S)),
        "states": len(design.a),
        # Rows are those of outputs, then of states; columns of inputs, then of states.
        "pair_system": _padded(
            np.block([[design.d, design.c], [design.b, design.a]]), MOST_STATES + 2, MOST_STATES + 5
        ),
        "pair_at_rest": _padded(at_rest, MOST_STATES),
        "pair_left_at_rest": left_at_rest(design, at_rest),
        "pair_kept": math.exp(-design.period_s / HAND_OVER_S),
        "inverse_wanted": design.hysteresis_inverse,
        "bias_v": fsm.bias_v,
        "slew_v": fsm.slew_v_per_s * camera.period_s,
        "full_scale_v": fsm.dac.full_scale_v,
        "scale_m_per_v": fsm.stack_scale_m_per_v,
        "stack_radius_m": fsm.stack_radius_m,
        "stack_matrix": stack_matrix(fsm.stack_radius_m),
        "angles_per_v": np.ascontiguousarray(mirror_angles(np.eye(3), *geometry).T),
        "hysteresis_known": known is not None,
        "known_plays": len(known_half_v),
        "known_half_v": _padded(known_half_v, MOST_PLAYS),
        "known_gains": _padded(known_gains, 3, MOST_PLAYS),
        "zero_m": raised_displacement(fsm.bias_v, known_half_v, known_gains),
        "dac_step_v": fsm.dac.full_scale_v / (2**fsm.dac.bits - 1),
        "dac_most_v": fsm.piezo.limit_v / fsm.piezo.gain,
        "servo_period_s": servo_period_s,
        "servo_periods": max(1, round(camera.period_s / servo_period_s)),
        "readings": round(HISTORY_S / servo_period_s),
        "servo_gain_per_s": siderostat.servo.gain_per_s,
        "velocity_limit_rad_s": siderostat.velocity_limit_rad_s,
        "acceleration_limit_rad_s2": siderostat.acceleration_limit_rad_s2,
        "resolution_rad": 2 * math.pi / siderostat.encoder_counts_per_rev,
        "following_limit_rad": siderostat.servo.following_error_limit_rad,
        "following_s": FOLLOWING_S,
    }
    if max(values["writes"], values["readings"]) > MOST_HISTORY:
        most = max(values["writes"], values["readings"])
        msg = (
            f"its rates give {most} readings or writes to remember; the batch holds {MOST_HISTORY}"
        )
        raise BatchRefusalError(msg)
    record = np.zeros(1, _dtype(values))
    for name, value in values.items():
        record[name] = value
    return record


def _dtype(values: Mapping[str, Any]) -> np.dtype:
    arrays = {name: np.asarray(value) for name, value in values.items()}
    return np.dtype([(name, array.dtype, array.shape) for name, array in arrays.items()])


def _padded(values: ArrayLike, *shape: int) -> Floats:
    """`values` in the corner of zeros of the given shape."""
    array = np.asarray(values, dtype=float)
    if any(size > most for size, most in zip(array.shape, shape, strict=True)):
        msg = f"it needs an array of shape {array.shape}; the batch holds {shape}"
        raise BatchRefusalError(msg)
    return np.pad(array, [(0, most - size) for size, most in zip(array.shape, shape, strict=True)])
