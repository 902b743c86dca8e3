"""What all ticks of all batched runs of a rig share, read from the objects that the live loop uses."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import ARCSEC_PER_RAD, WINDOW_PX, Rig
from fitctl.config.devices import MOST_WRITES
from fitctl.config.plant import MOST_INSTANTS
from fitctl.controllers.attribution import look_places_px
from fitctl.controllers.beam_hold import BeamHold
from fitctl.controllers.centroid import StarSensor, sensor_noise_px
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.feedforward import link_matrix
from fitctl.controllers.mirror import Mirror
from fitctl.controllers.pair import Pair
from fitctl.controllers.photodiodes import PhotodiodeArray
from fitctl.controllers.position_servo import position_servo
from fitctl.controllers.spiral import plan_beam_spiral, plan_spiral
from fitctl.controllers.spot_fit import PLACES
from fitctl.loop.learning import MOST_NOISE_RATIO
from fitctl.loop.metrology import PULL_IN, hold_most_rad
from fitctl.loop.pointing import Pointing
from fitctl.loop.search.spiral import NEAR
from fitctl.loop.sky import sky_rad_s
from fitctl.model.compiled import record
from fitctl.model.image.light import light_table
from fitctl.model.image.pixel_noise import quantiles
from fitctl.model.image.scene import photon_dn
from fitctl.model.lines import FIELDS as LINE_FIELDS
from fitctl.model.metrology.part import BeamConstants
from fitctl.model.optics import scales, sky_px_per_rad
from fitctl.model.plant import exposure_instants_s, pixel_noises
from fitctl.model.plant_constants import AirConstants, PlantConstants
from fitctl.simulation.batch.interlocks import acting_interlocks
from fitctl.simulation.batch.records import (
    BEAM_SETTINGS,
    BLOCK_NODES,
    DESIGN,
    EPOCH,
    MOST_EPOCHS,
    MOST_HISTORY,
    MOST_LINES,
    MOST_PLAYS,
    MOST_REQUESTS,
    MOST_SPOTS,
    MOST_STATES,
    NOISE,
    RING_STEPS,
    filled,
)
from fitctl.simulation.devices import DIODE_BITS
from fitctl.simulation.statistics import SETTLE_S, TILT_EVERY, motion_start_s
from fitctl.stages.injector import PERIOD_S
from fitctl.stages.mirror import HISTORY_S as MIRROR_HISTORY_S
from fitctl.stages.servo import FOLLOWING_S, HISTORY_S
from fitctl.supervisor.starlight import noise_ratio

Floats = NDArray[np.float64]
_MOST_NOISE_RATIO = 0.98 * MOST_NOISE_RATIO  # beyond it, a loop may design for the measured light
_OWN_SIGMAS = 10.0  # a spot is never farther than this from where it should be beside the first


class BatchRefusalError(Exception):
    """Why the batch cannot run a rig; :func:`fitctl.simulation.simulation.simulate` can."""


def star_settings(
    rig: Rig, loop_name: str, constants: PlantConstants, first_spot: int
) -> NDArray[np.void]:
    """Everything of a stellar loop that all ticks of all runs share, named as the classes name it; shape ().

    `first_spot` is the number of its first spot among all that are on the camera.

    Raises
    ------
    BatchRefusalError
    """
    loop, camera = rig.stellar_loops[loop_name], rig.true_camera
    truth, _ = rig.mock_parts()
    plant, fsm, acquisition = truth.stellar_loops[loop_name], loop.fsm, loop.acquisition
    again_s = acquisition.search_again_s
    scale, plan = scales(rig, loop), plan_spiral(rig, loop_name)
    target_px = np.array([loop.target_px.az, loop.target_px.el])
    other_targets_px = [
        np.array([other.target_px.az, other.target_px.el])
        for name, other in rig.stellar_loops.items()
        if name != loop_name
    ]
    sensor, mirror = StarSensor(camera, loop), Mirror(fsm)
    pointing = Pointing(rig, loop_name, target_px, design_for(rig, loop_name))
    pair = pointing.pair
    if sensor.fit is not None and sensor.near_spots:
        name = sensor.near_spots[0].name
        msg = (
            f"spot {name} reaches into its star's window, and the batch does not subtract its light"
        )
        raise BatchRefusalError(msg)
    spots = np.array([[spot.offset_px.az, spot.offset_px.el] for spot in plant.spots])
    noise_px = sensor_noise_px(rig.camera, loop, plant.spots[0].flux_dn)
    if pointing.design.uses_noise and noise_ratio(pointing.design, noise_px) > _MOST_NOISE_RATIO:
        msg = f"the star of loop {loop_name} has another light, and the batch's designs stay as they are"
        raise BatchRefusalError(msg)
    write_s = camera.period_s / fsm.dac.writes_per_frame
    writes = math.ceil(MIRROR_HISTORY_S / min(write_s, PERIOD_S))
    if writes > MOST_HISTORY:
        msg = f"its rates give {writes} writes to remember; the batch holds {MOST_HISTORY}"
        raise BatchRefusalError(msg)
    followed = np.array(
        [[0.0, 0.0], *([at.az, at.el] for at in (o.offset_px for o in loop.other_spots))]
    )
    parts = [1.0, *(other.flux_dn / loop.star_flux_dn for other in loop.other_spots)]
    given = loop.feedforward
    if given is not None and given.gain and given.signal != "encoders":
        msg = f"its feedforward uses {given.signal}, and the batch models encoders alone"
        raise BatchRefusalError(msg)
    link = -1 if loop.link is None else list(rig.metrology_loops).index(loop.link)
    return record(
        {
            # camera and scene
            "width_px": camera.width_px,
            "height_px": camera.height_px,
            "period_s": camera.period_s,
            "bias_dn": camera.bias_dn,
            "photon_dn": photon_dn(camera),
            "full_dn": float(camera.full_scale_dn),
            "quantiles": quantiles(),
            "light": light_table(),
            "first_spot": first_spot,
            "spots": len(spots),
            "spot_offset_px": _padded(spots - spots[0], MOST_SPOTS, 2),
            "followed_spots": len(followed),
            "followed_offset_px": _padded(followed, MOST_SPOTS, 2),
            "followed_part": _padded(parts, MOST_SPOTS),
            "followed_sigma_px": loop.spot_diameter_px / 4,
            "own_reach_px": _OWN_SIGMAS * plant.air_path.relative_rms_px,
            # Rounding to whole DN adds half of one, and so does a bias that is not whole.
            "noise_is_dark": max(dn for _, dn in pixel_noises(rig)) * quantiles()[-1] + 1.0
            < sensor.threshold_dn,
            # plant
            **_rings(constants.air),
            "air_relative": constants.air.relative,
            "epochs": _epochs(constants),
            "star_moves": constants.star_rate_px_s.any(),
            "star_rate_px_s": constants.star_rate_px_s,
            "star_is_followed": loop.star_rate_sky_arcsec_s is not None,
            "sky_rad_s": sky_rad_s(loop.star_rate_sky_arcsec_s, scale),
            "sky_px_per_rad": constants.sky_px_per_rad,
            "plays": len(constants.play_half_v),
            "play_half_v": _padded(constants.play_half_v, MOST_PLAYS),
            # star: sensor, search, following
            "sensor": _fields(
                sensor,
                "threshold_dn",
                "flux_low_dn",
                "flux_high_dn",
                "largest_az_px",
                "largest_el_px",
            ),
            "fits": sensor.fit is not None,
            "fit_weights": np.zeros((PLACES, PLACES, 3, WINDOW_PX**2))
            if sensor.fit is None
            else sensor.fit.weights[:, :, :3],
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
            "shared": len(rig.stellar_loops) > 1,
            "looks_px": look_places_px(rig.camera, target_px, other_targets_px),
            "scale": _fields(
                scale,
                "motor_px_per_rad",
                "mirror_px_per_rad",
                "siderostat_turn",
                "mirror_turn",
                "siderostat_back",
                "mirror_back",
            ),
            # control laws
            "prefilter": _fields(pointing.prefilter, "periods", "decay"),
            "coarse_step_rad_per_px": pointing.coarse_step_rad_per_px,
            **_pair(pair),
            "later_writes": pair.design.writes - 1,
            "later_every_s": camera.period_s / pair.design.writes,
            "later_after_s": camera.frame_delay_s + camera.period_s / pair.design.writes,
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
            "hysteresis_known": mirror.hysteresis_known,
            "known_plays": len(mirror.half_width_v),
            "known_half_v": _padded(mirror.half_width_v, MOST_PLAYS),
            "known_gains": _padded(mirror.gains_m_per_v, 3, MOST_PLAYS),
            "zero_m": mirror.zero_m,
            "writes": writes,
            **_siderostat(rig, loop_name),
            # the link
            "link": link,
            "link_matrix": np.zeros((2, 2)) if loop.link is None else _link_matrix(rig, loop_name),
        }
    )


def beam_settings(
    rig: Rig, loop_name: str, constants: BeamConstants, air_number: int
) -> NDArray[np.void]:
    """Everything of a metrology loop that all ticks of all runs share, likewise; shape ().

    `air_number` is that of its air path among all of a run.

    Raises
    ------
    BatchRefusalError
    """
    loop, camera = rig.metrology_loops[loop_name], rig.camera
    truth, _ = rig.mock_parts()
    plant, acquisition, sensor = truth.metrology_loops[loop_name], loop.acquisition, loop.sensor
    plan = plan_beam_spiral(rig, loop_name)
    motor_sky, px_per_rad = loop.siderostat.sky_rad_per_motor_rad, sky_px_per_rad(rig)
    if plant.link_round_trip_s / camera.period_s + 2 > MOST_REQUESTS:
        msg = f"its link's round trip is longer than {MOST_REQUESTS} frames, which the batch holds"
        raise BatchRefusalError(msg)
    search_radius_rad = acquisition.search_radius_sky_arcsec / ARCSEC_PER_RAD
    again_s = acquisition.search_again_s
    return filled(
        BEAM_SETTINGS,
        {
            # plant and photodiodes
            **_rings(constants.air),
            "air_transition": constants.air.transition,
            "air_noise_gain": constants.air.noise_gain,
            "air_number": air_number,
            "step_s": constants.step_s,
            "truth": _fields(
                plant.sensor, "diode_offset_m", "on_axis_v", "beam_radius_m", "noise_v", "ambient_v"
            ),
            "link_length_m": plant.sensor.link_length_m,
            "round_trip_s": plant.link_round_trip_s,
            "range_v": sensor.device.range_v,
            "volt_step": 2 * sensor.device.range_v / 2**DIODE_BITS,
            # sensor, search, following
            "array": _fields(
                PhotodiodeArray(sensor, acquisition.detection_sigma),
                "threshold_v",
                "saturated_v",
                "metres_per_log",
            ),
            "ambient_v": np.array(sensor.ambient_v),
            "sensor_length_m": sensor.link_length_m,
            "acquisition": _fields(
                acquisition, "settle_s", "confirm_timeout_s", "found_frames", "lost_frames"
            ),
            "spiral": _fields(plan, "growth_px", "speed_px_s", "acceleration_px_s2", "pitch_px"),
            "search_radius_px": search_radius_rad * px_per_rad,
            "search_again_pause_s": acquisition.search_again_pause_s,
            "search_again_s": math.inf if again_s is None else again_s,
            "rad_per_px": 1.0 / (motor_sky * px_per_rad),
            "requirement_arcsec": loop.requirement_arcsec,
            # control laws
            "hold": _fields(
                BeamHold(loop.hold.crossover_hz, loop.hold.second_integrator_hz),
                "gain_per_s",
                "second_per_s",
            ),
            "pull_in_rad_s": PULL_IN * loop.siderostat.velocity_limit_rad_s * motor_sky,
            "hold_most_rad": hold_most_rad(loop),
            "turn": constants.turn,
            "sky_rad_per_motor_rad": motor_sky,
            **_siderostat(rig, loop_name),
        },
    )


def rig_settings(
    rig: Rig, stars: list[NDArray[np.void]], beams: list[NDArray[np.void]]
) -> NDArray[np.void]:
    """What all loops share, and the settings of each; shape (1,).

    Raises
    ------
    BatchRefusalError
    """
    acting = [name for loop_name in rig.loops for name in acting_interlocks(rig, loop_name)]
    if acting:
        msg = f"interlock {acting[0]} may act, and the batch has no interlocks"
        raise BatchRefusalError(msg)
    camera = rig.true_camera
    truth, _ = rig.mock_parts()
    if truth.hot_pixels or camera.dark_file is not None:
        msg = "its pixels differ (hot pixels or a dark file), and the batch makes all pixels alike"
        raise BatchRefusalError(msg)
    if len({loop.siderostat.servo.rate_hz for loop in rig.loops.values()}) > 1:
        msg = "the rates of its servos differ, and the batch runs all at one"
        raise BatchRefusalError(msg)
    block_steps, ring_steps = int(stars[0]["block_steps"]), int(stars[0]["ring_steps"])
    # What one tick needs lies between an exposure, or a sample, and two periods after its arrival.
    round_trips_s = [plant.link_round_trip_s for plant in truth.metrology_loops.values()]
    needed_s = max(camera.frame_delay_s, *round_trips_s, 0.0) + 3 * camera.period_s
    steps = needed_s / truth.step_s + 2 * block_steps
    if steps > RING_STEPS:
        msg = f"frame_delay_s and step_s give {steps:.0f} steps to remember; the batch holds {RING_STEPS}"
        raise BatchRefusalError(msg)
    spots = [spot for name in rig.stellar_loops for spot in truth.stellar_loops[name].spots]
    instants, most_seen = truth.exposure_instants, MOST_INSTANTS * MOST_SPOTS
    names = list(rig.stellar_loops)
    fringes = [0, 0] if rig.fringes is None else [names.index(one) for one in rig.fringes.loops]
    return record(
        {
            "stars": np.array(stars),
            "beams": np.array(beams, BEAM_SETTINGS),
            "period_s": camera.period_s,
            "exposure_s": camera.exposure_s,
            "delay_s": camera.frame_delay_s,
            "spots": len(spots),
            "instants": instants,
            "instants_s": _padded(exposure_instants_s(rig), MOST_INSTANTS),
            "flux_dn": _padded([spot.flux_dn / instants for spot in spots] * instants, most_seen),
            "sigma_px": _padded([spot.diameter_px / 4 for spot in spots] * instants, most_seen),
            "noises": _until_never(NOISE, pixel_noises(rig)),
            "step_s": truth.step_s,
            "block_steps": block_steps,
            "ring_steps": ring_steps,
            "servo_period_s": stars[0]["servo"]["period_s"],
            "settle_s": SETTLE_S,
            "motion_s": -math.inf if math.isinf(motion_start_s(rig)) else motion_start_s(rig),
            "fringe_stars": np.array(fringes),
            "tilt_every": TILT_EVERY,
        }
    )[None]


def design_settings(star: int, frame: int, pair: Pair, *, knows: bool) -> NDArray[np.void]:
    """Another design's pair from a frame of a star on, shape ().

    Parameters
    ----------
    star, frame : int
        The number of the stellar loop, and of its frame, which count from 0 and from 1.
    pair : Pair
    knows : bool
        Whether the pair is in a state to go on from; otherwise it begins from rest.
    """
    return filled(
        DESIGN,
        {
            "star": star,
            "frame": frame,
            **_pair(pair),
            "knows": knows,
            "pair_state": _padded(pair.state.T, 2, MOST_STATES),
            "motor_origin_rad": pair.motor_origin_rad,
            "target_origin_px": pair.target_origin_px,
        },
    )


def _pair(pair: Pair) -> dict[str, Any]:
    """What the ticks of a design's pair need."""
    states = len(pair.state)
    return {
        "pair_states": states,
        "pair_system": _padded(pair.system[: 2 + states], MOST_STATES + 2, MOST_STATES + 5),
        "pair_later": _padded(pair.system[2 + states :], MOST_WRITES - 1, MOST_STATES + 5),
        "pair_at_rest": _padded(pair.at_rest, MOST_STATES),
        "pair_left_at_rest": pair.left_at_rest,
        "inverse_wanted": int(pair.design.hysteresis_inverse),
    }


def _rings(air: AirConstants) -> dict[str, Any]:
    """How an air path goes from node to node, and the rings of all that is drawn with it."""
    block_steps = BLOCK_NODES * len(air.weights)
    return {
        "steps_per_node": len(air.weights),
        "air_weights": _padded(air.weights, RING_STEPS, 4),
        "block_steps": block_steps,
        "ring_steps": RING_STEPS // block_steps * block_steps,
    }


def _epochs(constants: PlantConstants) -> NDArray[np.void]:
    """What of a loop's plant changes, epoch by epoch."""
    return _until_never(
        EPOCH,
        [
            (
                epoch.from_node,
                epoch.air.transition,
                epoch.air.noise_gain,
                len(epoch.lines),
                _padded(epoch.lines, MOST_LINES, LINE_FIELDS),
                _padded(epoch.play_gain_m_per_v, MOST_PLAYS),
            )
            for epoch in constants.epochs
        ],
    )


def _until_never(dtype: np.dtype, rows: list[Any]) -> NDArray[np.void]:
    """Rows of what holds from a node or step on, which is their first field; at least one more never begins."""
    if len(rows) >= MOST_EPOCHS:
        msg = f"its timeline has {len(rows) - 1} changes; the batch holds {MOST_EPOCHS - 2}"
        raise BatchRefusalError(msg)
    made = np.zeros(MOST_EPOCHS, dtype)
    made[(dtype.names or ())[0]] = np.iinfo(np.int64).max
    made[: len(rows)] = rows
    return made


def _siderostat(rig: Rig, loop_name: str) -> dict[str, Any]:
    """The siderostat of a loop, and its servo."""
    siderostat = rig.loops[loop_name].siderostat
    servo = position_servo(siderostat, rig.camera.period_s)
    readings = round(HISTORY_S / servo.period_s)
    if readings > MOST_HISTORY:
        msg = f"its rates give {readings} readings to remember; the batch holds {MOST_HISTORY}"
        raise BatchRefusalError(msg)
    return {
        "servo": _fields(
            servo,
            "gain_per_s",
            "velocity_limit_rad_s",
            "velocity_step_rad_s",
            "brake_rad",
            "period_s",
            "periods_per_setpoint",
            "resolution_rad",
        ),
        "travel_rad": siderostat.travel_rad,
        "readings": readings,
        "following_limit_rad": siderostat.servo.following_error_limit_rad,
        "following_s": FOLLOWING_S,
    }


def _link_matrix(rig: Rig, loop_name: str) -> Floats:
    """From the motors of a loop's link to its own."""
    loop = rig.stellar_loops[loop_name]
    link, given = rig.metrology_loops[str(loop.link)], loop.feedforward
    return link_matrix(
        0.0 if given is None else given.gain,
        np.eye(2) if given is None else given.matrix,
        link.siderostat.sky_rad_per_motor_rad,
        loop.siderostat.sky_rad_per_motor_rad,
    )


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
