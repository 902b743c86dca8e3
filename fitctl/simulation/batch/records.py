"""Records of a batched run: its state, and what it works with; compiled code receives each as one argument.

Arrays in a record have a fixed size, so that one compilation serves every rig and every design.
"""

from __future__ import annotations

import numpy as np

from fitctl.config import HALF_WINDOW_PX
from fitctl.messages.modes import STELLAR_MODES

DONE, FOLLOWING_ERROR, NOT_FOUND = 0, 1, 2  # how a run ends; others than the first are simulated
MOST_SPOTS, MOST_PLAYS, MOST_STATES, MOST_HISTORY = 8, 32, 33, 1024
RING_STEPS, BLOCK_NODES, SIDE_PX = 1024, 8, 2 * HALF_WINDOW_PX + 1

_AXIS = np.dtype(  # fitctl.controllers.position_servo.Axis
    [("target_rad", "f8"), ("reference_rad", "f8"), ("step_rad", "f8"), ("velocity_rad_s", "f8")]
)
_CANDIDATE = np.dtype([("motor_rad", "f8", (2,)), ("since_s", "f8"), ("frames", "i8")])

RUN = np.dtype(
    [
        ("now_s", "f8"),
        ("mode", "i8"),
        ("mode_since_s", "f8"),
        ("mode_times_s", "f8", (len(STELLAR_MODES),)),
        ("acquired_s", "f8"),
        ("vernier_s", "f8"),
        # a frame: its spots, where the stages were at its exposure, and the star
        ("frames", "i8"),
        ("pixel_key", "u8"),
        ("exposed_step", "i8"),
        ("exposed_px", "f8", (2,)),
        ("own_blocks", "i8", (MOST_SPOTS,)),
        ("motor_rad", "f8", (2,)),
        ("exposed_mirror_rad", "f8", (2,)),
        ("star_visible", "i8"),
        ("star_px", "f8", (2,)),
        # Following, Search and Spiral
        ("lost", "i8"),
        ("in_reach", "i8"),
        ("out_of_reach", "i8"),
        ("has_candidate", "i8"),
        ("candidate", _CANDIDATE),
        ("has_arrived", "i8"),
        ("again", "i8"),
        ("search_since_s", "f8"),
        ("round", "i8"),
        ("pause_s", "f8"),
        ("spiral_radius_px", "f8"),
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
        ("excess_px", "f8", (2,)),
        ("motor_origin_rad", "f8", (2,)),
        ("target_origin_px", "f8", (2,)),
        # SiderostatServo and PositionServo
        ("setpoint_rad", "f8", (2,)),
        ("setpoint_is_new", "i8"),
        ("position_rad", "f8", (2,)),
        ("followed_s", "f8"),
        ("axes", _AXIS, (2,)),
        # the plant, and the stages' histories
        ("steps", "i8"),
        ("row", "i8"),
        ("origin_px", "f8", (2,)),
        ("writes", "i8"),
        ("readings", "i8"),
        # sums of the residual, from the step residual_from on
        ("summed_to", "i8"),
        ("residual_from", "i8"),
        ("residual_frames", "i8"),
        ("residual_steps", "i8"),
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
