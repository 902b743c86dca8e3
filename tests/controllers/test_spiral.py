import itertools
import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.controllers.spiral import Spiral, plan_spiral
from fitctl.model.optics import scales


@pytest.fixture(scope="module")
def plan(rig):
    return plan_spiral(rig, "right")


@pytest.fixture(scope="module")
def walk_px(rig, plan):
    """The whole search, one place a frame; shape (frames, 2)."""
    spiral = Spiral(plan)
    walk = [spiral.position_px()]
    while not spiral.exhausted:
        walk.append(spiral.advance(rig.camera.period_s))
        assert len(walk) < 10_000
    return np.array(walk)


def frames_in_a_row(walk_px, star_px, radius_px):
    inside = np.linalg.norm(walk_px - star_px, axis=1) <= radius_px
    return max((sum(run) for seen, run in itertools.groupby(inside.tolist()) if seen), default=0)


@given(part=st.floats(0, 1), angle=st.floats(0, 2 * math.pi))
def test_every_star_in_the_search_radius_is_in_the_field_on_enough_frames(
    rig, plan, walk_px, part, angle
):
    acquisition = rig.loops["right"].acquisition
    arcsec_per_px = scales(rig, rig.loops["right"]).sky_arcsec_per_px
    radius_px = acquisition.search_radius_sky_arcsec / arcsec_per_px * math.sqrt(part)
    star_px = radius_px * np.array([math.cos(angle), math.sin(angle)])
    assert frames_in_a_row(walk_px, star_px, plan.field_radius_px) >= acquisition.found_frames
    # With the overlap taken off the field there is still a look to spare.
    reach_px = plan.field_radius_px * (1 - acquisition.field_overlap)
    assert frames_in_a_row(walk_px, star_px, reach_px) > acquisition.found_frames


def test_the_rim_of_the_search_is_seen_all_the_way_round(rig, plan, walk_px):
    # Where the last turn ends is the hardest place; go round in steps of a tenth of a field.
    rim_px = plan.radius_px - plan.pitch_px / 2
    for angle in np.linspace(0, 2 * math.pi, 320):
        star_px = rim_px * np.array([math.cos(angle), math.sin(angle)])
        seen = frames_in_a_row(walk_px, star_px, plan.field_radius_px)
        assert seen >= rig.loops["right"].acquisition.found_frames


def test_the_walk_keeps_its_speed_and_acceleration(rig, plan):
    spiral = Spiral(plan)
    period_s = 1 / rig.loops["right"].siderostat.servo.rate_hz
    walk_px = np.array([spiral.advance(period_s) for _ in range(2000)])
    velocity_px_s = np.diff(walk_px, axis=0) / period_s
    acceleration_px_s2 = np.diff(velocity_px_s, axis=0) / period_s
    assert np.linalg.norm(velocity_px_s, axis=1).max() <= plan.speed_px_s * 1.001
    # The plan bounds the turning; gathering speed adds a few per cent.
    assert np.linalg.norm(acceleration_px_s2, axis=1).max() <= plan.acceleration_px_s2 * 1.05


def test_most_of_the_walk_is_at_full_speed(rig, plan, walk_px):
    speed_px_s = np.linalg.norm(np.diff(walk_px, axis=0), axis=1) / rig.camera.period_s
    assert np.median(speed_px_s) == pytest.approx(plan.speed_px_s, rel=0.01)


def test_motors_and_blur_are_respected(rig, plan):
    loop = rig.loops["right"]
    motor_rad_s = plan.speed_px_s / scales(rig, loop).motor_px_per_rad
    assert motor_rad_s <= 0.5 * loop.siderostat.velocity_limit_rad_s
    assert plan.speed_px_s * rig.camera.exposure_s <= 3.0


def test_the_search_starts_in_the_middle_goes_outward_and_ends(plan, walk_px):
    distance_px = np.linalg.norm(walk_px, axis=1)
    assert distance_px[0] == 0.0
    assert np.all(np.diff(distance_px) > 0)
    assert distance_px[-2] < plan.radius_px <= distance_px[-1]


def test_progress_is_the_part_of_the_area_searched(rig, plan):
    spiral = Spiral(plan)
    progress = [spiral.progress]
    while not spiral.exhausted:
        place = spiral.advance(rig.camera.period_s)
        progress.append(spiral.progress)
        area = (np.linalg.norm(place) / plan.radius_px) ** 2
        assert spiral.progress == pytest.approx(min(1.0, area))
    assert progress[0] == 0.0
    assert progress == sorted(progress)
    assert progress[-1] == 1.0
