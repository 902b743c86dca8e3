"""What all ticks of all batched runs of a rig share, read from the objects that the live loop uses."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import Rig
from fitctl.controllers.centroid import StarSensor
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.mirror import Mirror
from fitctl.controllers.position_servo import position_servo
from fitctl.controllers.spiral import plan_spiral
from fitctl.loop.pointing import Pointing
from fitctl.loop.search import NEAR
from fitctl.model.compiled import record
from fitctl.model.light import light_table
from fitctl.model.optics import scales
from fitctl.model.pixel_noise import quantiles
from fitctl.model.plant_constants import PlantConstants
from fitctl.model.scene import FULL_WELL_DN
from fitctl.simulation.batch.interlocks import acting_interlocks
from fitctl.simulation.batch.records import (
    BLOCK_NODES,
    MOST_HISTORY,
    MOST_PLAYS,
    MOST_SPOTS,
    MOST_STATES,
    RING_STEPS,
)
from fitctl.simulation.statistics import SETTLE_S
from fitctl.stages.injector import PERIOD_S
from fitctl.stages.mirror import HISTORY_S as MIRROR_HISTORY_S
from fitctl.stages.servo import FOLLOWING_S, HISTORY_S

Floats = NDArray[np.float64]
_OWN_SIGMAS = 10.0  # a spot is never farther than this from where it should be beside the first


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
    loop, camera = rig.stellar_loops[loop_name], rig.true_camera
    truth, _ = rig.mock_parts()
    if truth.hot_pixels or camera.dark_file is not None:
        msg = "its pixels differ (hot pixels or a dark file), and the batch makes all pixels alike"
        raise BatchRefusalError(msg)
    plant, fsm, acquisition = truth.stellar_loops[loop_name], loop.fsm, loop.acquisition
    again_s = acquisition.search_again_s
    scale, plan = scales(rig, loop), plan_spiral(rig, loop_name)
    target_px = np.array([loop.target_px.az, loop.target_px.el])
    sensor, mirror = StarSensor(camera, loop), Mirror(fsm)
    servo = position_servo(loop.siderostat, camera.period_s)
    pointing = Pointing(rig, loop_name, target_px, design_for(rig, loop_name))
    pair = pointing.pair
    spots = np.array([[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots])
    block_steps = BLOCK_NODES * len(constants.air.weights)
    # What one frame needs lies between its exposure and two periods after its arrival.
    needed_s = camera.frame_delay_s + 3 * camera.period_s
    steps = needed_s / constants.step_s + 2 * block_steps
    if steps > RING_STEPS:
        msg = f"frame_delay_s and step_s give {steps:.0f} steps to remember; the batch holds {RING_STEPS}"
        raise BatchRefusalError(msg)
    writes = math.ceil(MIRROR_HISTORY_S / min(camera.period_s, PERIOD_S))
    readings = round(HISTORY_S / servo.period_s)
    if max(writes, readings) > MOST_HISTORY:
        entries = max(writes, readings)
        msg = f"its rates give {entries} readings to remember; the batch holds {MOST_HISTORY}"
        raise BatchRefusalError(msg)
    return record(
        {
            # camera and scene
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
            "spot_offset_px": _padded(spots - spots[0], MOST_SPOTS, 2),
            "flux_dn": _padded([spot.flux_dn for spot in plant.spots], MOST_SPOTS),
            "sigma_px": _padded([spot.diameter_px / 4 for spot in plant.spots], MOST_SPOTS),
            "own_reach_px": _OWN_SIGMAS * plant.air_path.relative_rms_px,
            # Rounding to whole DN adds half of one, and so does a bias that is not whole.
            "noise_is_dark": camera.pixel_noise_dn * quantiles()[-1] + 1.0 < sensor.threshold_dn,
            # plant
            "step_s": constants.step_s,
            "air_transition": constants.air.transition,
            "air_noise_gain": constants.air.noise_gain,
            "steps_per_node": len(constants.air.weights),
            "air_weights": _padded(constants.air.weights, RING_STEPS, 4),
            "air_relative": constants.air.relative,
            "block_steps": block_steps,
            "ring_steps": RING_STEPS // block_steps * block_steps,
            "plays": len(constants.play_half_v),
            "play_half_v": _padded(constants.play_half_v, MOST_PLAYS),
            "play_gain_m_per_v": _padded(constants.play_gain_m_per_v, MOST_PLAYS),
            # star: sensor, search, following
            "sensor": _fields(
                sensor,
                "threshold_dn",
                "flux_low_dn",
                "flux_high_dn",
                "largest_az_px",
                "largest_el_px",
            ),
            "acquisition": _fields(
                acquisition, "settle_s", "confirm_timeout_s", "found_frames", "lost_frames"
            ),
            "coarse": _fields(loop.coarse, "reach_fraction", "reach_frames"),
            "spiral": _fields(plan, "growth_px", "speed_px_s", "acceleration_px_s2", "pitch_px"),
            "search_radius_px": acquisition.search_radius_sky_arcsec / scale.sky_arcsec_per_px,
            "search_again_pause_s": acquisition.search_again_pause_s,
            "search_again_s": math.inf if again_s is None else again_s,
            "near_px": NEAR * plan.field_radius_px,
            "middle_px": np.array([camera.width_px - 1, camera.height_px - 1]) / 2,
            "target_px": target_px,
            "scale": _fields(
                scale, "motor_px_per_rad", "mirror_px_per_rad", "siderostat_turn", "mirror_turn"
            ),
            # control laws
            "prefilter": _fields(pointing.prefilter, "periods", "decay"),
            "coarse_step_rad_per_px": pointing.coarse_step_rad_per_px,
            "pair_states": len(pair.system) - 2,
            "pair_system": _padded(pair.system, MOST_STATES + 2, MOST_STATES + 5),
            "pair_at_rest": _padded(pair.at_rest, MOST_STATES),
            "pair_left_at_rest": pair.left_at_rest,
            "residual_settle_s": SETTLE_S,
            # mirror
            "range_rad": fsm.range_rad,
            "bias_v": fsm.bias_v,
            "slew_v": fsm.slew_v_per_s * camera.period_s,
            "full_scale_v": fsm.dac.full_scale_v,
            "dac_step_v": fsm.dac.step_v,
            "dac_most_v": fsm.piezo.limit_v / fsm.piezo.gain,
            "scale_m_per_v": fsm.stack_scale_m_per_v,
            "stack_radius_m": fsm.stack_radius_m,
            "stack_matrix": mirror.stack_matrix,
            "rad_per_stack_v": mirror.rad_per_stack_v,
            "inverse_wanted": pair.design.hysteresis_inverse,
            "hysteresis_known": mirror.hysteresis_known,
            "known_plays": len(mirror.half_width_v),
            "known_half_v": _padded(mirror.half_width_v, MOST_PLAYS),
            "known_gains": _padded(mirror.gains_m_per_v, 3, MOST_PLAYS),
            "zero_m": mirror.zero_m,
            "writes": writes,
            # siderostat
            "servo": _fields(
                servo,
                "gain_per_s",
                "velocity_limit_rad_s",
                "velocity_step_rad_s",
                "period_s",
                "periods_per_setpoint",
                "resolution_rad",
            ),
            "travel_rad": scale.travel_rad(loop.siderostat),
            "readings": readings,
            "following_limit_rad": loop.siderostat.servo.following_error_limit_rad,
            "following_s": FOLLOWING_S,
        }
    )[None]


def _fields(live: object, *names: str) -> NDArray[np.void]:
    """Some attributes of what the live loop uses, as a record."""
    return record({name: getattr(live, name) for name in names})


def _padded(values: ArrayLike, *shape: int) -> Floats:
    """`values` in the corner of zeros of the given shape."""
    array = np.asarray(values, dtype=float)
    if any(size > most for size, most in zip(array.shape, shape, strict=True)):
        msg = f"it needs an array of shape {array.shape}; the batch holds {shape}"
        raise BatchRefusalError(msg)
    return np.pad(array, [(0, most - size) for size, most in zip(array.shape, shape, strict=True)])
