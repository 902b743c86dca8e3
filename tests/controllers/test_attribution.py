"""A candidate for a loop's star on a shared frame is moved so that it shows whose it is."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.attribution import (
    FOLLOWED_PX,
    LOOKS,
    MOVE_PX,
    look_places_px,
    second_look,
)

RIG = default_rig_path().with_name("two-stars.toml")
CAMERA = load_rig(RIG).camera
RIGHT_PX = np.array([28.0, 20.0])
LOOKS_PX = look_places_px(CAMERA, RIGHT_PX, [np.array([12.0, 20.0])])
seen = st.tuples(st.floats(3.0, 36.0), st.floats(3.0, 36.0))


@given(star=seen, rejected=st.integers(0, 8))
def test_a_candidate_is_moved_farther_than_a_star_may_be_from_where_it_is_expected(star, rejected):
    place = LOOKS_PX[second_look(LOOKS_PX, *star, rejected)]
    assert np.abs(place - star).max() > FOLLOWED_PX


def test_it_comes_to_the_target_at_once_if_that_shows_enough():
    for away_px, look in ((FOLLOWED_PX + 0.1, 0), (FOLLOWED_PX - 0.1, 1)):
        assert second_look(LOOKS_PX, 28.0 - away_px, 20.0, 0) == look


def test_places_come_in_turn_as_candidates_are_rejected():
    places = [second_look(LOOKS_PX, 5.0, 20.0, rejected) for rejected in range(2 * LOOKS)]
    assert places == [0, 1, 2, 0, 1, 2]


@pytest.mark.parametrize(
    ("left_px", "places_px"),
    [
        ((12.0, 20.0), [(28.0, 20.0), (28.0, 29.0), (28.0, 11.0)]),
        ((28.0, 4.0), [(28.0, 20.0), (36.0, 20.0), (19.0, 20.0)]),
    ],
)
def test_they_lie_across_the_direction_of_the_other_target_and_on_the_frame(left_px, places_px):
    found_px = look_places_px(CAMERA, RIGHT_PX, [np.array(left_px)])
    assert MOVE_PX == 9.0
    assert found_px == pytest.approx(np.array(places_px))
