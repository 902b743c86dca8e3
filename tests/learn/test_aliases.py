"""How far a line is counteracted that may be the alias of a faster one."""

import dataclasses
import math

import pytest

from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.linear_loop.bound import linear_residual
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.learn.aliases import (
    LEAST_MOTION,
    LESS_MOTION,
    LITTLE,
    PARTS,
    both_if_aliases,
    expecting,
    if_aliases,
    safe_parts,
)

FOUR_HZ = Line(4.0, 0.005, 0.02)
FOURTEEN_HZ = Line(14.0, 0.005, 0.03)
TWENTY_HZ = Line(20.0, 0.005, 0.08)


def knowing(paper, *lines):
    return dataclasses.replace(paper, lines=lines)


def largest_parts(truth, present, shown_gain=1.0):
    return next(safe_parts(truth, present, shown_gain))


def left_px(design, truth, mirror_gain=LESS_MOTION):
    return if_aliases(design, truth, truth.lines, mirror_gain)


def test_the_part_of_a_line_is_the_largest_that_does_no_harm_if_the_line_is_an_alias(paper, fixed):
    truth = knowing(paper, FOURTEEN_HZ)
    (part,) = largest_parts(truth, fixed)
    more = PARTS[PARTS.index(part) - 1]
    limits_px = left_px(fixed, truth)
    in_part, too_much = (design_minimum_variance(expecting((one,), truth)) for one in (part, more))

    assert 0 < part < 1
    assert (left_px(in_part, truth) <= limits_px).all()
    assert (left_px(too_much, truth) > limits_px).any()


def test_in_part_a_line_leaves_much_less_than_if_it_were_left_alone(paper, fixed):
    truth = knowing(paper, FOURTEEN_HZ)
    in_part = design_minimum_variance(expecting(largest_parts(truth, fixed), truth))

    assert linear_residual(in_part, truth) < 0.7 * linear_residual(fixed, truth)


@pytest.mark.parametrize(
    ("line", "fastest_line_hz", "part"),
    [
        (FOUR_HZ, math.inf, 1.0),  # every design responds to it
        (TWENTY_HZ, math.inf, 0.0),  # each part does harm, for a gain of 9 % at most
        (TWENTY_HZ, 29.0, 1.0),  # its aliases would be too fast
        (TWENTY_HZ, 30.0, 0.0),  # the one of 30 Hz is not, and even a little does harm to it
    ],
)
def test_a_line_is_counteracted_as_far_as_its_aliases_allow(
    paper, fixed, line, fastest_line_hz, part
):
    truth = dataclasses.replace(paper, lines=(line,), fastest_line_hz=fastest_line_hz)

    assert largest_parts(truth, fixed) == (part,)


def test_what_a_design_leaves_of_an_alias_is_that_of_a_line_at_one_of_its_frequencies(paper, fixed):
    truth = knowing(paper, FOURTEEN_HZ)
    below_px, above_px = left_px(fixed, truth, 1.0)

    for alias_px, hz in ((below_px, 36.0), (above_px, 64.0)):
        line = Line(hz, FOURTEEN_HZ.damping * 14.0 / hz, FOURTEEN_HZ.rms_px)
        assert alias_px == linear_residual(fixed, knowing(paper, line))
    assert below_px > 1.03 * above_px  # the mirror's steps add to one and subtract from the other


def test_a_rig_without_lines_above_the_frame_rate_has_aliases_below_it_only(paper, fixed):
    truth = dataclasses.replace(paper, lines=(FOURTEEN_HZ,), fastest_line_hz=50.0)
    below_px, above_px = left_px(fixed, truth)

    assert below_px == above_px == left_px(fixed, knowing(paper, FOURTEEN_HZ))[0]


@pytest.mark.parametrize("shown_gain", [1.0, 0.8])
def test_designs_are_compared_with_a_mirror_that_moves_less_or_as_the_night_shows(
    paper, fixed, shown_gain
):
    truth = knowing(paper, Line(6.0, 0.005, 0.05))
    learnt = design_minimum_variance(truth)
    found = both_if_aliases(fixed, learnt, truth, truth.lines, shown_gain)
    gain = min(LESS_MOTION, shown_gain)

    assert found.present_px in left_px(fixed, truth, gain)
    assert found.learnt_px in left_px(learnt, truth, gain)
    assert found.harmless == (found.learnt_px <= found.present_px)


def test_a_mirror_that_moves_less_makes_a_design_that_amplifies_lines_the_better_one(paper, fixed):
    """So a line is counteracted less where the night shows less motion."""
    truth = knowing(paper, Line(6.0, 0.005, 0.05))

    assert largest_parts(truth, fixed) == (1.0,)
    assert 0 < largest_parts(truth, fixed, shown_gain=0.8)[0] < 0.5


def test_a_design_that_gains_little_must_do_no_harm_with_still_less_motion(paper, fixed):
    truth = knowing(paper, Line(10.0, 0.005, 0.005))
    learnt = design_minimum_variance(truth)
    found = both_if_aliases(fixed, learnt, truth, truth.lines, 1.0)

    assert linear_residual(learnt, truth) > LITTLE * linear_residual(fixed, truth)
    assert found.learnt_px in left_px(learnt, truth, LEAST_MOTION)


def test_without_lines_nothing_can_be_an_alias(paper, fixed):
    worse = design_minimum_variance(dataclasses.replace(paper, noise_px=1.0))

    assert both_if_aliases(fixed, worse, paper, (), 1.0).harmless


def test_all_lines_together_do_no_harm_beside_the_present_design(paper, fixed):
    truth = knowing(paper, FOUR_HZ, Line(8.7, 0.005, 0.02), FOURTEEN_HZ)
    calm = design_minimum_variance(expecting((1.0, 0.12, 0.12), truth))
    parts, reduced = largest_parts(truth, fixed), largest_parts(truth, calm)
    limits_px = left_px(calm, truth)
    in_full, in_part = (design_minimum_variance(expecting(one, truth)) for one in (parts, reduced))

    assert (left_px(in_full, truth) > limits_px).any()
    assert (left_px(in_part, truth) <= limits_px).all()
    assert max(reduced) < max(parts)


def test_parts_are_reduced_more_and_more_for_a_design_that_must_keep_margins(paper, fixed):
    truth = knowing(paper, FOUR_HZ, FOURTEEN_HZ)
    offered = list(safe_parts(truth, fixed, 1.0))

    assert offered[-1] == (0.0, 0.0)
    assert offered == sorted(offered, key=max, reverse=True)
    assert len(offered) > 2


def test_only_lines_that_can_be_aliases_are_reduced(paper):
    slow, fast = Line(8.0, 0.005, 0.02), FOURTEEN_HZ
    truth = dataclasses.replace(paper, lines=(slow, fast), fastest_line_hz=40.0)
    calm = design_minimum_variance(expecting((1.0, 0.08), truth))
    parts = largest_parts(truth, calm)

    assert parts[0] == 1.0
    assert 0 < parts[1] < 1


def test_what_a_design_expects_of_a_night_is_its_part_of_each_line(paper):
    truth = knowing(paper, FOUR_HZ, FOURTEEN_HZ, TWENTY_HZ)
    expected = expecting((1.0, 0.5, 0.0), truth)

    assert expected.lines == (FOUR_HZ, dataclasses.replace(FOURTEEN_HZ, rms_px=0.015))
    assert expected.noise_px == truth.noise_px
