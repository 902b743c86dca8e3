"""Frames of a series that are not known."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.learn.gaps import _gradient, _normal, filled

FRAMES, PERIOD_S, NOISE_PX = 3000, 0.02, 0.01


def line_px(frames=FRAMES):
    """0.05 px RMS at 6 Hz, on two axes."""
    at_s = PERIOD_S * np.arange(frames)[:, None]
    return 0.0707 * np.sin(2 * np.pi * 6.0 * at_s + [0.0, 1.0])


def shaken_px(frames=FRAMES):
    """The line, a slow drift, and what the camera adds."""
    draw = np.random.default_rng(0)
    drift_px = 0.02 * np.cumsum(draw.normal(size=(frames, 2)), axis=0)
    return 3.0 + drift_px + line_px(frames) + NOISE_PX * draw.normal(size=(frames, 2))


def spoilt(series_px, known):
    return np.where(known[:, None], series_px, 1e6)


def known_but(unknown, frames=FRAMES):
    known = np.ones(frames, bool)
    known[unknown] = False
    return known


def test_a_whole_series_stays_as_it_is():
    series_px = shaken_px()
    assert filled(series_px, np.ones(FRAMES, bool)) is series_px


def test_a_line_is_not_smaller_on_frames_that_are_not_known():
    series_px = shaken_px()
    at = np.random.default_rng(1).choice(FRAMES, 600, replace=False)
    known = known_but(at)
    found_px = filled(spoilt(series_px, known), known)
    straight_px = np.column_stack(
        [np.interp(at, np.flatnonzero(known), column[known]) for column in series_px.T]
    )

    def part_of_line(px):
        missed_px = px - series_px[at]
        return np.sum(missed_px * line_px()[at]) / np.sum(line_px()[at] ** 2)

    assert part_of_line(straight_px) < -0.2
    assert abs(part_of_line(found_px[at])) < 0.05
    assert np.array_equal(found_px[known], series_px[known])


@pytest.mark.parametrize("share", [0.02, 0.2])
def test_unknown_frames_have_as_much_noise_as_the_others(share):
    white = np.random.default_rng(2).normal(size=(FRAMES, 2))
    at = np.random.default_rng(3).choice(FRAMES, round(share * FRAMES), replace=False)
    known = known_but(at)
    found = filled(spoilt(white, known), known)

    assert np.std(found[at]) == pytest.approx(1.0, rel=0.2)


@pytest.mark.long
@settings(deadline=None, max_examples=15)
@given(st.lists(st.tuples(st.integers(0, FRAMES - 1), st.integers(1, 25)), min_size=1, max_size=20))
def test_wherever_frames_are_missing_they_are_like_the_others(gaps):
    series_px = shaken_px()
    at = np.unique(np.concatenate([np.arange(a, min(a + n, FRAMES)) for a, n in gaps]))
    known = known_but(at)
    found_px = filled(spoilt(series_px, known), known)

    assert np.array_equal(found_px[known], series_px[known])
    assert np.abs(found_px - series_px).max() < 0.6
    assert np.array_equal(found_px, filled(spoilt(series_px, known), known))


def test_a_series_with_hardly_a_known_frame_is_bridged_by_straight_lines():
    straight_px = np.outer(np.arange(200.0), [1.0, -2.0])
    known = known_but(np.arange(50, 150), frames=200)
    np.testing.assert_allclose(filled(spoilt(straight_px, known), known), straight_px, atol=1e-9)


@pytest.mark.long
def test_a_window_of_frames_at_500_hz_needs_the_memory_of_few_copies_of_it():
    draw = np.random.default_rng(3)
    series = 0.01 * np.cumsum(draw.normal(size=(120_000, 2)), axis=0)
    known = draw.random(len(series)) > 0.002
    tracemalloc.start()
    try:
        filled(series, known)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()

    assert peak < 20 * series.nbytes


def test_unknown_frames_make_the_errors_of_the_prediction_least():
    """As the matrix of all errors, solved by least squares, has them."""
    draw = np.random.default_rng(4)
    series, unknown_at = draw.normal(size=200), np.array([0, 3, 50, 51, 110, 199])
    factors = draw.normal(size=61)
    of_windows = np.zeros((2 * 140, 200))
    for window in range(140):
        of_windows[window, window : window + 61] = factors
        of_windows[140 + window, window : window + 61] = factors[::-1]

    normal = _normal(factors, unknown_at, 200).toarray()
    columns = of_windows[:, unknown_at]
    assert normal == pytest.approx(columns.T @ columns)
    assert _gradient(factors, series) == pytest.approx(of_windows.T @ (of_windows @ series))
