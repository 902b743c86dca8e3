"""Whether a second look shows the loop's own star: it came along with the stages, and can be no other."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.centroid import Star
from fitctl.controllers.estimator import StarEstimator
from fitctl.loop.search.attribution import Attribution, OtherStages
from fitctl.model.optics import scales

TARGET_PX = 12.0, 20.0
TWO_STARS = load_rig(default_rig_path().with_name("two-stars.toml"))


def star_at(az_px, el_px):
    return Star(az_px, el_px, 1000.0, round(az_px), round(el_px), 0.01, 0.01)


def right(*moved_px, follow=True, lost=False):
    return {"right": OtherStages(moved_px, follow, lost, np.array([28.0, 20.0]))}


@pytest.fixture
def attribution():
    """That of the left loop, which has a candidate at az 26 px and brings it to its target."""
    scale = scales(TWO_STARS, TWO_STARS.stellar_loops["left"])
    attribution = Attribution(TWO_STARS.camera, StarEstimator(scale, np.array(TARGET_PX)))
    place_px = attribution.propose(star_at(26.0, 20.0), np.array(TARGET_PX), right(0.0, 0.0))
    assert place_px.tolist() == [*TARGET_PX]
    return attribution


def test_a_candidate_that_has_come_along_is_the_loops_own(attribution):
    assert attribution.has_moved(star_at(12.5, 20.0), right(0.0, 0.0))


def test_one_that_stays_where_it_was_is_not(attribution):
    assert not attribution.has_moved(star_at(26.5, 20.0), right(0.0, 0.0))


def test_what_the_stages_of_a_loop_at_rest_have_moved_there_is_its_star(attribution):
    assert not attribution.has_moved(star_at(12.5, 20.0), right(-14.0, 0.0, follow=False))


def test_it_may_be_a_star_that_a_loop_which_follows_it_has_just_lost(attribution):
    """A gust takes that one out of its window, and to where the candidate is expected."""
    assert not attribution.has_moved(star_at(12.5, 20.0), right(0.0, 0.0, lost=True))
    assert attribution.has_moved(star_at(12.5, 20.0), right(0.0, 0.0, follow=False, lost=True))
