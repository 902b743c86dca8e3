import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.controllers.estimator import StarEstimator
from fitctl.model.optics import scales

TARGET_PX = np.array([24.0, 19.5])
motors = st.tuples(*2 * [st.floats(-300, 300)]).map(np.array)
mirrors = st.tuples(*2 * [st.floats(-1.8e-4, 1.8e-4)]).map(np.array)
places = st.tuples(*2 * [st.floats(-100, 140)]).map(np.array)


@pytest.fixture(scope="module")
def scale(rig):
    return scales(rig, rig.loops["right"])


@pytest.fixture
def estimator(scale):
    return StarEstimator(scale, TARGET_PX)


def test_an_unknown_star_is_taken_to_be_on_the_target(estimator):
    still_rad = np.zeros(2)
    assert estimator.predict_px(estimator.stages_px(still_rad, still_rad)) == tuple(TARGET_PX)


def test_a_star_that_was_seen_is_expected_there_until_that_is_forgotten(estimator):
    seen_px, elsewhere_px, still_rad = (3.0, 4.0), np.array([7.0, 8.0]), np.zeros(2)
    estimator.observe(seen_px, (0.0, 0.0))
    estimator.expect(elsewhere_px, still_rad, still_rad)
    assert estimator.predict_px((0.0, 0.0)) == seen_px
    estimator.forget()
    estimator.expect(elsewhere_px, still_rad, still_rad)
    assert estimator.predict_px((0.0, 0.0)) == tuple(elsewhere_px)


@given(star_px=places, motor_rad=motors, mirror_rad=mirrors)
def test_with_the_stages_as_they_were_the_star_is_where_it_was_seen(
    scale, star_px, motor_rad, mirror_rad
):
    estimator = StarEstimator(scale, TARGET_PX)
    estimator.observe(star_px, estimator.stages_px(motor_rad, mirror_rad))
    assert estimator.predict_px(estimator.stages_px(motor_rad, mirror_rad)) == pytest.approx(
        star_px, abs=1e-9
    )


@given(first=motors, then=motors, mirror_rad=mirrors)
def test_the_star_moves_by_what_the_stages_do(scale, first, then, mirror_rad):
    estimator = StarEstimator(scale, TARGET_PX)
    estimator.observe((20.0, 20.0), estimator.stages_px(first, np.zeros(2)))
    moved_px = np.array(estimator.predict_px(estimator.stages_px(then, mirror_rad))) - 20.0
    expected_px = scale.motor_px_per_rad * (then - first) + scale.mirror_px_per_rad * mirror_rad
    assert moved_px == pytest.approx(expected_px, abs=1e-9)


@given(star_px=places, wanted_px=places, motor_rad=motors, mirror_rad=mirrors)
def test_motors_sent_for_a_place_bring_the_star_there(
    scale, star_px, wanted_px, motor_rad, mirror_rad
):
    estimator = StarEstimator(scale, TARGET_PX)
    estimator.observe(star_px, estimator.stages_px(motor_rad, np.zeros(2)))
    motors_rad = estimator.motor_for_rad(wanted_px, mirror_rad)
    assert estimator.predict_px(estimator.stages_px(motors_rad, mirror_rad)) == pytest.approx(
        wanted_px, abs=1e-9
    )


def test_the_target_given_may_change_afterwards(scale):
    target_px = TARGET_PX.copy()
    estimator = StarEstimator(scale, target_px)
    target_px += 5.0
    still_rad = np.zeros(2)
    assert estimator.predict_px(estimator.stages_px(still_rad, still_rad)) == tuple(TARGET_PX)
