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

    def read(self, az, el=0, after_s=0.002):
        """One period: SYNC, and its answer."""
        self.encoders.latched = None
        self.now_s += after_s
        self.encoders.sync_sent(self.now_s)
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
    assert script.encoders.jumped == ""


def test_two_false_readings_that_do_not_agree_are_both_kept_back(script):
    script.read(0)
    assert script.read(2**16) is None
    assert script.read(2**20) is None
    assert script.read(1).counts == (1, 0)
    assert script.encoders.jumped == ""


def test_an_encoder_that_stays_away_has_jumped(script):
    script.read(0, 0)
    assert script.read(0, 500) is None
    script.read(0, 501)
    assert script.encoders.jumped == "azimuth moved by 0 counts, elevation moved by 501 counts"
    script.encoders.trust()
    assert script.read(0, 502).counts == (0, 502)
    assert script.encoders.jumped == ""


def test_a_motor_may_go_on_at_its_limit_after_any_silence(script):
    script.read(0)
    for turn in range(1, 10):
        assert script.read(round(turn * FASTEST_COUNTS_S * 0.5), after_s=0.5) is not None
    assert script.encoders.jumped == ""


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
