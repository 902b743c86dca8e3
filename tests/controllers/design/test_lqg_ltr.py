import dataclasses

import control
import numpy as np
import pytest

from fitctl.controllers.design.linear_loop.loopshape import compensator_response
from fitctl.controllers.design.lqg_ltr import (
    COMPARED_RAD_S,
    Compensator,
    design_lqg_ltr,
    distance_db_deg,
    distance_from_eq20,
    in_pairs,
    kalman_gain,
    nominal_plant,
    recovered,
    recovery,
    target_loop,
    vernier_compensator,
    without_fast_poles,
)


@pytest.fixture(scope="module")
def compensator(fit):
    return vernier_compensator(fit)


def response(found):
    return compensator_response(found.zeros, found.poles, found.gain)(COMPARED_RAD_S)


def test_it_is_eq_20_within_half_a_db_and_two_degrees(compensator):
    distance_db, distance_deg = distance_from_eq20(compensator)
    assert distance_db < 0.5
    assert distance_deg < 2.0


def test_it_has_the_order_of_eq_20_and_its_roots(compensator):
    assert len(compensator.poles) == 8
    assert len(compensator.zeros) == 7
    for printed in (-15.6, -4.4, -1.2, -0.44):
        assert np.abs(compensator.poles - printed).min() < 0.02
    for printed in (-25.0, -4.5, -0.5):
        assert np.abs(compensator.zeros / printed - 1).min() < 0.05


def test_what_is_removed_are_the_two_fast_poles_of_a_finite_recovery(compensator):
    assert sorted(compensator.removed_poles.imag) == pytest.approx([-656, 656], abs=1)
    assert compensator.removed_poles.real == pytest.approx([-656, -656], abs=1)


def test_removing_them_changes_nothing_at_rest_and_little_up_to_100_rad_s(fit, compensator):
    plant = nominal_plant(fit)
    settings = fit.settings.lqg_ltr
    whole = recovered(plant, kalman_gain(plant, settings), settings.control_weight)
    assert response(compensator)[0] == pytest.approx(response(whole)[0], rel=1e-3)
    distance_db, distance_deg = distance_db_deg(response(compensator), response(whole))
    assert distance_db < 0.05
    assert distance_deg < 10  # what the two poles turn at 100 rad/s


def test_the_compensator_is_c_lqg_times_the_nominal_plant(fit):
    """Eq. 17-20 straight from the matrices, by python-control."""
    plant, settings = nominal_plant(fit), fit.settings.lqg_ltr
    kalman = kalman_gain(plant, settings)
    k, *_ = control.lqr(plant.a, plant.b, plant.c.T @ plant.c, [[settings.control_weight]])
    lqg = control.ss(plant.a - kalman @ plant.c - plant.b @ k, kalman, k, 0)
    product = lqg(1j * COMPARED_RAD_S) * control.ss(plant.a, plant.b, plant.c, 0)(
        1j * COMPARED_RAD_S
    )
    found = recovered(plant, kalman, settings.control_weight)
    assert response(found) == pytest.approx(product, rel=1e-6)


def test_the_kalman_gain_solves_eq_14(fit):
    plant, settings = nominal_plant(fit), fit.settings.lqg_ltr
    v, w = settings.measurement_noise, np.diag(settings.process_noise)
    gain = kalman_gain(plant, settings)
    m = control.care(plant.a.T, plant.c.T, plant.b_noise @ w @ plant.b_noise.T, np.array([[v]]))[0]
    assert gain == pytest.approx(m @ plant.c.T / v, rel=1e-8)


def test_the_target_loop_never_amplifies(fit):
    """The guarantee of a Kalman filter's loop, for which the paper chose it: |1 + G_TFL| >= 1."""
    plant = nominal_plant(fit)
    loop = target_loop(plant, kalman_gain(plant, fit.settings.lqg_ltr), COMPARED_RAD_S)
    assert np.abs(1 + loop).min() > 1 - 1e-9


def test_the_loop_is_recovered_as_r_falls(fit):
    steps = recovery(fit, [1e-6, 1e-8, 0.5e-9, 1e-11])
    distances = [step.distance_db for step in steps]
    assert distances == sorted(distances, reverse=True)
    assert steps[2].distance_db < 0.3
    assert steps[-1].distance_deg < steps[0].distance_deg / 10


def test_more_measurement_noise_lowers_the_crossover(fit):
    gains = []
    for noise in (0.5e-3, 1.025e-3, 4e-3):
        lqg_ltr = fit.settings.lqg_ltr.model_copy(update={"measurement_noise": noise})
        settings = fit.settings.model_copy(update={"lqg_ltr": lqg_ltr})
        gains.append(vernier_compensator(dataclasses.replace(fit, settings=settings)).gain)
    assert gains == sorted(gains, reverse=True)


def test_the_design_is_stable_by_itself(fit, flight):
    for basis in (fit, flight):
        assert np.abs(np.linalg.eigvals(design_lqg_ltr(basis).a)).max() < 1


def test_roots_that_rounding_has_left_apart_become_pairs():
    """The zeros of a system come from a generalized eigenvalue problem, which does not promise pairs."""
    found = in_pairs(np.array([-1 + 1e-14j, -2 + 3.0000000000001j, -2 - 3j]))
    assert np.all(np.poly(found).imag == 0)
    assert found == pytest.approx([-1, -2 + 3j, -2 - 3j])


@pytest.mark.parametrize("roots", [[-1 + 1j], [-1 + 1j, -2 - 1j]])
def test_roots_that_are_no_pairs_are_refused(roots):
    with pytest.raises(ArithmeticError, match="pairs"):
        in_pairs(np.array(roots))


def test_a_pair_of_poles_is_not_parted():
    poles = np.array([-1.0, -2.0 + 50.0j, -2.0 - 50.0j, -100.0])
    with pytest.raises(ArithmeticError, match="part a pair"):
        without_fast_poles(Compensator(np.empty(0, complex), poles, 1.0, np.empty(0, complex)))
