import math

import numpy as np
import pytest

from fitctl.figures.settling import decayed_s, settling

TIME_S = np.arange(0.0, 20.0, 0.02)


def after(stepped_s):
    return np.clip(TIME_S - stepped_s, 0.0, None)


@pytest.mark.parametrize("sign", [1, -1])
def test_an_exponential_settles_when_it_should_and_overshoots_nothing(sign):
    distance = sign * np.where(TIME_S < 2.0, 0.0, np.exp(-after(2.0)))

    found = settling(TIME_S, distance, 2.0, within_px=0.1)

    assert found.settled_s == pytest.approx(math.log(10), abs=0.03)
    assert found.overshoot_px == 0.0


def test_a_swing_counts_beyond_the_target_only():
    distance = np.where(TIME_S < 2.0, 0.0, np.exp(-after(2.0)) * np.cos(np.pi * after(2.0)))

    found = settling(TIME_S, distance, 2.0, within_px=0.02)

    assert found.overshoot_px == pytest.approx(math.exp(-1), rel=0.1)


def test_what_never_settles_has_no_settling_time():
    assert math.isnan(settling(TIME_S, np.ones_like(TIME_S), 2.0, within_px=0.1).settled_s)


def test_what_never_moved_has_settled_at_once():
    assert settling(TIME_S, np.zeros_like(TIME_S), 2.0, within_px=0.1).settled_s == 0.0


def test_frames_without_a_star_are_left_out():
    distance = np.where(TIME_S < 2.0, 0.0, np.exp(-after(2.0)))
    distance[::7] = np.nan

    assert settling(TIME_S, distance, 2.0, 0.1).settled_s == pytest.approx(math.log(10), abs=0.05)


def test_a_mirror_relieved_exponentially_is_back_at_a_third_after_ln_3():
    value = np.where(TIME_S < 2.0, 0.0, np.exp(-after(2.0) / 4.0))

    assert decayed_s(TIME_S, value, 2.0, 1 / 3) == pytest.approx(4.0 * math.log(3), abs=0.03)
