"""Designs that write the D/A several times a frame."""

import dataclasses

import pytest

from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.sampled import write_at_exposure
from fitctl.controllers.design.margins import Required, design_with_margins, margins
from fitctl.controllers.design.minimum_variance import design_minimum_variance

SHAKEN = (Line(6.0, 0.005, 0.05), Line(14.0, 0.005, 0.03))


@pytest.fixture(params=[2, 3, 5, 10])
def several(request, fit):
    """FIT's right loop on a night with lines, with several writes."""
    return dataclasses.replace(fit, lines=SHAKEN, writes=request.param)


def test_each_write_is_for_its_own_part_of_the_hold(several):
    left_px = linear_residual(design_minimum_variance(several), several)
    once_px = bound(dataclasses.replace(several, writes=1)).residual_px

    assert left_px == pytest.approx(bound(several).residual_px, rel=1e-3)
    assert left_px < 0.93 * once_px


@pytest.mark.long
def test_the_margins_are_those_of_the_mirror_as_a_frame_shows_it(several):
    required = Required()
    design = design_with_margins(several)

    assert design.writes == several.writes
    assert margins(design, several).excess(required) <= 1.001


def test_designs_that_do_not_predict_each_part_write_once(several):
    assert {name for name in DESIGNS if DESIGNS[name](several).writes > 1} == {"minimum-variance"}


@pytest.mark.parametrize(
    ("writes", "walked", "output"),
    [(1, 0.25, 0), (1, 0.0, 0), (2, 0.25, 0), (5, 0.25, 2), (5, 0.9, 5), (5, 0.0, 0), (4, 0.25, 0)],
)
def test_a_frame_shows_the_last_write_that_began_before_it(fit, writes, walked, output):
    design = design_minimum_variance(dataclasses.replace(fit, writes=writes))
    assert write_at_exposure(design, walked) == output
