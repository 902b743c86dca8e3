import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from fitctl.report.residual import Estimate, night_verdict, rms_estimate, verdict

PERIOD_S = 0.02
RUNS = 120


def motion(rng, duration_s, correlated_s):
    """First-order noise of unit RMS, already under way."""
    keep = math.exp(-PERIOD_S / correlated_s)
    frames = round(duration_s / PERIOD_S)
    driven = rng.standard_normal(frames + 3000) * math.sqrt(1 - keep**2)
    return lfilter([1.0], [1.0, -keep], driven)[3000:]


@pytest.mark.parametrize(("duration_s", "correlated_s"), [(40.0, 0.1), (60.0, 0.5), (300.0, 2.0)])
def test_the_interval_holds_the_truth_about_as_often_as_it_says(duration_s, correlated_s):
    rng = np.random.default_rng(5)
    found = [rms_estimate([motion(rng, duration_s, correlated_s)], PERIOD_S) for _ in range(RUNS)]

    told = [one for one in found if one.known]
    held = sum(one.low_px <= 1.0 <= one.high_px for one in told)

    assert len(told) > 0.95 * RUNS
    assert 0.88 * len(told) < held < 0.995 * len(told)


def test_frames_that_resemble_their_neighbours_tell_less():
    rng = np.random.default_rng(6)
    slow, quick = (rms_estimate([motion(rng, 120.0, tau_s)], PERIOD_S) for tau_s in (3.0, 0.05))

    slow_width, quick_width = (math.log(one.high_px / one.low_px) for one in (slow, quick))
    assert slow_width > 2 * quick_width


@settings(max_examples=20)
@given(st.floats(1e-6, 1e3), st.integers(1, 4))
def test_the_interval_scales_with_the_motion_and_pieces_count_alike(factor, pieces):
    series = motion(np.random.default_rng(7), 60.0, 0.1)
    whole = rms_estimate([series], PERIOD_S)

    found = rms_estimate(np.split(factor * series[: len(series) // 12 * 12], pieces), PERIOD_S)

    assert found.rms_px == pytest.approx(factor * whole.rms_px, rel=0.01)
    assert found.high_px == pytest.approx(factor * whole.high_px, rel=0.1)


@pytest.mark.parametrize("pieces", [[], [np.empty(0)], [np.ones(9)], [np.zeros(5000)]])
def test_without_enough_data_or_without_motion_there_is_no_interval(pieces):
    assert not rms_estimate(pieces, PERIOD_S).known


UNKNOWN = Estimate(0.01, math.nan, math.nan, 4, 1.0)
GOOD, BAD, BETWEEN = (
    Estimate(0.02, 0.018, 0.022, 40, 1.0),
    Estimate(0.2, 0.18, 0.22, 40, 1.0),
    Estimate(0.1, 0.09, 0.11, 40, 1.0),
)


@pytest.mark.parametrize(
    ("az", "el", "judged_s", "star_fraction", "word", "why"),
    [
        (GOOD, GOOD, 60.0, 1.0, "met", "both axes"),
        (GOOD, BAD, 60.0, 1.0, "not met", "el: all of the interval is above"),
        (GOOD, BETWEEN, 60.0, 1.0, "not known", "holds the requirement"),
        (GOOD, UNKNOWN, 6.0, 1.0, "not known", "6 s count, which is too little"),
        (GOOD, GOOD, 60.0, 0.9, "not known", "star is missing on 10.0 %"),
        (BAD, GOOD, 60.0, 0.9, "not met", "az"),
        (UNKNOWN, UNKNOWN, 0.0, math.nan, "not known", "no time in VERNIER"),
    ],
)
def test_the_verdict_needs_data_that_say_so(az, el, judged_s, star_fraction, word, why):
    found = verdict({"az": az, "el": el}, 0.1, judged_s, star_fraction)

    assert found.word == word
    assert why in found.why


@given(st.lists(st.sampled_from(["met", "not met", "not known"]), max_size=4))
def test_a_night_is_as_good_as_its_worst_loop(words):
    found = night_verdict(words)

    assert (found == "met") == (bool(words) and set(words) == {"met"})
    assert (found == "not met") == ("not met" in words)
