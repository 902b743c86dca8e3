import dataclasses

import numpy as np
import pytest
from ideal_loop import run_pair

from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual

NO_LIMIT_RAD = 1e6


@pytest.fixture(params=["minimum-variance", "fslq"])
def make(request):
    """Either of the two designs that predict."""
    return DESIGNS[request.param]


def test_it_leaves_hardly_more_than_the_bound(make, fit, flight):
    for basis in (fit, flight):
        assert linear_residual(make(basis), basis) < 1.03 * bound(basis).residual_px


@pytest.mark.parametrize("wrong_s", [-0.003, 0.003])
def test_a_delay_wrong_by_3_ms_costs_little(make, fit, changed, wrong_s):
    truth = changed(fit, delay_s=wrong_s)
    assert linear_residual(make(fit), truth) < 1.05 * bound(truth).residual_px


@pytest.mark.parametrize("gain", [0.5, 2.0])
def test_a_disturbance_of_half_or_twice_the_strength_costs_little(make, fit, changed, gain):
    truth = changed(fit, gain=gain)
    assert linear_residual(make(fit), truth) < 1.15 * bound(truth).residual_px


def test_all_of_it_wrong_at_once_is_still_stable(make, fit, changed):
    for wrong_s in (-0.003, 0.003):
        for gain in (0.5, 2.0):
            truth = changed(fit, delay_s=wrong_s, gain=gain)
            assert linear_residual(make(fit), truth) < 1.25 * bound(truth).residual_px


@pytest.mark.long
def test_a_shift_of_the_star_is_undone_and_the_mirror_returns_to_its_bias(make, rig, fit):
    star = np.tile([3.0, -2.0], (12_000, 1))
    course = run_pair(rig, make(fit), star)
    assert np.abs(course.error_px[300:]).max() < 0.02  # the mirror first,
    assert np.abs(course.mirror_px[100]).max() > 1.0
    assert np.abs(course.mirror_px[-1]).max() < 0.02  # then the siderostat
    assert course.motor_px[-1] == pytest.approx([-3.0, 2.0], abs=0.02)


def test_it_follows_its_target(make, rig, fit):
    target = np.zeros((3000, 2))
    target[500:] = [1.0, -1.0]
    course = run_pair(rig, make(fit), np.zeros((3000, 2)), target)
    # The new target is known at once: nothing has to be seen before the mirror goes.
    assert np.abs(course.error_px[505:]).max() < 0.05


def test_a_star_out_of_reach_winds_nothing_up(make, rig, fit):
    star = np.zeros((4000, 2))
    star[200:450] = [30.0, 0.0]
    course = run_pair(rig, make(fit), star)
    limited = np.abs(course.wanted_px - course.mirror_px).max(axis=1) > 1e-9
    assert limited[220:440].all()
    assert not limited[-500:].any()
    # The same without a limit: once the star is back, both are the same loop from where they are.
    assert np.abs(course.error_px[700:]).max() < np.abs(course.motor_px[450]).max()
    assert np.abs(course.error_px[-1000:]).max() < 0.05


def test_what_the_mirror_was_kept_from_doing_is_not_taken_for_the_stars_motion(make, rig, fit):
    """With the limit the wanted command is the same as without: the known mirror is subtracted."""
    random = np.random.default_rng(3)
    star = np.cumsum(random.standard_normal((600, 2)), axis=0)
    limited = run_pair(rig, make(fit), star)
    free = run_pair(rig, make(fit), star, range_rad=NO_LIMIT_RAD)
    assert np.abs(limited.wanted_px - limited.mirror_px).max() > 1.0
    assert limited.wanted_px == pytest.approx(free.wanted_px, abs=1e-6)


def test_fslq_gives_the_siderostat_more_work_the_higher_it_crosses(rig, fit):
    star = np.tile([1.0, 0.0], (500, 1))
    moved = []
    for crossover_hz in (0.01, 0.03, 0.1, 0.3):
        fslq = fit.settings.fslq.model_copy(update={"crossover_hz": crossover_hz})
        basis = dataclasses.replace(fit, settings=fit.settings.model_copy(update={"fslq": fslq}))
        moved.append(-run_pair(rig, DESIGNS["fslq"](basis), star).motor_px[-1, 0])
    assert moved == sorted(moved)
    assert moved[-1] > 0.9


def test_fslq_that_may_cost_nothing_comes_to_the_bound(fit):
    cheap = fit.settings.fslq.model_copy(update={"control_weight": 0.01})
    basis = dataclasses.replace(fit, settings=fit.settings.model_copy(update={"fslq": cheap}))
    assert linear_residual(DESIGNS["fslq"](basis), basis) < 1.01 * bound(fit).residual_px
