import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.signal import lfilter

from fitctl.report.residual import WIDEST, Estimate, night_verdict, rms_estimate, verdict

PERIOD_S = 0.02
RUNS = 400


def motion(rng, duration_s, correlated_s):
    """First-order noise of unit RMS, already under way."""
    keep = math.exp(-PERIOD_S / correlated_s)
    driven = rng.standard_normal(round(duration_s / PERIOD_S)) * math.sqrt(1 - keep**2)
    driven[0] = rng.standard_normal()
    return lfilter([1.0], [1.0, -keep], driven)


def trials(make, runs):
    """How many of some records have an interval, and how many of those intervals hold an RMS of 1."""
    rng = np.random.default_rng(5)
    known = [found for _ in range(runs) if (found := rms_estimate(make(rng))).known]
    return len(known), sum(found.low <= 1.0 <= found.high for found in known)


@pytest.mark.parametrize(
    ("duration_s", "correlated_s"), [(30.0, 0.1), (30.0, 0.5), (60.0, 0.5), (300.0, 2.0)]
)
def test_the_interval_holds_the_truth_as_often_as_it_says(duration_s, correlated_s):
    known, held = trials(lambda rng: motion(rng, duration_s, correlated_s), 300)

    assert known > 0.95 * 300
    assert held > 0.92 * known


@pytest.mark.slow
@pytest.mark.parametrize("duration_s", [30.0, 60.0, 300.0, 1800.0])
@pytest.mark.parametrize("correlated_s", [0.1, 0.5, 2.0, 5.0, 10.0])
def test_of_any_records_few_are_told_a_wrong_interval(duration_s, correlated_s):
    """The table of docs/measurements.md; -s prints its cells."""
    known, held = trials(lambda rng: motion(rng, duration_s, correlated_s), RUNS)

    print(
        f"{duration_s:g} s, {correlated_s:g} s: {held / known:.0%} of {known / RUNS:.0%}",
        flush=True,
    )
    assert known - held < 0.1 * RUNS
    if duration_s >= 50 * correlated_s:
        assert known > 0.95 * RUNS


OTHER = {
    "about an offset": lambda rng: (motion(rng, 300.0, 0.5) + 1) / math.sqrt(2),
    "quick and slow": lambda rng: (
        (motion(rng, 300.0, 0.02) + motion(rng, 300.0, 5.0)) / math.sqrt(2)
    ),
    # Air that comes and goes is no Gaussian motion: only the batches see that.
    "gusts": lambda rng: motion(rng, 300.0, 0.2) * np.exp(0.4 * motion(rng, 300.0, 2.0) - 0.16),
}


@pytest.mark.parametrize("kind", OTHER)
def test_it_does_so_for_other_motions_too(kind):
    known, held = trials(OTHER[kind], 200)

    assert known > 190
    assert held > 0.9 * known


def test_a_record_hardly_longer_than_its_motion_is_too_short_to_judge():
    known, _ = trials(lambda rng: motion(rng, 30.0, 5.0), 200)

    assert known < 0.4 * 200


def test_frames_that_resemble_their_neighbours_tell_less():
    rng = np.random.default_rng(6)
    slow, quick = (rms_estimate(motion(rng, 600.0, correlated_s)) for correlated_s in (3.0, 0.05))

    slow_width, quick_width = (math.log(one.high / one.low) for one in (slow, quick))
    assert slow_width > 2 * quick_width
    assert slow.independent < quick.independent / 10


@settings(max_examples=20)
@given(st.floats(1e-6, 1e3), st.floats(1.0, 1000.0), st.floats(0.02, 5.0))
def test_the_interval_scales_with_the_motion_and_is_never_wide(factor, duration_s, correlated_s):
    series = motion(np.random.default_rng(7), duration_s, correlated_s)
    whole, found = rms_estimate(series), rms_estimate(factor * series)

    assert found == pytest.approx([factor * px for px in whole[:3]] + [whole[3]], nan_ok=True)
    assert not whole.known or 1 < whole.high / whole.low <= WIDEST


@pytest.mark.parametrize(
    "series",
    [
        np.empty(0),
        np.ones(9),
        np.ones(5000),
        np.zeros(5000),
        np.append(np.zeros(1008), 1.0),  # at rest for all of the length that is transformed
    ],
)
def test_without_enough_data_or_without_motion_there_is_no_interval(series):
    assert not rms_estimate(series).known


UNKNOWN = Estimate(0.01, math.nan, math.nan, 4)
GOOD, BAD, BETWEEN = (
    Estimate(0.02, 0.018, 0.022, 40),
    Estimate(0.2, 0.18, 0.22, 40),
    Estimate(0.1, 0.09, 0.11, 40),
)


@pytest.mark.parametrize(
    ("az", "el", "evaluated_s", "star_fraction", "word", "why"),
    [
        (GOOD, GOOD, 60.0, 1.0, "met", "both axes"),
        (GOOD, BAD, 60.0, 1.0, "not met", "the whole interval of el is above it"),
        (GOOD, BETWEEN, 60.0, 1.0, "not known", "contains the requirement"),
        (GOOD, UNKNOWN, 6.0, 1.0, "not known", "too short to judge: the 6 s evaluated"),
        (GOOD, GOOD, 60.0, 0.9, "not known", "star is missing on 10.0 %"),
        (BAD, GOOD, 60.0, 0.9, "not met", "az"),
        (UNKNOWN, UNKNOWN, 0.0, math.nan, "not known", "no time in VERNIER"),
    ],
)
def test_the_verdict_needs_data_that_say_so(az, el, evaluated_s, star_fraction, word, why):
    found = verdict({"az": az, "el": el}, 0.1, evaluated_s, star_fraction)

    assert found.word == word
    assert why in found.why


@given(st.lists(st.sampled_from(["met", "not met", "not known"]), max_size=4))
def test_a_night_is_as_good_as_its_worst_loop(words):
    found = night_verdict(words)

    assert (found == "met") == (bool(words) and set(words) == {"met"})
    assert (found == "not met") == ("not met" in words)
