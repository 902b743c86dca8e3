"""Designs for nights with lines, and the margins that a learnt design keeps."""

import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import AirPathModel, ConfigError, default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis, basis_of, design_parameters
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.files import load_design, save_design
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.disturbance import disturbance
from fitctl.controllers.design.linear_loop.loopshape import loop_shape, sampled_response
from fitctl.controllers.design.linear_loop.spectrum import framed_line_slopes
from fitctl.controllers.design.margins import Required, design_with_margins, margins
from fitctl.controllers.design.minimum_variance import design_minimum_variance

SIX_HZ = Line(frequency_hz=6.0, damping=0.005, rms_px=0.05)


@pytest.fixture(scope="module")
def six_hz(fit):
    return dataclasses.replace(fit, lines=(SIX_HZ,))


@pytest.fixture(scope="module")
def with_the_fit():
    settings = ["loops.right.sensor=fit", "loops.right.spot_diameter_px=3.0"]
    return basis(load_rig(default_rig_path(), settings), "right")


@given(frequency_hz=st.floats(0.5, 60.0), damping=st.floats(1e-3, 0.5), rms_px=st.floats(1e-3, 1.0))
@settings(max_examples=20, deadline=None)
def test_a_line_has_its_rms_in_time_and_in_its_spectrum(fit, frequency_hz, damping, rms_px):
    line = Line(frequency_hz, damping, rms_px)
    moving = disturbance(dataclasses.replace(fit, lines=(line,)))
    away_hz = frequency_hz * damping * np.tan(np.linspace(-1.5, 1.5, 20_001))
    at_hz = frequency_hz + away_hz[away_hz > -frequency_hz]

    assert moving.covariance[2, 2] == pytest.approx(rms_px**2, rel=1e-6)
    width_hz = np.full(len(at_hz), damping * frequency_hz)
    often_s = 1e-5  # frames so often that aliases are far away
    density = rms_px**2 * framed_line_slopes(frequency_hz, width_hz, at_hz, often_s)[0]
    assert np.trapezoid(density, at_hz) == pytest.approx(rms_px**2, rel=0.1)


def test_a_loop_with_less_delay_than_the_margin_of_delay_has_margins(fit):
    quick = dataclasses.replace(fit, delay_s=0.004)

    assert margins(design_minimum_variance(quick), quick).peak_sensitivity < 10.0


@pytest.mark.parametrize("values", [(0.0, 0.1, 1.0), (6.0, 1.0, 1.0), (6.0, 0.1, math.nan)])
def test_a_line_that_cannot_be_is_refused(values):
    with pytest.raises(ValueError, match="expected values above 0"):
        Line(*values)


def test_a_design_that_knows_a_line_leaves_what_the_bound_allows(fit, six_hz):
    least_px = bound(six_hz).residual_px
    knows, does_not = design_minimum_variance(six_hz), design_minimum_variance(fit)

    assert linear_residual(knows, six_hz) < 1.01 * least_px
    assert linear_residual(does_not, six_hz) > 3 * least_px


def test_margins_agree_with_those_of_python_control(six_hz):
    design = design_minimum_variance(six_hz)
    found = margins(design, six_hz)
    shape = loop_shape(sampled_response(design, six_hz), 0.5 / six_hz.period_s, stable=True)

    assert found.peak_sensitivity == pytest.approx(shape.peak_sensitivity, rel=0.02)
    assert found.gain_margin_db == pytest.approx(shape.gain_margin_db, abs=0.2)
    assert found.phase_margin_deg == pytest.approx(shape.phase_margin_deg, abs=1.0)


def test_a_design_that_has_its_margins_stays_as_it_is(fit):
    design, plain = design_with_margins(fit), design_minimum_variance(fit)

    assert "guard" not in design.parameters
    assert np.array_equal(design.a, plain.a)


@pytest.mark.long
def test_a_design_keeps_its_margins_at_little_cost(with_the_fit):
    its_basis, required = with_the_fit, Required()
    plain = design_minimum_variance(its_basis)
    design = design_with_margins(its_basis, required)
    found = margins(design, its_basis, required)

    assert margins(plain, its_basis, required).peak_sensitivity > required.peak_sensitivity
    assert found.stable
    assert found.peak_sensitivity <= 1.001 * required.peak_sensitivity
    assert found.gain_margin_db >= 0.999 * required.gain_margin_db
    assert found.phase_margin_deg >= 0.999 * required.phase_margin_deg
    assert linear_residual(design, its_basis) < 1.13 * bound(its_basis).residual_px


SHAKY = (  # as learnt from a minute of frames under lines at 1.5, 5.3 and 24.3 Hz
    Line(frequency_hz=1.5666, damping=0.0033, rms_px=0.0585),
    Line(frequency_hz=24.357, damping=0.0024, rms_px=0.0545),
    Line(frequency_hz=5.3339, damping=0.0088, rms_px=0.0112),
    Line(frequency_hz=23.379, damping=0.0060, rms_px=0.0058),
)


@pytest.mark.long
def test_a_night_that_needs_a_strong_guard_has_its_design(fit):
    shaky = dataclasses.replace(
        fit, lines=SHAKY, noise_px=2.14e-5, mirror_gain=0.7445, overshoot=0.0535
    )
    least_px = linear_residual(design_minimum_variance(shaky), shaky)

    design = design_with_margins(shaky)

    assert margins(design, shaky).excess(Required()) < 1.002
    assert linear_residual(design, shaky) < 1.06 * least_px


@pytest.mark.long
def test_a_search_that_begins_at_a_design_for_nearly_the_same_night_finds_as_good_a_one(fit):
    night = dataclasses.replace(fit, lines=(SIX_HZ,), noise_px=0.003)
    later = dataclasses.replace(night, noise_px=0.0029)
    like, anew = design_with_margins(night), design_with_margins(later)

    design = design_with_margins(later, like=like)

    assert margins(design, later).excess(Required()) < 1.002
    # Both end in a flat valley; a fiftieth less is worth a change of design.
    assert linear_residual(design, later) < 1.005 * linear_residual(anew, later)


@pytest.mark.long
def test_a_search_does_not_begin_at_a_design_for_other_lines(fit):
    quiet = design_with_margins(dataclasses.replace(fit, noise_px=0.002))
    shaken = dataclasses.replace(fit, lines=(SIX_HZ,), noise_px=0.002)

    like, anew = design_with_margins(shaken, like=quiet), design_with_margins(shaken)

    assert "guard" in quiet.parameters
    assert np.array_equal(like.a, anew.a)


@pytest.mark.long
def test_where_the_margins_cost_much_the_better_of_two_searches_counts(fit, monkeypatch):
    shaky = dataclasses.replace(
        fit,
        lines=(
            Line(frequency_hz=23.6145, damping=0.000645, rms_px=0.08815),
            Line(frequency_hz=3.67706, damping=0.001332, rms_px=0.05212),
            Line(frequency_hz=5.42599, damping=0.001493, rms_px=0.003929),
        ),
        air_path=AirPathModel(gain_px=0.21165, b1_s2=0.12439, b2_s=1.97046),
        noise_px=8.033e-05,
        overshoot=0.0332,
    )

    of_two = linear_residual(design_with_margins(shaky), shaky)
    monkeypatch.setattr("fitctl.controllers.design.margins._NEAR", math.inf)
    of_one = linear_residual(design_with_margins(shaky), shaky)

    assert of_two < 0.95 * of_one


def test_margins_that_no_design_can_have_are_an_error(fit, monkeypatch):
    monkeypatch.setattr("fitctl.controllers.design.margins._TRIES", 10)

    with pytest.raises(ConfigError, match=r"no minimum-variance pair .* measure the delay"):
        design_with_margins(fit, Required(peak_sensitivity=1.01))


@pytest.mark.long
@pytest.mark.parametrize("overshoot", [0.0, 0.09])
def test_a_design_with_lines_and_guard_is_made_again_from_its_file(
    six_hz, fit, tmp_path, overshoot
):
    design = design_with_margins(dataclasses.replace(six_hz, overshoot=overshoot))
    save_design(design, tmp_path / "six.json")

    again = load_design(tmp_path / "six.json", fit, DESIGNS)
    made_for = basis_of(again.parameters, fit)

    assert np.array_equal(again.a, design.a)
    assert made_for.lines == (SIX_HZ,)
    assert made_for.guard is not None
    assert made_for.overshoot == overshoot


@pytest.mark.parametrize(
    ("name", "value", "said"),
    [
        ("mirror_gain", 0.2, "mirror_gain: .* greater than or equal to 0.4, got 0.2"),
        ("overshoot", -0.6, "overshoot: .* greater than or equal to -0.5, got -0.6"),
        ("noise_px", float("nan"), "noise_px: .* finite number, got nan"),
        ("noise_px", "0.01", "noise_px: .* valid number, got '0.01'"),
        ("coarse_per_s", -5.0, "coarse_per_s: .* greater than or equal to 0, got -5"),
        ("air_path", {"gain_px": 1.0}, "air_path.b1_s2: Field required"),
        (
            "lines",
            [{"frequency_hz": 6.0, "damping": 1.0, "rms_px": 0.1}],
            "lines.0.damping: .* got 1",
        ),
        ("settings", {"minimum_variance": {}}, "drift_px_per_sqrt_s: Field required"),
        ("writes_per_frame", 1.5, "writes_per_frame: .* got 1.5"),
        ("colour", "x" * 10_000, "colour: Extra inputs .{1,100}$"),
    ],
)
def test_parameters_that_cannot_be_are_refused_by_name(fit, name, value, said):
    parameters = design_parameters(fit, "minimum_variance") | {name: value}

    with pytest.raises(ValueError, match=said):
        basis_of(parameters, fit)
