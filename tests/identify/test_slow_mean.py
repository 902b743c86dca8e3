"""The mean of what the air moves, and how often its interval holds the truth."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.identify.slow_mean import slow_mean
from fitctl.model import air_path

AIR = load_rig(default_rig_path()).loops["right"].vernier.air_path
PERIOD_S = 0.05
TIME_S = PERIOD_S * np.concatenate([np.arange(200), np.arange(260, 460)])  # two places
RUNS = 300


def air_motion(random, rms):
    """Motion with the spectrum of Eq. 8 on all of the grid, shape (frames, runs, 2)."""
    transition, gain = air_path.step_matrices(AIR, PERIOD_S)
    root = np.linalg.cholesky(air_path.stationary_covariance(AIR))
    state = random.standard_normal((RUNS, 2, 2)) @ root.T
    moved = []
    for _ in range(460):
        moved.append(state[..., 0])
        state = state @ transition.T + random.standard_normal(state.shape) @ gain.T
    return np.array(moved) * rms / air_path.rms_px(AIR)


@pytest.mark.long
@pytest.mark.parametrize(("slow_px", "white_px"), [(0.05, 0.1), (0.0, 0.1), (0.1, 0.01)])
def test_the_interval_holds_the_truth_as_often_as_it_says(slow_px, white_px):
    random = np.random.default_rng(1)
    rows = np.rint(TIME_S / PERIOD_S).astype(int)
    series = air_motion(random, slow_px)[rows] + white_px * random.standard_normal(
        (len(rows), RUNS, 2)
    )
    found = [slow_mean(TIME_S, series[:, run], AIR) for run in range(RUNS)]
    inside = [np.abs(one.mean) < 1.96 * one.sd for one in found]
    assert 0.91 <= np.mean(inside) <= 0.98


def test_a_motion_that_the_air_makes_is_less_certain_than_noise_of_the_same_size():
    random = np.random.default_rng(2)
    rows = np.rint(TIME_S / PERIOD_S).astype(int)
    slow = slow_mean(TIME_S, air_motion(random, 0.1)[rows][:, 0], AIR)
    white = slow_mean(TIME_S, 0.1 * random.standard_normal((len(rows), 2)), AIR)
    assert slow.sd.max() > 5 * white.sd.max()
