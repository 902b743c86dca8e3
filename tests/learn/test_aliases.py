"""How far a line is counteracted that may be the alias of a faster one."""

import dataclasses
import math

import pytest

from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.learn.aliases import MOST_IF_ALIAS, PARTS, expecting, if_aliases, safe_parts

FOUR_HZ = Line(4.0, 0.005, 0.02)
FOURTEEN_HZ = Line(14.0, 0.005, 0.03)
TWENTY_HZ = Line(20.0, 0.005, 0.08)


def knowing(paper, *lines):
    return dataclasses.replace(paper, lines=lines)


def test_the_part_of_a_line_is_the_largest_that_does_no_harm_if_the_line_is_an_alias(paper, fixed):
    truth = knowing(paper, FOURTEEN_HZ)
    (part,) = safe_parts(truth, fixed)
    limit_px = MOST_IF_ALIAS * if_aliases(fixed, truth, truth.lines)

    def left_px(part):
        return if_aliases(design_minimum_variance(expecting((part,), truth)), truth, truth.lines)

    assert 0 < part < 1
    assert left_px(part) <= limit_px
    assert left_px(PARTS[PARTS.index(part) - 1]) > limit_px


def test_in_part_a_line_leaves_much_less_than_if_it_were_left_alone(paper, fixed):
    truth = knowing(paper, FOURTEEN_HZ)
    in_part = design_minimum_variance(expecting(safe_parts(truth, fixed), truth))

    assert linear_residual(in_part, truth) < 0.7 * linear_residual(fixed, truth)


@pytest.mark.parametrize(
    ("line", "fastest_line_hz", "part"),
    [
        (FOUR_HZ, math.inf, 1.0),  # every design responds to it
        (TWENTY_HZ, math.inf, 0.0),  # each part does harm, for a gain of 9 % at most
        (TWENTY_HZ, 29.0, 1.0),  # its aliases would be too fast
        (TWENTY_HZ, 30.0, 0.0),
    ],
)
def test_a_line_is_counteracted_in_full_or_left_alone(paper, fixed, line, fastest_line_hz, part):
    truth = dataclasses.replace(paper, lines=(line,), fastest_line_hz=fastest_line_hz)

    assert safe_parts(truth, fixed) == (part,)


def test_all_lines_together_do_no_harm_beside_the_present_design(paper, fixed):
    truth = knowing(paper, FOUR_HZ, Line(8.7, 0.005, 0.02), FOURTEEN_HZ)
    calm = design_minimum_variance(expecting((1.0, 0.12, 0.12), truth))
    parts, reduced = safe_parts(truth, fixed), safe_parts(truth, calm)
    limit_px = MOST_IF_ALIAS * if_aliases(calm, truth, truth.lines)

    def left_px(parts):
        return if_aliases(design_minimum_variance(expecting(parts, truth)), truth, truth.lines)

    assert left_px(parts) > limit_px
    assert left_px(reduced) <= limit_px
    assert max(reduced) < max(parts)


def test_only_lines_that_can_be_aliases_are_reduced(paper):
    slow, fast = Line(8.0, 0.005, 0.02), FOURTEEN_HZ
    truth = dataclasses.replace(paper, lines=(slow, fast), fastest_line_hz=40.0)
    calm = design_minimum_variance(expecting((1.0, 0.08), truth))
    parts = safe_parts(truth, calm)

    assert parts[0] == 1.0
    assert 0 < parts[1] < 1


def test_what_a_design_expects_of_a_night_is_its_part_of_each_line(paper):
    truth = knowing(paper, FOUR_HZ, FOURTEEN_HZ, TWENTY_HZ)
    expected = expecting((1.0, 0.5, 0.0), truth)

    assert expected.lines == (FOUR_HZ, dataclasses.replace(FOURTEEN_HZ, rms_px=0.015))
    assert expected.noise_px == truth.noise_px
