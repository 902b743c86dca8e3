import time

import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.clock import MonotonicClock, VirtualClock, Watchdog


def test_the_machines_clock_is_the_one_that_all_processes_share():
    clock = MonotonicClock()
    before_s, now_s, after_s = time.monotonic(), clock.now_s(), time.monotonic()
    assert before_s <= now_s <= after_s


def test_a_deadline_is_never_left_early():
    clock = MonotonicClock()
    for wait_s in (1e-6, 1e-4, 0.0013, 0.01, 0.03):
        deadline_s = clock.now_s() + wait_s
        clock.sleep_until(deadline_s)
        assert clock.now_s() >= deadline_s


def test_oversleeping_once_does_not_shift_the_next_deadline():
    clock = MonotonicClock()
    start_s = clock.now_s()
    clock.sleep_until(start_s + 0.002)
    time.sleep(0.01)  # busy with something else
    begun_s = clock.now_s()
    clock.sleep_until(start_s + 0.004)  # already past: no sleep at all
    clock.sleep_until(start_s + 0.03)
    assert clock.now_s() >= start_s + 0.03
    assert begun_s >= start_s + 0.01


@pytest.mark.parametrize("deadline_s", [0.0, -1.0, -0.25])
def test_a_deadline_long_past_returns_at_once(deadline_s):
    clock = MonotonicClock()
    before_s = clock.now_s()
    clock.sleep_until(deadline_s)
    assert clock.now_s() - before_s < 1.0


def test_virtual_time_stands_still_until_it_is_told_to_go_on():
    clock = VirtualClock(5.0)
    time.sleep(0.002)
    assert clock.now_s() == 5.0
    clock.sleep_until(7.5)
    assert clock.now_s() == 7.5


@given(st.lists(st.floats(0, 1e6)))
def test_virtual_time_never_goes_back(deadlines_s):
    clock = VirtualClock()
    latest_s = 0.0
    for deadline_s in deadlines_s:
        clock.sleep_until(deadline_s)
        latest_s = max(latest_s, deadline_s)
        assert clock.now_s() == latest_s


def test_virtual_waiting_takes_no_time():
    before_s = time.monotonic()
    VirtualClock().sleep_until(3600.0)
    assert time.monotonic() - before_s < 1.0


def first_expired_s(watchdog, looks_s):
    return next((now_s for now_s in looks_s if watchdog.expired(now_s)), None)


def every(step_s, begin_s, end_s):
    return [begin_s + step_s * n for n in range(round((end_s - begin_s) / step_s) + 1)]


def test_a_watchdog_expires_when_its_limit_has_passed():
    watchdog = Watchdog(0.3, 0.1, now_s=10.0)
    assert first_expired_s(watchdog, every(0.002, 10.0, 11.0)) == pytest.approx(10.3, abs=0.005)
    assert watchdog.silent_s(10.5) == pytest.approx(0.5)


def test_a_watchdog_that_is_fed_starts_anew():
    watchdog = Watchdog(0.3, 0.1, now_s=10.0)
    assert first_expired_s(watchdog, every(0.002, 10.0, 10.28)) is None
    watchdog.feed(10.28)
    expired_s = first_expired_s(watchdog, every(0.002, 10.28, 11.0))
    assert expired_s == pytest.approx(10.58, abs=0.005)


@given(st.floats(0.3, 100.0))
def test_after_a_pause_a_watchdog_gives_the_sender_more_time(pause_s):
    watchdog = Watchdog(0.3, 0.1, now_s=10.0)
    assert not watchdog.expired(10.0)
    expired_s = first_expired_s(watchdog, every(0.002, 10.0 + pause_s, 11.0 + pause_s))
    assert expired_s == pytest.approx(10.1 + pause_s, abs=0.005)
