import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.controllers.prefilter import Prefilter

PERIOD_S = 0.02
commands = st.lists(st.floats(-20, 20), min_size=1, max_size=40)


def step_response(time_s, time_constant_s):
    """Of 1 / (tau s + 1)^2, in continuous time."""
    x = np.maximum(time_s, 0.0) / time_constant_s
    return 1 - (1 + x) * np.exp(-x)


@given(levels=commands, hold=st.integers(1, 30), time_constant_s=st.floats(0.05, 5))
def test_it_is_the_continuous_filter_at_every_frame(levels, hold, time_constant_s):
    prefilter = Prefilter(time_constant_s, PERIOD_S, np.zeros(2))
    held = np.repeat(levels, hold)
    filtered = [prefilter.step(np.array([level, -level])) for level in held]
    times_s = PERIOD_S * np.arange(1, held.size + 1)
    jumps = np.diff(held, prepend=0.0)
    expected = sum(
        jump * step_response(times_s - PERIOD_S * start, time_constant_s)
        for start, jump in enumerate(jumps)
        if jump
    )
    assert np.array(filtered)[:, 0] == pytest.approx(expected + np.zeros(held.size), abs=1e-9)
    assert np.array(filtered)[:, 1] == pytest.approx(-np.array(filtered)[:, 0])


def test_a_step_is_approached_without_overshoot():
    prefilter = Prefilter(1.0, PERIOD_S, np.array([24.0, 19.5]))
    az_px = np.array([prefilter.step(np.array([30.0, 19.5]))[0] for _ in range(1000)])
    assert np.all(np.diff(az_px) > 0) | (az_px[-1] == pytest.approx(30.0))
    assert az_px.max() <= 30.0
    assert az_px[49] == pytest.approx(24.0 + 6.0 * (1 - 2 / np.e))


def test_it_starts_and_rests_where_it_is_told():
    prefilter = Prefilter(1.0, PERIOD_S, np.array([24.0, 19.5]))
    assert prefilter.step(np.array([24.0, 19.5])) == (24.0, 19.5)
    prefilter.step(np.array([0.0, 0.0]))
    prefilter.reset(np.array([10.0, 11.0]))
    assert prefilter.step(np.array([10.0, 11.0])) == (10.0, 11.0)
