"""Which of several stars on a frame a loop that has the frame to itself finds."""

import numpy as np
import pytest

from fitctl.config import AxisPair, Spot
from fitctl.loop.search.finder import StarFinder
from fitctl.messages.modes import FOLLOWING, WITH_WINDOW, Mode
from fitctl.model.image.scene import Scene

STAR, BRIGHTER = (12.0, 15.0), (27.0, 22.0)  # px
REST = np.zeros(2)


@pytest.fixture
def finder(rig):
    """The star is expected 4 px from where it is."""
    finder = StarFinder(rig, "right", np.array([STAR[0] + 4.0, STAR[1]]), lambda *_: None)
    finder.expect_flux(28_000.0)
    return finder


@pytest.fixture
def expose(rig):
    """A frame of stars at some places, each brighter than the one before."""

    def frame(*places_px):
        spots = [
            Spot(
                name=f"star-{number}",
                offset_px=AxisPair(az=0.0, el=0.0),
                flux_dn=26_000.0 + 4_000.0 * number,
                diameter_px=3.0,
            )
            for number in range(len(places_px))
        ]
        return Scene(rig.camera, spots).frame(np.array(places_px), 1, 1)

    return frame


def found_px(finder, image, mode, *, follows=False, again=False):
    star = finder.find(image, mode, REST, REST, follows=follows, again=again)
    return None if star is None else star[:2]


@pytest.mark.parametrize("follows", [True, False])
@pytest.mark.parametrize("mode", sorted(FOLLOWING))
def test_a_star_that_is_followed_is_the_nearest_to_where_it_is_expected(
    finder, expose, mode, follows
):
    image = expose(STAR, BRIGHTER)
    assert found_px(finder, image, mode, follows=follows) == pytest.approx(STAR, abs=0.06)


@pytest.mark.parametrize("follows", [True, False])
@pytest.mark.parametrize("mode", sorted(WITH_WINDOW))
def test_what_is_far_from_where_it_is_expected_is_another_star(finder, expose, mode, follows):
    assert found_px(finder, expose(BRIGHTER), mode, follows=follows) is None


@pytest.mark.parametrize("follows", [True, False])
def test_an_experiment_may_move_the_star_farther_than_the_rig_file_says(finder, expose, follows):
    px = found_px(finder, expose(BRIGHTER), Mode.EXPERIMENT, follows=follows)
    assert px == pytest.approx(BRIGHTER, abs=0.06)


def test_a_first_search_finds_the_brightest(finder, expose):
    image = expose(STAR, BRIGHTER)
    assert found_px(finder, image, Mode.ACQUISITION) == pytest.approx(BRIGHTER, abs=0.06)


def test_a_search_for_a_star_that_was_lost_finds_the_nearest_however_far(finder, expose):
    image = expose(STAR, BRIGHTER)
    px = found_px(finder, image, Mode.ACQUISITION, again=True)
    assert px == pytest.approx(STAR, abs=0.06)

    px = found_px(finder, expose(BRIGHTER), Mode.ACQUISITION, again=True)
    assert px == pytest.approx(BRIGHTER, abs=0.06)
