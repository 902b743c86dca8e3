"""Modes of a batched run: what leads from one to another, and what each begins with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fitctl.controllers.frame_counts import CONFIRMED, REJECTED, count_frame, look_again
from fitctl.controllers.search_rounds import round_fraction
from fitctl.messages.modes import STELLAR_MODES, Mode, Trigger, transition
from fitctl.model.compiled import compilable
from fitctl.model.optics import turned_back
from fitctl.simulation.batch.laws import ACQUISITION, COARSE, VERNIER, start_pair
from fitctl.simulation.batch.sensor import stages_px
from fitctl.simulation.batch.siderostat import motor_px, motor_rad

OFF, STANDBY = int(Mode.OFF), int(Mode.STANDBY)
ACQUIRE, POWER_UP = int(Trigger.ACQUIRE), int(Trigger.STANDBY)
STAR_FOUND, STAR_LOST = int(Trigger.STAR_FOUND), int(Trigger.STAR_LOST)
IN_REACH, OUT_OF_REACH = int(Trigger.IN_REACH), int(Trigger.OUT_OF_REACH)
# The mode that each trigger leads to from each mode; its own where the trigger means nothing.
_TARGETS = np.array(
    [
        [row.target if (row := transition(mode, trigger)) else mode for trigger in Trigger]
        for mode in STELLAR_MODES
    ],
    dtype=np.int64,
)


@compilable()
def fire(s: Any, r: Any, trigger: int) -> None:
    """``StellarLoop.fire``."""
    count_mode_time(r)
    r.mode, r.mode_since_s = _TARGETS[r.mode, trigger], r.now_s
    r.lost = r.in_reach = r.out_of_reach = 0
    if r.mode == ACQUISITION:
        start_search(s, r, trigger == STAR_LOST)
    elif r.mode == COARSE:
        start_coarse(s, r)
    elif r.mode == VERNIER:
        start_vernier(s, r)


@compilable()
def count_mode_time(r: Any) -> None:
    """Add the time since the mode began."""
    r.mode_times_s[r.mode] += r.now_s - r.mode_since_s


@compilable()
def start_search(s: Any, r: Any, again: bool) -> None:
    """``StellarLoop._start_search`` and ``Search.begin``."""
    if not r.star_known:
        az_px, el_px = motor_px(s, r.position_rad[0], r.position_rad[1])
        r.star_origin_px[0], r.star_origin_px[1] = s.target_px[0] - az_px, s.target_px[1] - el_px
    r.spiral_centre_rad[0], r.spiral_centre_rad[1] = star_in_the_middle_rad(s, r)
    r.again = 1 if again and s.search_again_s != 0 else 0
    r.has_arrived, r.has_candidate, r.search_since_s = r.again, 0, math.nan
    begin_round(s, r, 0)


@compilable()
def begin_round(s: Any, r: Any, number: int) -> None:
    """``Search._begin_round``."""
    fraction = round_fraction(number) if r.again else 1.0
    r.round, r.spiral_angle = number, 0.0
    r.pause_s = fraction * s.search_again_pause_s if r.again else 0.0
    r.spiral_radius_px = fraction * s.search_radius_px + s.spiral.pitch_px / 2


@compilable()
def star_in_the_middle_rad(s: Any, r: Any) -> tuple[float, float]:
    """``Search._star_in_the_middle_rad``."""
    return motor_rad(s, s.middle_px[0] - r.star_origin_px[0], s.middle_px[1] - r.star_origin_px[1])


@compilable()
def start_coarse(s: Any, r: Any) -> None:
    """COARSE begins with the prefilter at rest on the target."""
    for axis in range(2):
        r.command_px[axis], r.command_rate[axis] = s.target_px[axis], 0.0
    if math.isnan(r.acquired_s):
        r.acquired_s = r.now_s


@compilable()
def start_vernier(s: Any, r: Any) -> None:
    """VERNIER begins with the pair holding the mirror where it is."""
    start_pair(s, r)
    if math.isnan(r.vernier_s):
        r.vernier_s = r.now_s
        r.residual_from = max(1, int(np.rint((r.now_s + s.residual_settle_s) / s.step_s)))


@compilable()
def evaluate_search(s: Any, r: Any, exposed_s: float) -> bool:
    """``Search.evaluate``; False where the search has ended without a star."""
    if math.isnan(r.search_since_s):
        r.search_since_s = exposed_s
    if r.has_candidate:
        outcome = look_again(s.acquisition, r.candidate, r.star_visible == 1, exposed_s)
        if outcome == CONFIRMED:
            fire(s, r, STAR_FOUND)
        elif outcome == REJECTED:
            r.has_candidate = 0
    elif r.star_visible:
        r.has_candidate, r.candidate.since_s, r.candidate.frames = 1, exposed_s, 0
        az_rad, el_rad = star_in_the_middle_rad(s, r)
        r.candidate.motor_rad[0], r.candidate.motor_rad[1] = az_rad, el_rad
    elif r.again and exposed_s - r.search_since_s > s.search_again_s:
        return False
    elif s.spiral.growth_px * r.spiral_angle >= r.spiral_radius_px:
        if not r.again:
            return False
        begin_round(s, r, r.round + 1)
    return True


@compilable()
def evaluate_following(s: Any, r: Any) -> None:
    """``Following.evaluate``."""
    # The diamond lies along the mirror's axes.
    az_px, el_px = turned_back(
        s.scale.mirror_turn, r.star_px[0] - r.command_px[0], r.star_px[1] - r.command_px[1]
    )
    need = (abs(az_px) + abs(el_px)) / (s.scale.mirror_px_per_rad * s.range_rad)
    count_frame(r, r.star_visible == 1, need, s.coarse.reach_fraction)
    if r.lost >= s.acquisition.lost_frames:
        fire(s, r, STAR_LOST)
    elif r.mode == COARSE and r.in_reach >= s.coarse.reach_frames:
        fire(s, r, IN_REACH)
    elif r.mode == VERNIER and r.out_of_reach >= s.coarse.reach_frames:
        fire(s, r, OUT_OF_REACH)


@compilable()
def evaluate(s: Any, r: Any, exposed_s: float) -> bool:
    """``StellarLoop._evaluate_findings``; False where the search has ended without a star."""
    if r.star_visible:
        az_px, el_px = stages_px(s, r)
        r.star_origin_px[0], r.star_origin_px[1] = r.star_px[0] - az_px, r.star_px[1] - el_px
        r.star_known = 1
    if r.mode == ACQUISITION:
        return evaluate_search(s, r, exposed_s)
    evaluate_following(s, r)
    return True
