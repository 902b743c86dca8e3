"""Whether a star that is followed is moved by the loop's stages, frame by frame."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.centroid import Star
from fitctl.loop.following import Following
from fitctl.messages.modes import Trigger
from fitctl.model.optics import scales

RIG = load_rig(default_rig_path())
TARGET_PX = (20.0, 20.0)


@pytest.fixture
def following():
    return new_following()


def new_following():
    (loop,) = RIG.stellar_loops.values()
    return Following(loop, scales(RIG, loop))


def judged(following, course):
    """The first frame with a finding, and what it is; the course has star and stages, az and el in px."""
    for number, (az_px, el_px, *stages_px) in enumerate(course):
        star = Star(az_px, el_px, 4e4, round(az_px), round(el_px))
        found = following.unmoved(star, tuple(stages_px), TARGET_PX)
        if found is not None:
            return number, found
    return None


def test_a_spot_that_stands_still_while_the_stages_move_is_not_the_loops_star(following):
    number, found = judged(following, [(24.0, 20.0, -0.1 * i, 0.0) for i in range(200)])

    assert found.trigger is Trigger.STAR_LOST
    assert "moved the star by 9 px, but this spot did not move with them" in found.reason
    assert number == 90
    assert (following.off_star_px, following.off_stages_px) == ([24.0, 20.0], [0.0, 0.0])


def test_a_spot_that_runs_away_from_the_stages_is_not_the_loops_star(following):
    assert judged(following, [(22.0 + 0.05 * i, 20.0, -0.05 * i, 0.0) for i in range(200)])


@pytest.mark.long
@given(
    start_px=st.tuples(st.floats(3.0, 36.0), st.floats(3.0, 36.0)),
    answer=st.floats(0.7, 1.3),  # hysteresis, and a plate scale that is a little wrong
    wander_px=st.lists(st.floats(-0.5, 0.5), min_size=100, max_size=100),
)
def test_a_star_that_the_stages_bring_to_its_target_is_the_loops(start_px, answer, wander_px):
    ways = [target - start for target, start in zip(TARGET_PX, start_px, strict=True)]
    course = []
    for i, wander in enumerate(wander_px):
        az_px, el_px = (0.01 * i * way for way in ways)
        star_az_px, star_el_px = start_px[0] + answer * az_px, start_px[1] + answer * el_px
        course.append((star_az_px + wander, star_el_px - wander, az_px, el_px))

    assert judged(new_following(), course) is None


def test_a_star_that_jumps_and_is_brought_back_is_the_loops(following):
    held = [(20.0, 20.0, 0.0, 0.0)] * 10
    back = [(32.0 - 0.1 * i, 20.0, -0.1 * i, 0.0) for i in range(121)]

    assert judged(following, held + back) is None


def test_a_star_that_is_held_while_it_drifts_is_the_loops(following):
    assert judged(following, [(20.3, 20.0, -0.1 * i, 0.0) for i in range(1000)]) is None


def test_frames_without_a_star_are_not_judged(following):
    following.unmoved(Star(24.0, 20.0, 4e4, 24, 20), (0.0, 0.0), TARGET_PX)

    assert following.unmoved(None, (-30.0, 0.0), TARGET_PX) is None
