import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.eq20 import design_eq20
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.sampled import timing
from fitctl.model.air_path import step_matrices


def test_the_bound_of_fit(fit):
    found = bound(fit)
    assert found.residual_px == pytest.approx(0.0130, abs=5e-5)
    assert found.frame_residual_px == pytest.approx(0.0121, abs=1e-4)
    assert found.open_loop_px == pytest.approx(0.201, abs=5e-4)


def test_at_the_flight_rate_it_is_far_lower(fit, flight):
    assert bound(flight).residual_px < 0.3 * bound(fit).residual_px


def test_it_grows_with_delay_and_with_noise(fit):
    delayed = [
        bound(dataclasses.replace(fit, delay_s=s)).residual_px for s in (0.0, 0.01, 0.035, 0.1)
    ]
    assert delayed == sorted(delayed)
    noisy = [bound(dataclasses.replace(fit, noise_px=px)).residual_px for px in (1e-4, 0.01, 0.1)]
    assert noisy == sorted(noisy)


def test_more_writes_of_the_da_hardly_help_against_the_air_and_much_against_a_fast_line(fit):
    def left_px(basis):
        each = (dataclasses.replace(basis, writes=writes) for writes in (1, 2, 4, 10))
        return [bound(one).residual_px for one in each]

    air, line = left_px(fit), left_px(dataclasses.replace(fit, lines=(Line(20.0, 0.005, 0.05),)))

    assert air == sorted(air, reverse=True)
    assert air[-1] > 0.995 * air[0]
    assert line == pytest.approx([0.0367, 0.0257, 0.0213, 0.0198], abs=5e-5)


def test_behind_a_delay_longer_than_the_air_path_remembers_it_is_the_open_loop(fit):
    found = bound(dataclasses.replace(fit, delay_s=6.0))
    assert found.residual_px == pytest.approx(found.open_loop_px, rel=0.01)


@pytest.mark.parametrize("name", DESIGNS)
def test_no_design_goes_below_it(name, fit, flight):
    for basis in (fit, flight):
        assert linear_residual(DESIGNS[name](basis), basis) > 0.995 * bound(basis).residual_px


@settings(max_examples=15)
@given(delay_s=st.floats(0.0, 0.1), noise_px=st.floats(3e-3, 0.1))
def test_minimum_variance_reaches_it_for_any_delay_and_noise(fit, delay_s, noise_px):
    basis = dataclasses.replace(fit, delay_s=delay_s, noise_px=noise_px)
    residual_px = linear_residual(DESIGNS["minimum-variance"](basis), basis)
    assert residual_px < 1.02 * bound(basis).residual_px


def test_an_unstable_loop_has_no_residual(fit):
    design = design_eq20(fit)
    doubled = dataclasses.replace(design, c=2 * design.c, d=2 * design.d)
    assert linear_residual(doubled, fit) == math.inf


def test_eq_20_leaves_what_it_leaves(fit):
    assert linear_residual(design_eq20(fit), fit) == pytest.approx(0.0177, abs=1e-4)


@pytest.mark.long
@pytest.mark.parametrize(
    ("name", "delay_s"),
    [("eq20", 0.035), ("minimum-variance", 0.0), ("minimum-variance", 0.013), ("fslq", 0.035)],
)
def test_the_linear_residual_is_what_a_simulation_in_small_steps_leaves(fit, name, delay_s):
    basis = dataclasses.replace(fit, delay_s=delay_s)
    design = DESIGNS[name](basis)
    assert linear_residual(design, basis) == pytest.approx(
        simulated_residual(design, basis, runs=300, duration_s=16.0), rel=0.03
    )


def simulated_residual(design, basis, runs, duration_s, step_s=0.0005):
    random = np.random.default_rng(4)
    transition, gain = step_matrices(basis.air_path, step_s)
    per_frame, late = round(basis.period_s / step_s), round(basis.delay_s / step_s)
    air, state = np.zeros((2, runs)), np.zeros((len(design.a), runs))
    mirror, motor, rate = np.zeros(runs), np.zeros(runs), np.zeros(runs)
    commands, squares, settled = {}, [], round(6.0 / step_s)
    for step in range(round(duration_s / step_s)):
        if step % per_frame == 0:
            error = air[0] + mirror + motor + basis.noise_px * random.standard_normal(runs)
            inputs = np.array([error, 0 * error, mirror, motor, 0 * error])
            commands[step + late] = design.c @ state + design.d @ inputs
            state = design.a @ state + design.b @ inputs
        if step in commands:
            mirror, walk = commands.pop(step)
            rate = walk / per_frame
        if step > settled:
            squares.append(np.mean((air[0] + mirror + motor) ** 2))
        motor = motor + rate
        air = transition @ air + gain @ random.standard_normal((2, runs))
    return math.sqrt(np.mean(squares))


@pytest.mark.parametrize(
    ("delay_s", "frames", "walked"),
    [(0.035, 2, 0.25), (0.0, 1, 1.0), (0.02, 1, 0.0), (0.04, 2, 0.0), (0.0401, 3, 0.995)],
)
def test_how_a_delay_falls_into_frames_of_20_ms(delay_s, frames, walked):
    found = timing(0.02, delay_s)
    assert found.frames == frames
    assert found.walked == pytest.approx(walked)
