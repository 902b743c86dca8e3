import math

import numpy as np
import pytest

from fitctl.controllers.coarse import CoarseIntegrator
from fitctl.model.optics import scales


@pytest.fixture
def integrator(rig):
    gain = rig.loops["right"].coarse.gain_rad_per_m
    return CoarseIntegrator(gain, rig.camera.pixel_size_m, rig.camera.period_s)


def test_the_loop_crosses_at_0_074_hz(rig):
    metres_per_rad = scales(rig, rig.loops["right"]).motor_px_per_rad * rig.camera.pixel_size_m
    crossover_rad_s = rig.loops["right"].coarse.gain_rad_per_m * metres_per_rad
    assert crossover_rad_s == pytest.approx(0.464, abs=5e-4)
    assert crossover_rad_s / (2 * math.pi) == pytest.approx(0.074, abs=5e-4)


def test_a_pixel_of_error_moves_the_motors_against_it(rig, integrator):
    for _ in range(50):
        setpoint_rad = integrator.step(np.array([1.0, -2.0]))
    rate_rad_s = rig.loops["right"].coarse.gain_rad_per_m * rig.camera.pixel_size_m
    assert setpoint_rad == pytest.approx([-rate_rad_s, 2 * rate_rad_s])


def test_without_error_nothing_moves(integrator):
    integrator.reset(np.array([3.0, 4.0]))
    assert integrator.step(np.zeros(2)).tolist() == [3.0, 4.0]


def test_it_pulls_a_star_in_with_its_time_constant(rig, integrator):
    px_per_rad = scales(rig, rig.loops["right"]).motor_px_per_rad
    star_px = np.array([8.0, -4.0])
    frames = round(1 / 0.464 / rig.camera.period_s)
    for _ in range(frames):
        error_px = star_px + px_per_rad * integrator.setpoint_rad
        integrator.step(error_px)
    left = (star_px + px_per_rad * integrator.setpoint_rad) / star_px
    assert left == pytest.approx(math.exp(-1), rel=0.01)


def test_a_set_point_handed_out_is_not_changed_later(integrator):
    handed_out = integrator.step(np.array([1.0, 1.0]))
    before = handed_out.tolist()
    integrator.step(np.array([1.0, 1.0]))
    assert handed_out.tolist() == before
