"""Records of experiments on the plant alone: no supervisor, no wires, and not a frame rendered."""

import math

import numpy as np

from fitctl.controllers.centroid import sensor_noise_px
from fitctl.controllers.position_servo import PositionServo
from fitctl.identify.record import ExperimentRecord
from fitctl.model.drives import FSM, SIDEROSTAT, STACKS, channel_values, experiment_s
from fitctl.model.optics import scales, stack_volts
from fitctl.model.plant import Plant

INJECTION_PERIOD_S = 0.0073  # the supervisor's: no common measure with the frames'


def record_of(rig, loop, drives, seed=0, extra_s=0.5, frame_delay_s=None, plant=None):
    """What an experiment with `drives` leaves behind, `extra_s` after the last of them.

    The star stands at the target. `frame_delay_s` is from mid-exposure to the tick, by default the
    rig's; `plant` is one to go on with, by default a new one of that `seed`.
    """
    settings, camera = rig.loops[loop], rig.camera
    fsm, siderostat, scale = settings.fsm, settings.siderostat, scales(rig, settings)
    plant = plant or Plant(rig, [seed], star_offset_px=np.zeros((1, 2))).stellar_loops[loop]
    random = np.random.default_rng(seed)
    servo_s = 1 / siderostat.servo.rate_hz
    rad_per_count = 2 * math.pi / siderostat.encoder_counts_per_rev
    servo = PositionServo(
        siderostat.servo.gain_per_s,
        siderostat.velocity_limit_rad_s,
        siderostat.acceleration_limit_rad_s2,
        servo_s,
        camera.period_s,
        rad_per_count,
    )
    noise_px = sensor_noise_px(camera, settings, settings.star_flux_dn)
    delay_s = camera.frame_delay_s if frame_delay_s is None else frame_delay_s

    def encoders_rad():
        return np.floor(plant.state.motor_rad[0] / rad_per_count) * rad_per_count

    begin_s = plant.time_s
    held_rad = encoders_rad()
    servo.reset(held_rad)
    injected_s, injected_v = [begin_s], [plant.inputs.stack_v[0].copy()]
    frames, read_s, read_rad = [], [], []

    def inject(since_s):
        mirror_rad = channel_values(drives, FSM, since_s) / scale.mirror_px_per_rad
        volts = stack_volts(mirror_rad, fsm.stack_radius_m, fsm.stack_scale_m_per_v, fsm.bias_v)
        volts = volts + channel_values(drives, STACKS, since_s)
        plant.inputs.stack_v[0] = np.clip(volts, 0.0, fsm.dac.full_scale_v)
        injected_s.append(begin_s + since_s)
        injected_v.append(plant.inputs.stack_v[0].copy())

    def read_and_drive(since_s):
        read_s.append(begin_s + since_s)
        read_rad.append(encoders_rad())
        plant.inputs.velocity_rad_s[0] = servo.step(read_rad[-1])

    def set_point(since_s):
        wanted_px = channel_values(drives, SIDEROSTAT, since_s)
        servo.move_to(held_rad + wanted_px / scale.motor_px_per_rad)

    def expose(since_s):
        star_px = plant.spots_px(begin_s + since_s)[0, 0] + noise_px * random.standard_normal(2)
        frames.append((begin_s + since_s, *star_px))

    length_s = experiment_s(drives) + extra_s
    agenda = [
        (since_s, order, action)
        for order, (period_s, first_s, action) in enumerate(
            [
                (camera.period_s, 0.0, set_point),
                (servo_s, 0.0, read_and_drive),
                (INJECTION_PERIOD_S, 0.0, inject),
                (camera.period_s, camera.exposure_s / 2, expose),
            ]
        )
        for since_s in np.arange(first_s, length_s, period_s)
    ]
    for since_s, _, action in sorted(agenda, key=lambda item: item[:2]):
        plant.advance(begin_s + since_s)
        action(since_s)
    read_and_drive(length_s)  # so that the last frame lies between two readings
    exposed_s, az_px, el_px = np.array(frames).T
    motor_rad = [np.interp(exposed_s, read_s, axis) for axis in np.array(read_rad).T]
    tick = {
        "time_s": exposed_s + delay_s,
        "mid_exposure_s": exposed_s,
        "frame_age_s": np.full(exposed_s.shape, delay_s),
        "star_visible": np.ones(exposed_s.shape, dtype=bool),
        "star_az_px": az_px,
        "star_el_px": el_px,
        "star_flux_dn": np.full(exposed_s.shape, settings.star_flux_dn),
        "siderostat_az_rad": motor_rad[0],
        "siderostat_el_rad": motor_rad[1],
    }
    return ExperimentRecord(loop, tick, np.array(injected_s), np.array(injected_v))
