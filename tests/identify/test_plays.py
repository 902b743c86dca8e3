import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fitctl.identify.plays import fit_gains, model_from_ramp, place_breakpoints, trail
from fitctl.model.hysteresis import half_widths_v, hysteresis_output, stack_gains

FULL_V = 10.0
RISING = np.linspace(0.0, FULL_V, 401)
SWEPT = np.concatenate([np.linspace(0, FULL_V, 50), np.linspace(FULL_V, 0, 50)])


@pytest.fixture
def stacks(rig):
    """Half widths, and gains of three stacks that differ."""
    settings = rig.plant.loops["right"].hysteresis
    gains = stack_gains(settings, rig.loops["right"].fsm)
    bends = np.where(np.arange(gains.size) > 0, np.array([[1.0], [0.5], [1.5]]), 1.0)
    return half_widths_v(settings), gains * bends


def output(volts, half_widths, gains):
    """Displacement, shape (stacks, m), of stacks that all have the same voltages."""
    together = np.repeat(np.asarray(volts)[:, None], len(gains), axis=1)
    return hysteresis_output(trail(together, half_widths), gains).T


def rms(values):
    return np.sqrt(np.mean(values**2, axis=-1))


def test_eq_6_makes_models_of_many_stacks_from_one_ramp(stacks):
    ramp_m = output(RISING, *stacks)

    half_widths_v, gains_m_per_v = model_from_ramp(RISING, ramp_m)

    assert half_widths_v.size == 13
    # What only wide elements tell is the same constant throughout.
    minor = np.concatenate([SWEPT, 5 - 5 * np.cos(RISING) * np.linspace(1, 0, RISING.size)])
    error_m = output(minor, half_widths_v, gains_m_per_v) - output(minor, *stacks)
    error_m = error_m[:, SWEPT.size :]
    error_m -= error_m.mean(axis=1, keepdims=True)
    assert np.all(rms(error_m) < 0.002 * np.ptp(ramp_m, axis=1))


def test_breakpoints_are_denser_where_the_loop_bends_more():
    at_v = np.linspace(0, 4.5, 10)
    bend = np.where(at_v < 1.5, 9.0, 1.0)
    placed = place_breakpoints(at_v, bend, 5.0)
    assert np.diff(placed)[:2].mean() < 0.5 * np.diff(placed)[-3:].mean()


@given(st.lists(st.floats(0, 1e-6), min_size=6, max_size=6), st.floats(0.1, 10), st.integers(2, 20))
@example([0.0, 0.0, 0.0, 0.0, 5e-324, 0.0], 10.0, 2)
def test_breakpoints_always_ascend_from_zero_to_below_the_end(bend, end_v, count):
    at_v = np.arange(6) * end_v / 6
    placed = place_breakpoints(at_v, np.array(bend), end_v, count)
    assert placed[0] == 0
    assert np.all(np.diff(placed) > 0)
    assert placed[-1] < end_v


def test_any_rich_motion_tells_the_gains_of_all_stacks(stacks):
    half_widths, gains = stacks
    random = np.random.default_rng(1)
    volts = np.concatenate([np.repeat(SWEPT[:, None], 3, axis=1), random.uniform(0, 10, (800, 3))])
    plays = trail(volts, half_widths)
    fit = fit_gains(plays, np.vecdot(plays, gains).sum(axis=1), plays[:0])
    assert fit.gains == pytest.approx(gains, rel=1e-6)


def test_slopes_stay_positive_however_poor_the_data(stacks):
    half_widths, gains = stacks
    random = np.random.default_rng(2)
    volts = np.repeat(random.uniform(4, 6, 60)[:, None], 3, axis=1)
    plays = trail(volts, half_widths)
    measured = np.vecdot(plays, gains).sum(axis=1) + 1e-6 * random.standard_normal(60)
    fit = fit_gains(plays, measured, plays[:0])
    assert np.all(np.cumsum(fit.gains, axis=1) > 0)
