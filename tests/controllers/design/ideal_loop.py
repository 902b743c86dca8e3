"""A pair on stages that do exactly as told, frame by frame: both axes, with the diamond."""

from collections import deque

import numpy as np

from fitctl.controllers.design.linear_loop.sampled import timing
from fitctl.controllers.pair import Measurement, Pair
from fitctl.model.optics import scales

RANGE_RAD = 1.772e-4


class Course:
    """What a run gave: arrays of shape (frames, 2), in pixels."""

    def __init__(self, errors, wanted, mirrors, motors):
        self.error_px, self.wanted_px = np.array(errors), np.array(wanted)
        self.mirror_px, self.motor_px = np.array(mirrors), np.array(motors)


def run_pair(rig, design, star_px, target_px=None, range_rad=RANGE_RAD):
    """Star's own motion, shape (frames, 2), under a pair; its target moves likewise."""
    scale = scales(rig, rig.loops["right"])
    pair = Pair(design, scale, range_rad)
    frames, walked = timing(design.period_s, design.delay_s)
    target_px = np.zeros_like(star_px) if target_px is None else target_px
    mirrors = deque([np.zeros(2)] * frames, maxlen=frames)
    motors = deque([np.zeros(2)] * (frames + 1), maxlen=frames + 1)
    rows = []
    for star, target in zip(star_px, target_px, strict=True):
        mirror, motor = mirrors[0], (1 - walked) * motors[0] + walked * motors[1]
        error = star + mirror + motor - target
        command = pair.step(
            Measurement(
                error, target, mirror / scale.mirror_px_per_rad, motor / scale.motor_px_per_rad
            )
        )
        mirrors.append(command.mirror_rad * scale.mirror_px_per_rad)
        motors.append(motors[-1] + command.motor_step_rad * scale.motor_px_per_rad)
        rows.append((error, mirrors[-1] + pair.excess_px, mirrors[-1], motors[-1]))
    return Course(*zip(*rows, strict=True))
