"""Readings of the encoders that are dated, unwrapped, and held against what motors can do."""

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.cia402 import positions
from fitctl.drivers.cia402.positions import Encoders
from fitctl.drivers.cia402.protocol import wrap_int32

FASTEST_COUNTS_S = 1000.0
counters = st.integers(-(2**31), 2**31 - 1)


class Script:
    """Encoders at a time of the test's own."""

    def __init__(self, monkeypatch):
        self.now_s = 100.0
        monkeypatch.setattr(positions, "time", SimpleNamespace(monotonic=lambda: self.now_s))
        self.encoders = Encoders(FASTEST_COUNTS_S)

    def read(self, az, el=0, after_s=0.002, commanded=None):
        """One period: SYNC, and its answer."""
        self.encoders.latched = None
        self.now_s += after_s
        self.encoders.sync_sent(self.now_s, commanded)
        self.encoders.add((az, el))
        return self.encoders.latched


@pytest.fixture
def script(monkeypatch):
    return Script(monkeypatch)


def test_a_reading_has_the_time_of_its_sync(script):
    assert script.read(5) == (script.now_s, (5, 0))


def test_a_copy_answers_no_sync_and_is_passed_over(script):
    script.read(5)
    script.encoders.latched = None
    script.encoders.add((5, 0))
    assert script.encoders.latched is None


def test_a_false_reading_is_kept_back_and_the_next_one_counts(script):
    script.read(0)
    assert script.read(2**16) is None
    assert script.read(1).counts == (1, 0)
    assert script.encoders.motion.jumped is None


def test_two_false_readings_that_do_not_agree_are_both_kept_back(script):
    script.read(0)
    assert script.read(2**16) is None
    assert script.read(2**20) is None
    assert script.read(1).counts == (1, 0)
    assert script.encoders.motion.jumped is None


def test_an_encoder_that_stays_away_has_jumped(script):
    script.read(0, 0)
    assert script.read(0, 500) is None
    script.read(0, 501)
    assert script.encoders.motion.jumped == (0, 501)
    script.encoders.motion.trust()
    assert script.read(0, 502).counts == (0, 502)
    assert script.encoders.motion.jumped is None


def test_a_motor_may_go_on_at_its_limit_after_any_silence(script):
    script.read(0)
    for turn in range(1, 10):
        assert script.read(round(turn * FASTEST_COUNTS_S * 0.5), after_s=0.5) is not None
    assert script.encoders.motion.jumped is None


def test_what_the_velocity_limit_allows_is_false_for_a_motor_that_is_commanded_less(script):
    """Of a false digit in the count: 200 is what the limit lets it turn in the time, not the command."""
    fast = 0.2
    for _ in range(3):
        script.read(0, commanded=(0.0, 0.0), after_s=fast)
    assert script.read(100, commanded=(0.0, 0.0), after_s=fast) is None
    assert script.read(1, commanded=(0.0, 0.0), after_s=fast).counts == (1, 0)
    assert script.encoders.motion.jumped is None
    assert script.read(100, commanded=(0.0, 0.0), after_s=fast) is None
    script.read(101, commanded=(0.0, 0.0), after_s=fast)
    assert script.encoders.motion.jumped == (100, 0)


def test_a_motor_may_go_on_at_what_it_was_commanded_and_slow_down(script):
    place = 0.0
    for speed in (0.0, 0.0, 900.0, 900.0, 0.0, 0.0):
        assert script.read(int(place), commanded=(speed, 0.0), after_s=0.02), (speed, place)
        place += speed * 0.02
    assert script.read(int(place), commanded=(0.0, 0.0), after_s=0.3)
    assert script.read(int(place) + 270, commanded=(0.0, 0.0), after_s=0.3) is None


def test_after_a_silence_the_motor_has_had_its_last_command_all_the_time(script):
    for _ in range(3):
        script.read(0, commanded=(0.0, 0.0), after_s=0.2)
    script.read(0, commanded=(-800.0, 0.0), after_s=0.02)
    assert script.read(-320, commanded=(0.0, 0.0), after_s=0.4)


def test_late_answers_are_held_against_the_commands_of_their_time(script):
    for _ in range(3):
        script.read(0, commanded=(0.0, 0.0), after_s=0.2)
    encoders = script.encoders
    for speed in (1000.0, 1000.0, *[0.0] * 20):  # the link stands still, and so the servo
        script.now_s += 0.02
        encoders.sync_sent(script.now_s, (speed, 0.0))
    for place in (0, 20, 40, *[40] * 19):
        encoders.latched = None
        encoders.add((place, 0))
        assert encoders.latched is not None
    assert encoders.motion.jumped is None


def test_answers_that_never_come_leave_what_was_commanded_with_them(script):
    for _ in range(3):
        script.read(0, commanded=(0.0, 0.0), after_s=0.2)
    for speed in (1000.0, *[0.0] * 20):
        script.now_s += 0.02
        script.encoders.sync_sent(script.now_s, (speed, 0.0))
    script.encoders.give_up()
    assert script.read(300, commanded=(0.0, 0.0)) is not None


def test_motors_without_current_may_be_turned_by_hand(script):
    script.read(0, commanded=(0.0, 0.0))
    for turn in range(1, 5):
        assert script.read(180 * turn, after_s=0.2) is not None


def test_after_a_restart_any_place_is_believed(script):
    script.read(0)
    script.encoders.restart()
    assert script.read(10**6).counts == (10**6, 0)


@given(counters, st.lists(st.integers(-1000, 1000), max_size=30))
def test_the_sum_of_steps_does_not_wrap(start, steps):
    encoders = Encoders(1e9)
    place = start
    for step in [0, *steps]:
        place += step
        encoders.sync_sent(0.0)
        encoders.add((wrap_int32(place), 0))
        assert encoders.latched.counts[0] - place == 0
