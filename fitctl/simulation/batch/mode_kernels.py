"""Modes of a batched run: what leads from one to another, and what each begins with.

Records as in :mod:`fitctl.simulation.batch.step_kernels`.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fitctl.messages.modes import Mode
from fitctl.model.compiled import compilable
from fitctl.model.optics import turned_back
from fitctl.simulation.batch.step_kernels import (
    motor_px,
    pair_start,
    stages_px,
    star_in_the_middle_rad,
)

OFF, STANDBY = int(Mode.OFF), int(Mode.STANDBY)
ACQUISITION, COARSE, VERNIER = int(Mode.ACQUISITION), int(Mode.COARSE), int(Mode.VERNIER)


@compilable()
def change_mode(r: Any, mode: int) -> None:
    """``StellarLoop.fire``, but for what a mode begins with."""
    r.mode_times_s[r.mode] += r.now_s - r.mode_since_s
    r.mode, r.mode_since_s = mode, r.now_s
    r.lost = r.in_reach = r.out_of_reach = 0


@compilable()
def start_search(s: Any, r: Any) -> None:
    """``StellarLoop._start_search`` and ``Search.begin``."""
    change_mode(r, ACQUISITION)
    if not r.star_known:
        az_px, el_px = motor_px(s, r.position_rad[0], r.position_rad[1])
        r.star_origin_px[0], r.star_origin_px[1] = s.target_px[0] - az_px, s.target_px[1] - el_px
    r.spiral_centre_rad[0], r.spiral_centre_rad[1] = star_in_the_middle_rad(s, r)
    r.spiral_there, r.spiral_angle = 0, 0.0
    r.sighted = 0


@compilable()
def start_coarse(s: Any, r: Any) -> None:
    """COARSE begins with the prefilter at rest on the target."""
    change_mode(r, COARSE)
    for axis in range(2):
        r.command_px[axis], r.command_rate[axis] = s.target_px[axis], 0.0
    r.sighted = 0
    if math.isnan(r.acquired_s):
        r.acquired_s = r.now_s


@compilable()
def start_vernier(s: Any, r: Any, step_s: float, settle_s: float) -> None:
    """VERNIER begins with the pair holding what is."""
    change_mode(r, VERNIER)
    pair_start(s, r)
    if math.isnan(r.vernier_s):
        r.vernier_s = r.now_s
        r.judged_from = max(1, int(np.rint((r.now_s + settle_s) / step_s)))


@compilable()
def judge_search(s: Any, r: Any, exposed_s: float) -> bool:
    """``Search.judge``; False where the search has ended without a star."""
    if not r.sighted:
        if r.star_visible:
            r.sighted, r.sighted_s, r.sighting_frames = 1, exposed_s, 0
            r.sighting_rad[0], r.sighting_rad[1] = star_in_the_middle_rad(s, r)
            return True
        return s.spiral_growth_px * r.spiral_angle < s.spiral_radius_px
    settled = exposed_s >= r.sighted_s + s.settle_s
    r.sighting_frames = r.sighting_frames + 1 if r.star_visible and settled else 0
    if r.sighting_frames >= s.found_frames:
        start_coarse(s, r)
    elif exposed_s > r.sighted_s + s.settle_s + s.confirm_s:
        r.sighted = 0
    return True


@compilable()
def judge_tracking(s: Any, r: Any, step_s: float, settle_s: float) -> None:
    """``Following.judge``."""
    if not r.star_visible:
        r.lost += 1
        r.in_reach = r.out_of_reach = 0
        if r.lost >= s.lost_frames:
            start_search(s, r)
        return
    r.lost = 0
    az_px, el_px = r.star_px[0] - r.command_px[0], r.star_px[1] - r.command_px[1]
    # The diamond lies along the mirror's axes.
    az_px, el_px = turned_back(s.mirror_turn, az_px, el_px)
    need = (abs(az_px) + abs(el_px)) / (s.mirror_px_per_rad * s.range_rad)
    r.in_reach = r.in_reach + 1 if need <= s.reach_fraction else 0
    r.out_of_reach = r.out_of_reach + 1 if need > 1.0 else 0
    if r.mode == COARSE and r.in_reach >= s.reach_frames:
        start_vernier(s, r, step_s, settle_s)
    elif r.mode == VERNIER and r.out_of_reach >= s.reach_frames:
        start_coarse(s, r)


@compilable()
def judge(s: Any, r: Any, exposed_s: float, step_s: float, settle_s: float) -> bool:
    """``StellarLoop._evaluate_findings``; False where the search has ended without a star."""
    if r.star_visible:
        az_px, el_px = stages_px(s, r)
        r.star_origin_px[0], r.star_origin_px[1] = r.star_px[0] - az_px, r.star_px[1] - el_px
        r.star_known = 1
    if r.mode == ACQUISITION:
        return judge_search(s, r, exposed_s)
    judge_tracking(s, r, step_s, settle_s)
    return True


@compilable()
def count_measured(r: Any, settle_s: float) -> None:
    """Add a tick to what is judged, if it is late enough."""
    if r.star_visible and r.now_s >= r.vernier_s + settle_s:
        for axis in range(2):
            error_px = r.star_px[axis] - r.command_px[axis]
            r.measured_sum_px2[axis] += error_px * error_px
        r.judged_frames += 1
