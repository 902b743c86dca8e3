"""A design followed on paper leaves what it leaves at work."""

import dataclasses

import numpy as np
import pytest
from scipy.signal import iirnotch, lfilter

from benchmarks.linear_loop import course_px, held
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis
from fitctl.controllers.design.eq20 import design_eq20
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.linear_loop.on_paper import OnPaper, TrueSquares, left_on_paper
from fitctl.controllers.design.minimum_variance import design_minimum_variance

SECONDS = 60.0


@pytest.fixture(scope="module")
def paper():
    return basis(load_rig(default_rig_path()), "right")


@pytest.fixture(scope="module")
def night(paper):
    return dataclasses.replace(paper, lines=(Line(6.0, 0.005, 0.05),))


@pytest.mark.parametrize(("mirror_gain", "overshoot"), [(1.0, 0.0), (0.8, 0.0), (0.9, 0.1)])
def test_a_design_on_the_disturbance_of_its_own_frames_makes_the_same_errors(
    paper, mirror_gain, overshoot
):
    design = design_minimum_variance(paper)
    mirror = {"mirror_gain": mirror_gain, "overshoot": overshoot}
    error_px, series = held(paper, design, 10.0, seed=1, **mirror)
    on_paper = OnPaper(design, dataclasses.replace(paper, **mirror))
    step_px = np.diff(series.mirror_px, axis=0, prepend=0.0)
    disturbance_px = series.disturbance_px + (1 - mirror_gain) * series.mirror_px
    disturbance_px -= overshoot * step_px
    made_px = [on_paper.step(row) for row in disturbance_px]

    np.testing.assert_allclose(made_px, error_px, atol=1e-12)


def test_another_design_on_the_same_disturbance_leaves_what_it_would_have_left(paper, night):
    """Although the frames were another design's."""
    star_px = course_px(night, round(SECONDS / night.period_s), seed=3)
    _, series = held(night, design_minimum_variance(paper), SECONDS, 3, star_px=star_px)
    other = design_minimum_variance(night)
    error_px, _ = held(night, other, SECONDS, 3, star_px=star_px)
    settled_px = error_px[round(5.0 / night.period_s) :]

    assert left_on_paper(other, night, series.disturbance_px) == pytest.approx(
        np.mean(settled_px**2, axis=0), rel=0.02
    )


def test_where_the_star_is_at_first_does_not_matter(paper):
    design = design_eq20(paper)
    star_px = course_px(paper, 3000, seed=0)

    near, far = (left_on_paper(design, paper, star_px + away_px) for away_px in (0.0, 50.0))
    np.testing.assert_allclose(near, far)


def test_too_few_frames_leave_nothing_known(paper):
    assert np.isnan(left_on_paper(design_minimum_variance(paper), paper, np.zeros((100, 2)))).all()


# ---------------------------------------------------------------- aliases


def left_px(design, night, disturbance_px):
    """Worst axis."""
    return np.sqrt(left_on_paper(design, night, disturbance_px).max())


@pytest.mark.parametrize(("alias_hz", "seen_hz"), [(44.0, 6.0), (48.9, 1.1), (94.0, 6.0)])
@pytest.mark.long
def test_of_a_known_alias_counts_what_is_left_between_frames(paper, alias_hz, seen_hz):
    """On frames, the design for a slow line leaves much less than in truth."""
    quiet = dataclasses.replace(paper, noise_px=0.003)
    night = dataclasses.replace(quiet, lines=(Line(alias_hz, 0.002, 0.05),))
    slow = dataclasses.replace(quiet, lines=(Line(seen_hz, 0.005, 0.05),))
    star_px = course_px(night, 6000, seed=3)
    designs = [design_minimum_variance(one) for one in (night, slow)]
    in_truth_px = [left_px(design, night, star_px) for design in designs]
    on_frames_px = [left_px(design, quiet, star_px) for design in designs]
    linear_px = [linear_residual(design, night) for design in designs]

    assert in_truth_px == pytest.approx(linear_px, rel=0.15)
    assert in_truth_px[0] < 0.9 * in_truth_px[1]
    assert on_frames_px[1] < 0.7 * on_frames_px[0]


def test_slow_lines_are_judged_on_frames(paper, night):
    star_px = course_px(night, 3000, seed=3)
    design = design_minimum_variance(night)

    np.testing.assert_array_equal(
        left_on_paper(design, night, star_px), left_on_paper(design, paper, star_px)
    )


def test_without_aliases_squares_are_squares(night):
    true = TrueSquares(night.lines, night.period_s)
    errors_px = np.array([[0.3, -0.1], [0.2, 0.4]])

    squares, rest_px = true.step(np.ones(2), errors_px)
    np.testing.assert_array_equal(squares, errors_px**2)
    np.testing.assert_array_equal(rest_px, errors_px)


@pytest.mark.parametrize("hz", [25.0, 25.1, 50.0, 60.0, 100.0, 1234.0])
@pytest.mark.parametrize("damping", [1e-4, 0.1, 0.99])
@pytest.mark.parametrize("rate_hz", [1.0, 50.0, 500.0])
def test_lines_of_any_place_and_width_have_finite_squares(hz, damping, rate_hz):
    true = TrueSquares([Line(hz * rate_hz / 50.0, damping, 0.05)], 1 / rate_hz)
    random = np.random.default_rng(1)
    squares = [true.step(*np.split(random.standard_normal((3, 2)), [1]))[0] for _ in range(300)]

    assert np.isfinite(squares).all()
    assert np.max(squares) < 100.0


@pytest.mark.parametrize(("rate_hz", "hz"), [(50.0, 74.9), (50.0, 44.0), (500.0, 253.0)])
def test_an_alias_that_a_mirror_follows_on_frames_counts_twice(rate_hz, hz):
    true = TrueSquares([Line(hz, 0.0005, 1.0)], 1 / rate_hz)
    star_px = np.sin(2 * np.pi * hz * np.arange(round(40 * rate_hz)) / rate_hz + 1.0)
    star_px = np.stack([star_px, star_px], axis=-1)
    squares = [true.step(one, np.zeros((1, 2)))[0] for one in star_px][len(star_px) // 2 :]

    assert np.mean(squares) == pytest.approx(2 * np.mean(star_px**2), rel=0.1)


def test_errors_without_an_alias_have_passed_scipys_notch_where_frames_show_it():
    true = TrueSquares([Line(44.0, 0.01, 0.05)], 0.02)
    errors_px = np.random.default_rng(2).standard_normal((300, 2))
    rest_px = [true.step(np.zeros(2), row[None])[1][0] for row in errors_px]

    scipys_px = lfilter(*iirnotch(6.0, 6.0 / 1.76, fs=50.0), errors_px, axis=0)
    np.testing.assert_allclose(rest_px, scipys_px, atol=1e-9)
