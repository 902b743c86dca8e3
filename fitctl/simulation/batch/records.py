"""Records of a batched run: states, and what loops work with; compiled code receives each as one argument.

Arrays in a record have a fixed size, so that one compilation serves every rig and every design.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import WINDOW_PX
from fitctl.config.devices import MOST_WRITES
from fitctl.config.plant import MOST_INSTANTS
from fitctl.controllers.attribution import MOST_STRANGERS
from fitctl.messages.modes import Mode
from fitctl.model.lines import FIELDS as LINE_FIELDS

DONE, FOLLOWING_ERROR, NOT_FOUND, REFUSED_COURSE = (
    0,
    1,
    2,
    3,
)  # how a run ends; others than the first are simulated
MOST_SPOTS, MOST_PLAYS, MOST_STATES, MOST_HISTORY = 8, 32, 33, 1024
MOST_LINES, MOST_EPOCHS = 8, 64
MOST_REQUESTS = 64  # of the photodiodes, under way at one time
RING_STEPS, BLOCK_NODES = 1024, 8


def _numbers(*names: str) -> list[tuple[str, str]]:
    return [(name, "f8") for name in names]


_AXIS = np.dtype(  # fitctl.controllers.position_servo.Axis
    _numbers("target_rad", "reference_rad", "step_rad", "moving_rad", "velocity_rad_s")
)
_CANDIDATE = np.dtype([("motor_rad", "f8", (2,)), ("since_s", "f8"), ("frames", "i8")])

# What loops of both kinds have.
_MODE = [
    ("now_s", "f8"),
    ("mode", "i8"),
    ("mode_since_s", "f8"),
    ("mode_times_s", "f8", (len(Mode),)),
    ("acquired_s", "f8"),
    ("held_s", "f8"),
    ("residual_from_s", "f8"),
    # Following and Search, or their counterparts of a beam
    ("lost", "i8"),
    ("in_reach", "i8"),
    ("out_of_reach", "i8"),
    ("has_candidate", "i8"),
    ("candidate", _CANDIDATE),
    ("again", "i8"),
    ("search_since_s", "f8"),
    ("round", "i8"),
    ("pause_s", "f8"),
    ("spiral_radius_px", "f8"),
    ("spiral_angle", "f8"),
    ("spiral_centre_rad", "f8", (2,)),
    # SiderostatServo and PositionServo; where the motors were at the exposure or at the sample
    ("setpoint_rad", "f8", (2,)),
    ("setpoint_is_new", "i8"),
    ("position_rad", "f8", (2,)),
    ("followed_s", "f8"),
    ("axes", _AXIS, (2,)),
    ("readings", "i8"),
    ("motor_rad", "f8", (2,)),
    # the plant, and sums of the residual from the step residual_from on
    ("steps", "i8"),
    ("row", "i8"),
    ("summed_to", "i8"),
    ("residual_from", "i8"),
    ("residual_steps", "i8"),
    ("true_sum2", "f8", (2,)),
]

STAR = np.dtype(
    [
        *_MODE,
        # a frame: its spots, where the stages were at its exposure, and the star
        ("frames", "i8"),
        ("pixel_key", "u8"),
        ("line_key", "u8"),
        ("exposed_s", "f8"),
        ("exposed_step", "i8", (MOST_INSTANTS,)),
        ("exposed_px", "f8", (MOST_INSTANTS, 2)),
        ("noise_dn", "f8"),
        ("own_blocks", "i8", (MOST_SPOTS,)),
        ("exposed_mirror_rad", "f8", (2,)),
        ("has_arrived", "i8"),
        ("star_visible", "i8"),
        ("last_visible", "i8"),  # on the last frame on which it was looked for
        ("star_px", "f8", (2,)),
        ("flux_dn", "f8"),
        # Following
        ("off_target", "i8"),
        ("off_star_px", "f8", (2,)),
        ("off_stages_px", "f8", (2,)),
        # Attribution
        ("seen_stages_px", "f8", (2,)),
        ("candidate_px", "f8", (2,)),
        ("origin_before_px", "f8", (2,)),
        ("rejected", "i8"),
        ("strangers", "i8"),
        ("strangers_px", "f8", (MOST_STRANGERS, 2)),
        # the link, and waiting for it or for other loops
        ("waits", "i8"),
        ("search_due", "i8"),
        ("search_rests", "i8"),
        ("moved_s", "f8"),
        ("link_counts", "i8"),
        ("beam_rad", "f8", (2,)),
        ("link_motor_rad", "f8", (2,)),
        ("link_origin_rad", "f8", (2,)),
        ("undone_rad", "f8", (2,)),
        ("beyond_rad", "f8", (2,)),
        ("sky_time_s", "f8"),
        ("sky_undone_rad", "f8", (2,)),
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
        # writes of the D/A that are still to come before the next frame's command: the next, and how many
        ("later_rad", "f8", (MOST_WRITES - 1, 2)),
        ("later", "i8"),
        ("later_left", "i8"),
        ("later_s", "f8"),
        # the plant, the mirror's history, and sums of the residual
        ("origin_px", "f8", (2,)),
        ("hysteresis_epoch", "i8"),
        ("writes", "i8"),
        ("residual_frames", "i8"),
        ("measured_sum_px2", "f8", (2,)),
        ("piston_sum_m", "f8"),
        ("piston_sum_m2", "f8"),
    ]
)
BEAM = np.dtype(
    [
        *_MODE,
        # photodiodes: requests under way, and the newest sample
        ("requested_s", "f8", (MOST_REQUESTS,)),
        ("requested", "i8"),
        ("received", "i8"),
        ("noise_key", "u8"),
        ("taken", "i8"),
        ("has_sample", "i8"),
        ("sampled_s", "f8"),
        ("beam_state", "i8"),
        ("place_m", "f8", (2,)),
        ("samples", "i8"),
        # MetrologyLoop and BeamHold
        ("ticked_s", "f8"),
        ("rate_rad_s", "f8", (2,)),
        # the plant
        ("misaligned_rad", "f8", (1, 2)),
    ]
)

# What a loop works with beside its state: rings, plays and room for what is computed.
_SIDEROSTAT_AND_AIR = [
    ("read_s", "f8", (MOST_HISTORY,)),
    ("read_rad", "f8", (MOST_HISTORY, 2)),
    ("air", "f8", (MOST_SPOTS, 2, 2)),
    ("normals", "f8", (BLOCK_NODES, 2, 2)),
]
STAR_WORK = np.dtype(
    [
        *_SIDEROSTAT_AND_AIR,
        ("plays_v", "f8", (3, MOST_PLAYS)),
        ("known_plays_v", "f8", (3, MOST_PLAYS)),
        ("pair_inputs", "f8", (MOST_STATES + 5,)),
        ("written_s", "f8", (MOST_HISTORY,)),
        ("written_rad", "f8", (MOST_HISTORY, 2)),
        ("lines", "f8", (MOST_LINES, 2)),
        ("kicks", "f8", (BLOCK_NODES, MOST_LINES)),
        ("air_px", "f8", (RING_STEPS, 2)),
        ("own_px", "f8", (MOST_SPOTS, RING_STEPS, 2)),
        ("trace_px", "f8", (RING_STEPS, 2)),
        ("piston_m", "f8", (RING_STEPS,)),
        ("spots_px", "f8", (MOST_INSTANTS * MOST_SPOTS, 2)),
        ("window_dn", "f8", (WINDOW_PX, WINDOW_PX)),
        ("down", "f8", (WINDOW_PX,)),
        ("across", "f8", (WINDOW_PX,)),
    ]
)
BEAM_WORK = np.dtype(
    [
        *_SIDEROSTAT_AND_AIR,
        ("air_rad", "f8", (RING_STEPS, 2)),
        ("beam_rad", "f8", (RING_STEPS, 1, 2)),
        ("offset_m", "f8", (RING_STEPS, 2)),
    ]
)


# A design at work, by the names of the settings that it replaces, and from which frame of which star on.
DESIGN = np.dtype(
    [
        ("star", "i8"),
        ("frame", "i8"),
        ("pair_states", "i8"),
        ("pair_system", "f8", (MOST_STATES + 2, MOST_STATES + 5)),
        ("pair_later", "f8", (MOST_WRITES - 1, MOST_STATES + 5)),
        ("pair_at_rest", "f8", (MOST_STATES,)),
        ("pair_left_at_rest", "f8"),
        ("inverse_wanted", "i8"),
        # Where it knows recent frames, what they leave it in; otherwise it begins from rest.
        ("knows", "i8"),
        ("pair_state", "f8", (2, MOST_STATES)),
        ("motor_origin_rad", "f8", (2,)),
        ("target_origin_px", "f8", (2,)),
    ]
)

# The camera's frame period, after so many frames.
RATE = np.dtype([("frames", "i8"), ("period_s", "f8")])

# fitctl.model.plant_constants.Epoch; of those that are not used, `from_node` is never reached.
EPOCH = np.dtype(
    [
        ("from_node", "i8"),
        ("air_transition", "f8", (2, 2)),
        ("air_noise_gain", "f8", (2, 2)),
        ("line_count", "i8"),
        ("lines", "f8", (MOST_LINES, LINE_FIELDS)),
        ("play_gain_m_per_v", "f8", (MOST_PLAYS,)),
    ]
)
# From which step on dark pixels have a noise.
NOISE = np.dtype([("from_step", "i8"), ("dn", "f8")])

# Of a metrology loop: compiled code needs a type even for a rig that has none.
BEAM_SETTINGS = np.dtype(
    [
        ("air_transition", "f8", (2, 2)),
        ("air_noise_gain", "f8", (2, 2)),
        ("steps_per_node", "i8"),
        ("air_weights", "f8", (RING_STEPS, 4)),
        ("block_steps", "i8"),
        ("ring_steps", "i8"),
        ("air_number", "i8"),
        (
            "truth",
            [
                *_numbers("diode_offset_m", "on_axis_v", "beam_radius_m", "noise_v"),
                ("ambient_v", "f8", (4,)),
            ],
        ),
        *_numbers("step_s", "link_length_m", "round_trip_s", "range_v", "volt_step"),
        ("array", _numbers("threshold_v", "saturated_v", "metres_per_log")),
        ("ambient_v", "f8", (4,)),
        *_numbers("sensor_length_m", "requirement_arcsec", "rad_per_px"),
        (
            "acquisition",
            [
                *_numbers("settle_s", "confirm_timeout_s"),
                ("found_frames", "i8"),
                ("lost_frames", "i8"),
            ],
        ),
        ("spiral", _numbers("growth_px", "speed_px_s", "acceleration_px_s2", "pitch_px")),
        *_numbers("search_radius_px", "search_again_pause_s", "search_again_s"),
        ("hold", _numbers("gain_per_s", "second_per_s")),
        *_numbers("pull_in_rad_s", "hold_most_rad", "sky_rad_per_motor_rad"),
        ("turn", "f8", (2, 2)),
        (
            "servo",
            [
                *_numbers("gain_per_s", "velocity_limit_rad_s", "velocity_step_rad_s", "brake_rad"),
                *_numbers("period_s"),
                ("periods_per_setpoint", "i8"),
                ("resolution_rad", "f8"),
            ],
        ),
        ("travel_rad", "f8"),
        ("readings", "i8"),
        *_numbers("following_limit_rad", "following_s"),
    ]
)


def filled(dtype: np.dtype, values: Mapping[str, Any]) -> NDArray[np.void]:
    """A record of a type, shape (), with a value for each of its fields."""
    made = np.zeros((), dtype)
    for name in dtype.names or ():
        made[name] = values[name]
    return made


def of_all_loops(
    star: np.dtype, stars: int, beam: np.dtype, beams: int, *more: tuple[str, str]
) -> NDArray[np.void]:
    """Room for the records of all loops of a rig, shape (1,): `stars`, `beams`, and more fields of its own."""
    return np.zeros(1, [("stars", star, (stars,)), ("beams", beam, (beams,)), *more])
