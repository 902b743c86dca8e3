"""What a design expects of its loop's error."""

import math
from dataclasses import replace

import numpy as np
import pytest

from fitctl.controllers.design.basis import Line, basis, night_of
from fitctl.controllers.design.choose import design_for
from fitctl.controllers.design.linear_loop.disturbance import disturbance
from fitctl.controllers.design.linear_loop.on_paper import left_on_paper
from fitctl.controllers.design.linear_loop.spectrum import framed_px2_per_hz
from fitctl.controllers.design.theory import loop_theory
from fitctl.error_budget import predicted
from tests.samples.learner_reports import LINE, learnt_json


def on_frames(its_basis, frames):
    """What moves a star on each frame, and the camera's noise, shape (frames, 2)."""
    moving, rng = disturbance(its_basis), np.random.default_rng(1)
    transition, noise = moving.over(its_basis.period_s)
    stir = rng.multivariate_normal(np.zeros(len(noise)), noise, (frames, 2), method="cholesky")
    states, seen = np.zeros((2, len(noise))), np.empty((frames, 2))
    for frame in range(frames):
        states = states @ transition.T + stir[frame]
        seen[frame] = states @ moving.seen
    return seen + rng.normal(0.0, its_basis.noise_px, seen.shape)


def expected_px(theory):
    return math.sqrt(np.trapezoid(predicted(theory, theory.frequency_hz), theory.frequency_hz))


@pytest.mark.long
def test_a_learnt_design_expects_the_night_that_it_was_made_for(rig):
    design = design_for(rig, "right", learnt_json(LINE))
    left_px2 = left_on_paper(
        design,
        night_of(design, basis(rig, "right")),
        on_frames(replace(basis(rig, "right"), lines=(LINE,)), 60_000),
    )
    theory = loop_theory(rig, "right", design)
    assert expected_px(theory) == pytest.approx(math.sqrt(left_px2.mean()), rel=0.03)


@pytest.mark.long
@pytest.mark.parametrize("controller", ["eq20", "minimum-variance"])
def test_other_designs_expect_the_night_of_the_rig_file(rig, controller):
    design = design_for(rig, "right", controller)
    its_basis = basis(rig, "right")
    left_px2 = left_on_paper(design, its_basis, on_frames(its_basis, 60_000))
    theory = loop_theory(rig, "right", design)
    assert expected_px(theory) == pytest.approx(math.sqrt(left_px2.mean()), rel=0.03)


@pytest.mark.parametrize("line_hz", [6.0, 44.0, 56.0])
def test_frames_show_a_line_with_all_its_power_also_where_it_is_folded_back(rig, line_hz):
    without = basis(rig, "right")
    its_basis = replace(without, lines=(Line(line_hz, 0.002, 0.05),))
    away_hz = np.geomspace(1e-4, 2.0, 2000)
    near_hz = np.concatenate([6.0 - away_hz[::-1], 6.0 + away_hz])
    density = framed_px2_per_hz(its_basis, near_hz) - framed_px2_per_hz(without, near_hz)
    assert math.sqrt(np.trapezoid(density, near_hz)) == pytest.approx(0.05, rel=0.02)
