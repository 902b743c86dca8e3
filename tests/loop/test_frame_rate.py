"""Whether frames come at the rig file's rate, from when they were exposed."""

import numpy as np
import pytest

from fitctl.loop.frame_rate import MEDIAN_OF, RateWatch

PERIOD_S = 0.02


def seen(exposed_s):
    watch = RateWatch(PERIOD_S)
    return [watch.is_other(at_s) for at_s in exposed_s]


def test_another_rate_is_noticed_within_some_frames_and_so_is_its_end():
    usual, other = np.full(100, PERIOD_S), np.full(100, PERIOD_S / 0.96)
    found = seen(5.0 + np.cumsum(np.concatenate([usual, other, usual])))

    assert not any(found[:100])
    assert all(found[100 + MEDIAN_OF : 200])
    assert not any(found[200 + MEDIAN_OF :])


@pytest.mark.parametrize(
    "exposed_s",
    [
        PERIOD_S * np.arange(100) * 1.001,  # a camera's own clock
        PERIOD_S * np.flatnonzero(np.arange(100) % 7),  # frames are missing
        PERIOD_S * np.arange(100)
        + np.random.default_rng(0).normal(0.0, 2e-4, 100),  # dated roughly
        np.concatenate([PERIOD_S * np.arange(50), 3600.0 + PERIOD_S * np.arange(50)]),
    ],
)
def test_lost_frames_jitter_and_gaps_are_no_other_rate(exposed_s):
    assert not any(seen(exposed_s))
