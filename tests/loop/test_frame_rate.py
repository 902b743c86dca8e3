"""Whether frames come at the rig file's rate, from when they were exposed."""

import numpy as np
import pytest

from fitctl.loop.frame_rate import RateWatch, frames_watched

PERIOD_S = 0.02


def seen(exposed_s):
    watch = RateWatch(PERIOD_S)
    return [watch.is_other(at_s) for at_s in exposed_s]


def test_another_rate_is_noticed_within_some_frames_and_so_is_its_end():
    usual, other = np.full(100, PERIOD_S), np.full(100, PERIOD_S / 0.96)
    found = seen(5.0 + np.cumsum(np.concatenate([usual, other, usual])))

    assert not any(found[:100])
    assert all(found[100 + frames_watched(PERIOD_S) : 200])
    assert not any(found[200 + frames_watched(PERIOD_S) :])


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


@pytest.mark.parametrize(("period_s", "jitter_s"), [(0.02, 5e-4), (0.002, 1e-4)])
def test_dates_by_their_receipt_are_good_enough(period_s, jitter_s):
    random = np.random.default_rng(0)
    exposed_s = 1.001 * period_s * np.arange(20_000) + random.normal(0.0, jitter_s, 20_000)
    watch = RateWatch(period_s)

    assert not any(watch.is_other(at_s) for at_s in exposed_s)
