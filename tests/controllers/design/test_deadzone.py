import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ideal_loop import RANGE_RAD, run_pair

from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.deadzone import deadzone_result
from fitctl.controllers.design.eq20 import design_eq20

RANGE_PX = 6.748


@pytest.mark.parametrize("name", DESIGNS)
def test_every_design_is_bounded_and_has_no_limit_cycle_about_the_mirrors_limit(name, fit, flight):
    for basis in (fit, flight):
        found = deadzone_result(DESIGNS[name](basis), basis)
        assert found.bounded
        assert not found.limit_cycle


def without_feedback(design):
    b, d = design.b.copy(), design.d.copy()
    b[:, 1] = d[:, 1] = 0.0
    return dataclasses.replace(design, b=b, d=d)


def test_without_the_feedback_of_fig_10_eq_20_could_not_be_shown_to_be_bounded(fit):
    assert not deadzone_result(without_feedback(design_eq20(fit)), fit).bounded


def test_pairs_that_know_where_the_mirror_is_need_no_feedback(fit):
    for name in ("minimum-variance", "fslq"):
        assert deadzone_result(DESIGNS[name](fit), fit).largest_real == pytest.approx(0, abs=1e-6)


@pytest.mark.long
@pytest.mark.parametrize("name", DESIGNS)
def test_after_many_jumps_out_of_reach_every_course_comes_to_rest(name, rig, fit):
    random = np.random.default_rng(7)
    jumps = np.repeat(random.uniform(-40, 40, (40, 2)), random.integers(5, 200, 40), axis=0)
    star = np.vstack([jumps, np.zeros((12_000, 2))])
    course = run_pair(rig, DESIGNS[name](fit), star)
    limited = np.abs(course.wanted_px - course.mirror_px).max(axis=1) > 1e-9
    assert limited[: len(jumps)].sum() > 1000
    assert np.abs(course.mirror_px).sum(axis=1).max() <= RANGE_PX * 1.001
    assert not limited[-1000:].any()
    assert np.ptp(course.error_px[-1000:], axis=0).max() < 0.02
    assert np.abs(course.error_px[-1000:]).max() < 0.1


@pytest.mark.long
@settings(max_examples=10)
@given(
    jumps=st.lists(
        st.tuples(st.floats(-40, 40), st.floats(-40, 40), st.integers(1, 150)),
        min_size=1,
        max_size=12,
    ),
    name=st.sampled_from(list(DESIGNS)),
)
def test_no_jumps_make_it_swing(rig, fit, jumps, name):
    star = np.vstack([np.tile([az, el], (frames, 1)) for az, el, frames in jumps])
    course = run_pair(rig, DESIGNS[name](fit), np.vstack([star, np.zeros((5000, 2))]))
    # What is left moves slowly to rest: no two neighbouring frames differ.
    assert np.abs(np.diff(course.wanted_px[-500:], axis=0)).max() < 0.01
    # The siderostat never went farther than the star.
    assert np.abs(course.motor_px).max() <= 1.2 * max(np.abs(star).max(), 0.1)
    assert np.abs(course.mirror_px).sum(axis=1).max() <= RANGE_PX * 1.001


def test_the_mirror_leaves_its_limit_as_soon_as_the_star_is_back(rig, fit):
    star = np.zeros((1500, 2))
    star[100:600] = [30.0, 0.0]
    quick = run_pair(rig, no_siderostat(design_eq20(fit)), star, range_rad=RANGE_RAD)
    wound_up = run_pair(rig, no_siderostat(without_feedback(design_eq20(fit))), star)
    assert np.abs(quick.error_px[670:]).max() < 0.1
    assert np.abs(wound_up.error_px[670:]).max() > 1.0


def no_siderostat(design):
    still = np.array([[1.0], [0.0]])
    return dataclasses.replace(design, c=still * design.c, d=still * design.d)
