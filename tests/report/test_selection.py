import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from samples.report_samples import PERIOD_S, ticks_of

from fitctl.error_budget import regular
from fitctl.messages.modes import Mode
from fitctl.report.selection import TARGET_SETTLE_S, searches_for_lost_star, select_frames
from fitctl.simulation.statistics import SETTLE_S

FRAMES = 3000  # a minute


def selected(ticks):
    return select_frames(ticks, PERIOD_S, requirement_px=0.1)


def test_the_first_seconds_of_vernier_do_not_count():
    found = selected(ticks_of(FRAMES))

    assert found.held_s == pytest.approx(60.0)
    assert found.evaluated_s == pytest.approx(60.0 - SETTLE_S)
    assert len(found.pieces) == 1
    assert found.measured_fraction == 1.0


def test_each_return_to_vernier_settles_anew():
    modes = np.full(FRAMES, Mode.VERNIER, np.int8)
    modes[1500:1600] = Mode.COARSE

    found = selected(ticks_of(FRAMES, mode_number=modes))

    assert [len(piece) for piece in found.pieces] == [1000, 900]


def test_a_mode_between_ends_a_piece_even_without_a_frame_in_it():
    modes, numbers = np.full(FRAMES, Mode.VERNIER, np.int8), np.arange(FRAMES)
    modes[1500], numbers[1500] = Mode.ACQUISITION, -1

    assert len(selected(ticks_of(FRAMES, mode_number=modes, number=numbers)).pieces) == 2


def test_a_target_on_its_way_does_not_count_and_starts_a_new_piece():
    target_px = np.zeros(FRAMES, np.float32)
    target_px[1500:1600] = np.linspace(0, 1, 100)  # half a pixel a second
    target_px[1600:] = 1.0

    found = selected(ticks_of(FRAMES, target_az_px=target_px))

    assert found.evaluated_s == pytest.approx(60 - SETTLE_S - 2.0 - TARGET_SETTLE_S, abs=0.1)
    assert [len(piece) for piece in found.pieces] == [
        pytest.approx(1000, abs=3),
        pytest.approx(1300, abs=3),
    ]


def test_a_target_that_creeps_slower_than_half_the_requirement_stands_still():
    creeping = np.linspace(0, 1, FRAMES).astype(np.float32)

    assert len(selected(ticks_of(FRAMES, target_el_px=creeping)).pieces) == 1


def test_missing_stars_are_counted_and_longer_gaps_end_a_piece():
    seen = np.ones(FRAMES, bool)
    seen[1000:1010] = False  # 0.2 s
    seen[2000:2100] = False  # 2 s

    found = selected(ticks_of(FRAMES, star_visible=seen))

    assert len(found.pieces) == 2
    assert found.measured_fraction == pytest.approx(1 - 110 / 2500)
    assert len(found.rows) == 2390


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.COARSE, Mode.SAFE])
def test_other_modes_are_not_judged(mode):
    found = selected(ticks_of(FRAMES, mode=mode))

    assert (found.pieces, found.held_s, found.evaluated_s) == ([], 0.0, 0.0)


def test_no_tick_at_all_is_judged_by_nothing():
    assert selected(ticks_of(0)).evaluated_s == 0.0


@given(st.sets(st.integers(1, 98), max_size=20))
def test_missing_frames_are_bridged_by_straight_lines(missing):
    there = np.array([frame for frame in range(100) if frame not in missing])
    line = np.column_stack([3.0 * there, 1.0 - there])

    whole = regular(PERIOD_S * there, line, PERIOD_S)

    straight = np.column_stack([3.0 * np.arange(100), 1.0 - np.arange(100)])
    np.testing.assert_allclose(whole, straight, atol=1e-12)  # one of them is zero


def test_searches_for_a_lost_star_are_those_that_follow_a_mode_with_a_star():
    modes = np.full(FRAMES, Mode.VERNIER, np.int8)
    modes[:100] = Mode.STANDBY
    modes[100:200] = Mode.ACQUISITION  # the first search
    modes[500:1000] = Mode.ACQUISITION
    modes[2000:2050] = Mode.ACQUISITION
    modes[-10:] = Mode.ACQUISITION  # the run ends during the search

    found = searches_for_lost_star(ticks_of(FRAMES, mode_number=modes))

    assert found == pytest.approx([10.0, 1.0, 0.18])
    assert searches_for_lost_star(ticks_of(0)) == []
