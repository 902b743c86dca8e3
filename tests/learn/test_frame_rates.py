"""Lines told from their aliases by frames at another rate."""

import dataclasses

import numpy as np
import pytest

from benchmarks.linear_loop import held
from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.learn.advice import advise
from fitctl.learn.design_basis import estimated
from fitctl.learn.frame_rates import (
    OTHER_RATES,
    AtOtherRate,
    Classified,
    by_rate,
    classifying_rate,
)

TWO_MINUTES_S, OTHER_S = 120.0, 11.0
RATE_HZ = 50.0
OTHER_HZ = 48.0


def shaken(paper, *hz):
    return dataclasses.replace(paper, lines=tuple(Line(one, 0.005, 0.05) for one in hz))


def advised(paper, fixed, truth, other_hz=OTHER_HZ, **options):
    """Two minutes of a night at the rig's rate, and half of one at another."""
    slower = dataclasses.replace(truth, period_s=1 / other_hz)
    _, series = held(truth, fixed, TWO_MINUTES_S, 5)
    _, others = held(slower, fixed, OTHER_S, 6)
    shown = [AtOtherRate(slower.period_s, [others])]
    return advise([series], (0.1, 0.1), paper, fixed, others=shown, **options)


# ---------------------------------------------------------------- telling


@pytest.mark.parametrize("hz", [4.0, 6.0, 14.0])
@pytest.mark.long
def test_a_line_that_stays_where_it_was_is_no_alias_and_is_counteracted_in_full(paper, fixed, hz):
    advice = advised(paper, fixed, shaken(paper, hz), classifying_rate([hz], RATE_HZ))
    (line,) = advice.lines

    assert line.true_hz == line.found.frequency_hz.value
    assert line.part == 1.0
    assert "another frame rate showed that it is no alias" in "\n".join(advice.lines_of_text())
    assert advice.classifying_rate_hz == 0.0


@pytest.mark.parametrize("hz", [44.0, pytest.param(56.0, marks=pytest.mark.long), 94.0])
@pytest.mark.long
def test_a_line_that_moves_is_an_alias(paper, fixed, hz):
    advice = advised(paper, fixed, shaken(paper, hz))
    (line,) = advice.lines

    assert line.found.frequency_hz.value == pytest.approx(6.0, abs=0.1)
    assert line.true_hz == pytest.approx(hz, abs=0.2)
    assert not line.can_be_alias  # it is one
    assert f"an alias, probably of {line.true_hz:.1f} Hz" in "\n".join(advice.lines_of_text())


@pytest.mark.long
def test_a_night_with_a_known_alias_is_estimated_with_the_line_where_it_is(paper, fixed):
    truth = dataclasses.replace(paper, lines=(Line(57.4, 0.005, 0.07),))
    night = advised(paper, fixed, truth).night
    strength = paper.air_path.gain_px / paper.air_path.b1_s2

    assert night.strength.covers(strength)
    assert night.mirror_gain.value == pytest.approx(1.0, abs=0.1)
    assert night.overshoot.covers(0.0)
    assert night.test.fits


@pytest.mark.long
def test_a_design_that_counteracts_an_alias_gives_way_to_one_that_knows_it(paper, fixed):
    """Although it leaves less on the last minute's frames."""
    truth = shaken(paper, 44.0)
    counteracts = design_minimum_variance(shaken(paper, 6.0))
    advice = advised(paper, counteracts, truth)

    assert advice.worth_it
    assert advice.learnt.residual_px < 0.9 * advice.present.residual_px
    assert advice.learnt.camera_px > advice.present.camera_px


@pytest.mark.long
def test_each_of_several_lines_is_told(paper, fixed):
    truth = shaken(paper, 4.0, 39.0)
    other_hz = classifying_rate([4.0, 11.0], RATE_HZ)
    advice = advised(paper, fixed, truth, other_hz)
    found = {round(line.found.frequency_hz.value): round(line.true_hz) for line in advice.lines}

    assert found == {4: 4, 11: 39}


@pytest.mark.long
def test_a_line_is_not_called_slow_where_a_faster_one_would_stay_too(paper, fixed):
    """196 Hz looks like 4 Hz at both rates."""
    advice = advised(paper, fixed, shaken(paper, 4.0), 48.0)

    assert advice.lines[0].true_hz is None
    assert classifying_rate([4.0], RATE_HZ) != 48.0


@pytest.mark.long
def test_too_few_frames_at_another_rate_tell_nothing(paper, fixed):
    truth = shaken(paper, 6.0)
    _, series = held(truth, fixed, TWO_MINUTES_S, 5)
    slower = dataclasses.replace(truth, period_s=1 / OTHER_HZ)
    _, short = held(slower, fixed, 6.0, 6)
    advice = advise(
        [series], (0.1, 0.1), paper, fixed, others=[AtOtherRate(slower.period_s, [short])]
    )

    assert advice.lines[0].true_hz is None


@pytest.mark.parametrize(
    ("told", "expected_hz"),
    [(Classified(6.2, 6.2), 6), (Classified(6.2, 43.8), 44), (Classified(5.5, 5.5), None)],
)
@pytest.mark.long
def test_what_was_told_before_counts_for_the_same_line(paper, fixed, told, expected_hz):
    truth = shaken(paper, 6.0)
    _, series = held(truth, fixed, TWO_MINUTES_S, 5)
    advice = advise([series], (0.1, 0.1), paper, fixed, known=[told])

    assert [round(one.true_hz) for one in advice.classified] == [expected_hz] * (
        expected_hz is not None
    )


@pytest.mark.long
def test_an_alias_that_frames_at_the_usual_rate_disprove_is_forgotten(paper, fixed):
    _, series = held(shaken(paper, 6.0), fixed, 2 * TWO_MINUTES_S, 5)

    assert estimated([series], paper, [Classified(6.0, 44.0)])[2] == []


def classified(paper, fixed, truth, other, other_hz, seed=5):
    """Lines that two minutes of a night and some seconds of another, at another rate, classify."""
    _, series = held(truth, fixed, TWO_MINUTES_S, seed)
    _, shown = held(dataclasses.replace(other, period_s=1 / other_hz), fixed, OTHER_S, seed + 1)
    return estimated([series], paper, (), [AtOtherRate(1 / other_hz, [shown])])[2]


@pytest.mark.long
def test_a_line_that_moves_is_an_alias_even_if_two_look_the_same(paper, fixed):
    """At 47 frames/s, 26.4 Hz is seen at 20.6 Hz, and 73.6 Hz at 20.4 Hz."""
    truth = dataclasses.replace(paper, lines=(Line(26.4, 0.005, 0.02),))
    (line,) = classified(paper, fixed, truth, truth, 47.0)

    assert line.frequency_hz == pytest.approx(23.6, abs=0.1)
    assert line.is_alias


@pytest.mark.long
def test_a_line_at_half_the_rate_is_no_alias_of_itself(paper, fixed):
    """24.96 and 25.04 Hz look the same at every rate, and are the same to the mirror."""
    truth = dataclasses.replace(paper, lines=(Line(24.96, 0.005, 0.05),))
    (line,) = classified(paper, fixed, truth, truth, classifying_rate([24.96], RATE_HZ))

    assert not line.is_alias


@pytest.mark.parametrize("hz", [1.3, pytest.param(9.0, marks=pytest.mark.long)])
def test_a_line_that_is_not_there_at_the_other_rate_is_not_classified(paper, fixed, hz):
    """A narrow line fades by itself."""
    truth = dataclasses.replace(paper, lines=(Line(hz, 0.0005, 0.02),))

    assert classified(paper, fixed, truth, paper, classifying_rate([hz], RATE_HZ)) == []


@pytest.mark.parametrize("seed", [0, 2, pytest.param(4, marks=pytest.mark.long)])
@pytest.mark.long
def test_a_weak_alias_makes_no_alias_of_a_strong_slow_line(paper, fixed, seed):
    """At the other rate the slow line is hidden by the air."""
    lines = (Line(1.0, 0.005, 0.045), Line(RATE_HZ + 1.05, 0.001, 0.009))
    truth = dataclasses.replace(paper, lines=lines)
    found = classified(paper, fixed, truth, truth, classifying_rate([1.0], RATE_HZ), seed)

    assert not any(one.is_alias for one in found), found


@pytest.mark.parametrize("seed", [2, pytest.param(4, marks=pytest.mark.long)])
@pytest.mark.long
def test_a_line_with_an_alias_in_its_place_is_not_called_one(paper, fixed, seed):
    lines = (Line(3.1, 0.02, 0.025), Line(RATE_HZ + 3.1, 0.002, 0.03))
    truth = dataclasses.replace(paper, lines=lines)

    assert classified(paper, fixed, truth, truth, classifying_rate([3.1], RATE_HZ), seed) == []


@pytest.mark.long
def test_a_line_that_explains_part_of_another_is_not_called_an_alias(paper, fixed):
    """What looks like one broad line is two at 47 frames/s, of which the alias is near other aliases."""
    air = paper.air_path.model_copy(update={"gain_px": 0.25, "b1_s2": 0.58})
    slow, one = Line(1.1, 0.003, 0.04), Line(11.4, 0.03, 0.012)
    two = (Line(11.79, 0.001, 0.005), Line(38.74, 0.02, 0.015))
    truth = dataclasses.replace(paper, lines=(slow, one), air_path=air)
    other = dataclasses.replace(truth, lines=(slow, *two))

    assert not any(one.is_alias for one in classified(paper, fixed, truth, other, 47.0, 10))


@pytest.mark.parametrize("seed", [0, pytest.param(2, marks=pytest.mark.long)])
@pytest.mark.long
def test_what_would_be_seen_near_zero_is_not_classified(paper, fixed, seed):
    """There air looks like a line; at 48.5 frames/s this alias is at 0.3 Hz, on a night of little air."""
    air = paper.air_path.model_copy(update={"gain_px": 0.05})
    truth = dataclasses.replace(paper, lines=(Line(48.8, 0.0005, 0.05),), air_path=air)

    assert classified(paper, fixed, truth, truth, 48.5, seed) == []


# ---------------------------------------------------------------- asking


@pytest.mark.long
def test_a_line_that_is_counteracted_in_part_is_worth_another_rate(paper, fixed):
    truth = shaken(paper, 14.0)
    _, series = held(truth, fixed, TWO_MINUTES_S, 5)
    advice = advise([series], (0.1, 0.1), paper, fixed)
    text = "\n".join(advice.lines_of_text())

    assert advice.lines[0].part < 1
    assert advice.classifying_rate_hz in {part * RATE_HZ for part in OTHER_RATES}
    assert f"fitctl send frame-rate {advice.classifying_rate_hz:g}" in text


@pytest.mark.long
def test_a_line_that_is_hardly_worth_another_rate_does_not_ask_for_one(paper, fixed):
    """A design that knew whether it is an alias would leave 7 % less; another rate itself costs about 1 %."""
    truth = dataclasses.replace(paper, lines=(Line(14.0, 0.005, 0.009),))
    _, series = held(truth, fixed, TWO_MINUTES_S, 5)
    advice = advise([series], (0.1, 0.1), paper, fixed)

    assert advice.lines[0].part < 1
    assert advice.classifying_rate_hz == 0.0


def test_a_night_without_lines_asks_for_nothing(paper, fixed):
    _, series = held(paper, fixed, TWO_MINUTES_S, 5)
    advice = advise([series], (0.0, 0.0), paper, fixed)

    assert advice.classifying_rate_hz == 0.0
    assert "frame-rate" not in "\n".join(advice.lines_of_text())


def test_the_rate_keeps_lines_away_from_what_others_would_be_as_aliases():
    at_hz = classifying_rate([6.0, 8.0], RATE_HZ)  # with 48 Hz, the alias of 8 Hz would be at 6 Hz

    assert at_hz != 0.96 * RATE_HZ
    assert classifying_rate([60.0, 140.0], 500.0) in {part * 500.0 for part in OTHER_RATES}


# ---------------------------------------------------------------- which frames


def test_frames_are_parted_by_their_rate():
    usual_s, other_s = 0.02, 1 / 48.0
    apart_s = np.concatenate([np.full(500, usual_s), np.full(300, other_s), np.full(400, usual_s)])
    exposed_s = 100.0 + np.cumsum(apart_s)
    usual, others = by_rate(exposed_s, [np.arange(len(exposed_s))], usual_s)
    ((period_s, rows),) = others

    assert [len(one) for one in usual] == pytest.approx([500, 400], abs=10)
    assert period_s == pytest.approx(other_s, rel=1e-3)
    assert len(rows) == pytest.approx(300, abs=10)


def test_pieces_at_the_usual_rate_stay_whole():
    exposed_s = 0.02 * np.delete(np.arange(1000), [300, 301, 700])
    rows = np.arange(len(exposed_s))
    usual, others = by_rate(exposed_s, [rows, rows[:2]], 0.02)

    assert [one.tolist() for one in usual] == [rows.tolist(), [0, 1]]
    assert others == []
