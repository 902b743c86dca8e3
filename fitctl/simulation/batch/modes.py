"""Modes of a batched run: what leads from one to another, and what each begins with."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from fitctl.config import HALF_WINDOW_PX
from fitctl.controllers.attribution import MOST_STRANGERS, is_within, second_look
from fitctl.controllers.frame_counts import (
    CONFIRMED,
    REJECTED,
    count_frame,
    is_unmoved,
    look_again,
)
from fitctl.controllers.search_rounds import round_fraction
from fitctl.messages.modes import STELLAR_MODES, Mode, Trigger, transition
from fitctl.model.compiled import compilable
from fitctl.model.optics import turned
from fitctl.simulation.batch.laws import (
    ACQUISITION,
    AGAIN,
    ANEW,
    COARSE,
    NOT_DUE,
    VERNIER,
    start_pair,
)
from fitctl.simulation.batch.sensor import stages_px
from fitctl.simulation.batch.siderostat import motor_px, motor_rad, siderostat_to, undo_turn

OFF, STANDBY, LOCKED = int(Mode.OFF), int(Mode.STANDBY), int(Mode.LOCKED)
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
def fire(ss: Any, rr: Any, i: int, trigger: int) -> None:
    """``StellarLoop.fire``."""
    s, r = ss.stars[i], rr.stars[i]
    read_link(s, r, rr)
    count_mode_time(r)
    r.mode, r.mode_since_s = _TARGETS[r.mode, trigger], r.now_s
    begin_following(r)
    if r.mode == ACQUISITION:
        r.search_due = AGAIN if trigger == STAR_LOST else ANEW
        if not must_wait(ss, rr, i):
            start_search(s, r, rr, r.position_rad[0], r.position_rad[1])
    elif r.mode == COARSE:
        rest_prefilter(s, r)
        if math.isnan(r.acquired_s):
            r.acquired_s = r.now_s
    elif r.mode == VERNIER:
        az_rad, el_rad = linked_rad(s, r, r.position_rad[0], r.position_rad[1])
        start_pair(s, r, az_rad, el_rad)
        if math.isnan(r.held_s):
            begin_residual(ss, r)


@compilable()
def count_mode_time(r: Any) -> None:
    """Add the time since the mode began."""
    r.mode_times_s[r.mode] += r.now_s - r.mode_since_s


@compilable()
def begin_residual(ss: Any, r: Any) -> None:
    """The residual counts from when the loop has settled, and the collector moves if it is to."""
    r.held_s = r.now_s
    r.residual_from_s = max(r.now_s + ss.settle_s, ss.motion_s)
    r.residual_from = max(1, int(np.rint(r.residual_from_s / ss.step_s)))


@compilable()
def start_search(s: Any, r: Any, rr: Any, motor_az_rad: float, motor_el_rad: float) -> None:
    """``StellarLoop._start_search`` with the motors as given, and ``Search.begin``."""
    again, r.search_due = r.search_due == AGAIN, NOT_DUE
    if s.link >= 0 and not r.link_counts:
        set_link_origin(s, r, rr)
        r.star_known = 0
    r.link_counts = 1
    if not r.star_known:
        az_rad, el_rad = linked_rad(s, r, motor_az_rad, motor_el_rad)
        az_px, el_px = motor_px(s, az_rad, el_rad)
        r.star_origin_px[0], r.star_origin_px[1] = s.target_px[0] - az_px, s.target_px[1] - el_px
        r.star_known = 1
    r.rejected = 0
    if again and s.shared:
        r.spiral_centre_rad[0], r.spiral_centre_rad[1] = star_at_rad(s, r, s.target_px)
    else:
        r.spiral_centre_rad[0], r.spiral_centre_rad[1] = star_at_rad(s, r, s.middle_px)
    r.again = 1 if again and s.search_again_s != 0 else 0
    r.has_arrived, r.has_candidate, r.search_since_s = r.again, 0, math.nan
    r.beam_rad[0], r.beam_rad[1] = linked_rad(s, r, r.motor_rad[0], r.motor_rad[1])
    begin_round(s, r, 0)


@compilable()
def begin_round(s: Any, r: Any, number: int) -> None:
    """``Search._begin_round``."""
    fraction = round_fraction(number) if r.again else 1.0
    r.round, r.spiral_angle, r.strangers = number, 0.0, 0
    r.pause_s = fraction * s.search_again_pause_s if r.again else 0.0
    r.spiral_radius_px = fraction * s.search_radius_px + s.spiral.pitch_px / 2


@compilable()
def star_at_rad(s: Any, r: Any, place_px: Any) -> tuple[float, float]:
    """``StarEstimator.motor_for_rad``."""
    return motor_rad(s, place_px[0] - r.star_origin_px[0], place_px[1] - r.star_origin_px[1])


@compilable()
def rest_prefilter(s: Any, r: Any) -> None:
    """COARSE begins with the prefilter at rest on the target."""
    for axis in range(2):
        r.command_px[axis], r.command_rate[axis] = s.target_px[axis], 0.0


# ---------------------------------------------------------------- the link, and other loops


@compilable()
def read_link(s: Any, r: Any, rr: Any) -> None:
    """``Link.read_now`` and ``Sky.read_at``."""
    r.sky_time_s = r.now_s
    if s.link >= 0:
        for axis in range(2):
            r.link_motor_rad[axis] = rr.beams[s.link].position_rad[axis]


@compilable()
def linked_rad(s: Any, r: Any, az_rad: float, el_rad: float) -> tuple[float, float]:
    """Motor angles that turn the star as far as the motors do, and the link's and the sky as last read."""
    if s.link >= 0:
        link_az_rad, link_el_rad = turned(s.link_matrix, r.link_motor_rad[0], r.link_motor_rad[1])
        az_rad += link_az_rad - r.link_origin_rad[0]
        el_rad += link_el_rad - r.link_origin_rad[1]
    return az_rad + s.sky_rad_s[0] * r.sky_time_s, el_rad + s.sky_rad_s[1] * r.sky_time_s


@compilable()
def undo_to_setpoint(s: Any, r: Any, rr: Any) -> None:
    """``Link.begin``."""
    setpoint_rad = rr.beams[s.link].setpoint_rad
    r.undone_rad[0], r.undone_rad[1] = turned(s.link_matrix, setpoint_rad[0], setpoint_rad[1])


@compilable()
def set_link_origin(s: Any, r: Any, rr: Any) -> None:
    """``Link.set_origin``."""
    undo_to_setpoint(s, r, rr)
    for axis in range(2):
        r.link_origin_rad[axis] = r.undone_rad[axis]


@compilable()
def follow_link(s: Any, r: Any, rr: Any) -> None:
    """``StarMotion.undo`` of the link."""
    az_rad, el_rad = r.undone_rad[0], r.undone_rad[1]
    if r.mode not in (ACQUISITION, COARSE, VERNIER):
        undo_to_setpoint(s, r, rr)
    elif rr.beams[s.link].mode == LOCKED and r.search_due == NOT_DUE:
        undo_to_setpoint(s, r, rr)
        undo_turn(s, r, az_rad - r.undone_rad[0], el_rad - r.undone_rad[1])


@compilable()
def follow_sky(s: Any, r: Any, rr: Any) -> None:
    """``StarMotion.undo`` of the sky."""
    light_arrives = s.link < 0 or rr.beams[s.link].mode == LOCKED
    if r.mode in (ACQUISITION, COARSE, VERNIER) and not (light_arrives and r.search_due == NOT_DUE):
        return
    az_rad, el_rad = r.sky_undone_rad[0], r.sky_undone_rad[1]
    for axis in range(2):
        r.sky_undone_rad[axis] = s.sky_rad_s[axis] * (r.now_s + s.period_s)
    if s.star_is_followed and r.mode in (ACQUISITION, COARSE, VERNIER):
        undo_turn(s, r, az_rad - r.sky_undone_rad[0], el_rad - r.sky_undone_rad[1])


@compilable()
def is_acquiring(r: Any) -> bool:
    """``StellarLoop.is_acquiring``."""
    if r.mode != ACQUISITION or r.waits:
        return False
    return bool(r.search_due == NOT_DUE and not r.again)


@compilable()
def is_there(s: Any, r: Any) -> bool:
    """``StarSearch.is_near`` of the set-point."""
    away_rad = max(abs(r.motor_rad[0] - r.setpoint_rad[0]), abs(r.motor_rad[1] - r.setpoint_rad[1]))
    return bool(away_rad * s.scale.motor_px_per_rad <= s.near_px)


@compilable()
def must_wait(ss: Any, rr: Any, i: int) -> bool:
    """Whether ``StellarLoop._why_wait`` has a reason."""
    s, r = ss.stars[i], rr.stars[i]
    if r.mode not in (ACQUISITION, COARSE, VERNIER):
        return False
    if s.link >= 0:
        link = rr.beams[s.link]
        if link.mode != LOCKED or r.now_s - link.mode_since_s < s.acquisition.settle_s:
            return True
        if r.waits and not is_there(s, r):
            return True
    if r.mode == ACQUISITION and r.search_due != NOT_DUE:
        for j in range(len(ss.stars)):
            if j != i and is_acquiring(rr.stars[j]):
                return True
    return False


@compilable()
def evaluate_waiting(ss: Any, rr: Any, i: int) -> None:
    """``StellarLoop._evaluate_waiting``."""
    s, r = ss.stars[i], rr.stars[i]
    waited, r.waits = r.waits, must_wait(ss, rr, i)
    if r.waits or r.mode not in (ACQUISITION, COARSE, VERNIER):
        return
    if waited:
        begin_following(r)
        if r.mode == COARSE:
            rest_prefilter(s, r)
        elif r.mode == VERNIER:
            start_pair(s, r, r.beam_rad[0], r.beam_rad[1])
    if r.mode == ACQUISITION and r.search_due != NOT_DUE:
        start_search(s, r, rr, r.motor_rad[0], r.motor_rad[1])


@compilable()
def rest_search(s: Any, r: Any) -> bool:
    """``StellarLoop._rest_search``; whether the loop waits."""
    passed_s, r.moved_s = r.now_s - r.moved_s, r.now_s
    waits = bool(r.waits or (r.mode == ACQUISITION and r.search_due != NOT_DUE))
    rested, r.search_rests = r.search_rests, 1 if waits and r.mode == ACQUISITION else 0
    if r.search_rests:
        r.search_since_s += passed_s
        if r.has_candidate:
            r.candidate.since_s += passed_s
        if not rested:
            siderostat_to(s, r, r.position_rad[0], r.position_rad[1])
            r.beyond_rad[0] = r.beyond_rad[1] = 0.0
    return waits


@compilable()
def use_design(s: Any, rr: Any, d: Any) -> None:
    """``StellarLoop.use``."""
    r = rr.stars[d.star]
    s.pair_states, s.pair_left_at_rest = d.pair_states, d.pair_left_at_rest
    s.inverse_wanted = d.inverse_wanted
    for column in range(5 + d.pair_states):
        for row in range(2 + d.pair_states):
            s.pair_system[row, column] = d.pair_system[row, column]
        for write in range(s.later_writes):
            s.pair_later[write, column] = d.pair_later[write, column]
    for state in range(d.pair_states):
        s.pair_at_rest[state] = d.pair_at_rest[state]
    if d.knows:
        for axis in range(2):
            for state in range(d.pair_states):
                r.pair_state[axis, state] = d.pair_state[axis, state]
            r.excess_px[axis] = 0.0
            r.motor_origin_rad[axis] = d.motor_origin_rad[axis]
            r.target_origin_px[axis] = d.target_origin_px[axis]
    elif r.mode == VERNIER:
        read_link(s, r, rr)
        az_rad, el_rad = linked_rad(s, r, r.position_rad[0], r.position_rad[1])
        start_pair(s, r, az_rad, el_rad)


# ---------------------------------------------------------------- findings


@compilable()
def propose(s: Any, r: Any) -> tuple[float, float]:
    """``Attribution.propose``; motor angles for the second look."""
    for axis in range(2):
        r.candidate_px[axis] = r.star_px[axis]
        r.origin_before_px[axis] = r.star_origin_px[axis]
        r.star_origin_px[axis] = r.star_px[axis] - r.seen_stages_px[axis]
    look = second_look(s.looks_px, r.star_px[0], r.star_px[1], r.rejected)
    return star_at_rad(s, r, s.looks_px[look])


@compilable()
def has_moved(ss: Any, rr: Any, i: int) -> bool:
    """``Attribution.has_moved``; True where no other loop's star is on the frame.

    In a batch, no loop is at rest and jogged while another searches.
    """
    r = rr.stars[i]
    if not ss.stars[i].shared:
        return True
    for j in range(len(rr.stars)):
        other = rr.stars[j]
        follows = j != i and other.mode in (COARSE, VERNIER) and not other.waits
        if follows and not other.star_visible:
            return False
    place_px = r.candidate_px
    return not is_within(r.star_px[0], r.star_px[1], place_px[0], place_px[1], HALF_WINDOW_PX)


@compilable()
def reject(r: Any) -> None:
    """``Attribution.reject``, and the way back to the spiral."""
    for axis in range(2):
        r.strangers_px[r.strangers % MOST_STRANGERS, axis] = r.candidate_px[axis]
        r.star_origin_px[axis] = r.origin_before_px[axis]
    r.strangers += 1
    r.rejected += 1
    r.has_arrived = 0


@compilable()
def evaluate_search(ss: Any, rr: Any, i: int, exposed_s: float) -> bool:
    """``Search.evaluate``; False where the search has ended without a star."""
    s, r = ss.stars[i], rr.stars[i]
    if not r.has_arrived:
        return True
    if math.isnan(r.search_since_s):
        r.search_since_s = exposed_s
    if r.has_candidate:
        shows = r.star_visible == 1 and has_moved(ss, rr, i)
        outcome = look_again(s.acquisition, r.candidate, shows, exposed_s)
        if outcome == CONFIRMED:
            fire(ss, rr, i, STAR_FOUND)
        elif outcome == REJECTED:
            r.has_candidate = 0
            if s.shared:
                reject(r)
    elif r.star_visible:
        r.has_candidate, r.candidate.since_s, r.candidate.frames = 1, exposed_s, 0
        az_rad, el_rad = propose(s, r) if s.shared else star_at_rad(s, r, s.middle_px)
        r.candidate.motor_rad[0], r.candidate.motor_rad[1] = az_rad, el_rad
    elif r.again and exposed_s - r.search_since_s > s.search_again_s:
        return False
    elif s.spiral.growth_px * r.spiral_angle >= r.spiral_radius_px:
        if not r.again:
            return False
        begin_round(s, r, r.round + 1)
    return True


@compilable()
def begin_following(r: Any) -> None:
    """``Following.begin``."""
    r.lost = r.in_reach = r.out_of_reach = r.off_target = 0


@compilable()
def has_lost_unmoved(s: Any, r: Any) -> bool:
    """``StellarLoop._find_unmoved``."""
    if not r.star_visible:
        return False
    star_px = (r.star_px[0], r.star_px[1])
    if not is_unmoved(r, star_px, stages_px(s, r), r.command_px):
        return False
    for axis in range(2):
        r.star_origin_px[axis] = r.off_star_px[axis] - r.off_stages_px[axis]
    return True


@compilable()
def evaluate_following(ss: Any, rr: Any, i: int) -> None:
    """``Following.evaluate``, after ``StellarLoop._find_unmoved``."""
    s, r = ss.stars[i], rr.stars[i]
    if has_lost_unmoved(s, r):
        fire(ss, rr, i, STAR_LOST)
        return
    # The diamond lies along the mirror's axes.
    az_px, el_px = turned(
        s.scale.mirror_back, r.star_px[0] - r.command_px[0], r.star_px[1] - r.command_px[1]
    )
    need = (abs(az_px) + abs(el_px)) / (s.scale.mirror_px_per_rad * s.range_rad)
    count_frame(r, r.star_visible == 1, need, s.coarse.reach_fraction)
    if r.lost >= s.acquisition.lost_frames:
        fire(ss, rr, i, STAR_LOST)
    elif r.mode == COARSE and r.in_reach >= s.coarse.reach_frames:
        fire(ss, rr, i, IN_REACH)
    elif r.mode == VERNIER and r.out_of_reach >= s.coarse.reach_frames:
        fire(ss, rr, i, OUT_OF_REACH)


@compilable()
def observe(s: Any, r: Any) -> None:
    """``StarEstimator.observe``, or ``Attribution.observe`` where other loops' stars are on the frame."""
    if not r.star_visible:
        return
    az_px, el_px = stages_px(s, r)
    r.seen_stages_px[0], r.seen_stages_px[1] = az_px, el_px
    if not s.shared or r.mode != ACQUISITION:
        r.star_origin_px[0], r.star_origin_px[1] = r.star_px[0] - az_px, r.star_px[1] - el_px


@compilable()
def evaluate(ss: Any, rr: Any, i: int, exposed_s: float) -> bool:
    """``StellarLoop._evaluate_findings``; False where the search has ended without a star."""
    if rr.stars[i].mode == ACQUISITION:
        return evaluate_search(ss, rr, i, exposed_s)
    evaluate_following(ss, rr, i)
    return True
