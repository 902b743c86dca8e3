import math

import msgspec
import numpy as np
import pytest

from fitctl.tui.state import TRACE_S, ConsoleState, error_rms
from tests.tui.fake import MESSAGE_S, START_S, WALL_MINUS_MONOTONIC_S, FakeSupervisor


def fed(supervisor, count):
    state = ConsoleState(START_S)
    for message in supervisor.messages(count):
        state.accept(message, message.time_s)
    return state


def test_ticks_are_kept_for_as_long_as_the_traces():
    state = fed(FakeSupervisor(), 600)
    times_s = state.loop.errors()[:, 0]
    assert times_s[-1] - times_s[0] == pytest.approx(TRACE_S, abs=0.05)
    assert len(times_s) == pytest.approx(TRACE_S * 50, abs=2)


def test_the_rms_is_about_the_target_and_of_the_last_ten_seconds():
    times_s = np.arange(0, 20, 0.02)
    offset = np.where(times_s < 9.5, 5.0, 0.1)
    rms = error_rms(np.column_stack([times_s, offset, -2 * offset]), 19.98, 0.0)
    assert rms.az_px == pytest.approx(0.1)
    assert rms.el_px == pytest.approx(0.2)
    assert rms.span_s == pytest.approx(10.0, abs=0.05)


def test_the_rms_forgets_the_mode_before():
    errors = np.array([[1.0, 9.0, 9.0], [2.0, 0.1, 0.1], [3.0, 0.1, 0.1]])
    rms = error_rms(errors, 3.0, 1.5)
    assert (rms.az_px, rms.span_s) == (pytest.approx(0.1), pytest.approx(1.0))


def test_ticks_without_a_star_do_not_count():
    errors = np.array([[1.0, 0.3, 0.4], [1.1, math.nan, math.nan], [1.2, 0.3, 0.4]])
    rms = error_rms(errors, 1.2, 0.0)
    assert (rms.az_px, rms.el_px) == (pytest.approx(0.3), pytest.approx(0.4))
    assert math.isnan(error_rms(errors[1:2], 1.2, 0.0).az_px)
    assert math.isnan(error_rms(np.empty((0, 3)), 1.2, 0.0).az_px)


def test_data_are_stale_before_the_first_message_and_a_second_after_the_last():
    state = ConsoleState(START_S)
    assert state.stale
    message = FakeSupervisor().message()
    state.accept(message, START_S)
    state.now_s = START_S + 0.9
    assert not state.stale
    state.now_s = START_S + 1.1
    assert state.stale
    assert state.silent_s == pytest.approx(1.1)


def test_events_are_newest_first():
    state = fed(FakeSupervisor(), 1)
    times_s = [event.time_s for event in state.events]
    assert times_s == sorted(times_s, reverse=True)


def test_loops_are_cycled_by_name():
    state = fed(FakeSupervisor(loops=("right", "left")), 3)
    assert state.shown == "right"
    state.show_next_loop()
    assert state.shown == "left"
    assert {tick.loop for tick in state.loop.ticks} == {"left"}
    state.show_next_loop()
    assert state.shown == "right"


def test_a_loop_that_is_gone_is_not_shown():
    state = fed(FakeSupervisor(loops=("right", "left")), 3)
    state.show_next_loop()
    state.accept(FakeSupervisor(loops=("right",)).message(), START_S)
    assert state.shown == "right"


def test_another_supervisor_starts_with_an_empty_past():
    state = fed(FakeSupervisor(pid=1), 100)
    state.accept(FakeSupervisor(pid=2).message(), START_S + 60)
    assert len(state.loop.ticks) < 10


def test_lost_records_are_the_greater_of_both_counts():
    message = FakeSupervisor().message()
    recorder = msgspec.structs.replace(message.recorder, lost=7)
    losses = msgspec.structs.replace(message.losses, records_lost=5)
    state = ConsoleState(START_S)
    state.accept(msgspec.structs.replace(message, losses=losses, recorder=recorder), START_S)
    assert state.records_lost == 7
    state.accept(msgspec.structs.replace(message, losses=losses, recorder=None), START_S)
    assert state.records_lost == 5


def test_messages_that_did_not_come_are_counted_until_another_supervisor_speaks():
    messages = FakeSupervisor(pid=1).messages(10)
    state = ConsoleState(START_S)
    for message in (*messages[:3], *messages[7:]):
        state.accept(message, START_S)
    assert state.missed == 4

    state.accept(FakeSupervisor(pid=2).messages(20)[-1], START_S)
    assert state.missed == 0


def test_the_rate_of_messages_settles_at_theirs():
    state = fed(FakeSupervisor(), 100)
    assert state.rate_hz == pytest.approx(1 / MESSAGE_S, rel=0.05)


def test_wall_time_follows_the_supervisor():
    state = fed(FakeSupervisor(), 1)
    assert state.wall_s(START_S) == START_S + WALL_MINUS_MONOTONIC_S
