import math

import msgspec
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.logging.records import Event, MetrologyTick, Overlap
from fitctl.tui.history import KEPT_S, Past
from fitctl.tui.state import WINDOWS, ConsoleState, error_rms
from tests.instruments.fake_supervisor import (
    MESSAGE_S,
    START_S,
    WALL_MINUS_MONOTONIC_S,
    FakeSupervisor,
)


def fed(supervisor, count):
    state = ConsoleState(START_S)
    for message in supervisor.messages(count):
        state.accept(message, message.time_s)
    return state


@pytest.mark.long
def test_ticks_are_kept_for_the_longest_window_and_no_longer():
    state = fed(FakeSupervisor(), 1600)
    times_s = state.loop.errors(1000.0)[:, 0]
    assert times_s[-1] - times_s[0] == pytest.approx(KEPT_S, abs=0.05)
    assert len(state.loop.past) == len(times_s) == pytest.approx(KEPT_S * 50, abs=3)
    assert max(map(max, WINDOWS)) <= KEPT_S


@pytest.mark.parametrize("count", [1, 5, 4095, 4096, 4097, 9000])
def test_the_past_is_whole_however_long_it_grows(count):
    past = Past(("time_s", "value"))
    for number in range(count):
        past.add([(number * 0.01, 0.0)], number * 0.01)
    times_s = past.since(-1.0, "time_s")[:, 0]
    kept = min(count, round(KEPT_S / 0.01) + 1)
    assert times_s == pytest.approx(np.arange(count - kept, count) * 0.01)


def test_the_past_is_asked_from_a_time_on():
    state = fed(FakeSupervisor(), 100)
    now_s = state.loop.tick.time_s
    errors = state.loop.errors(1.0)
    assert errors.shape == (51, 3)
    assert errors[0, 0] == pytest.approx(now_s - 1.0, abs=0.011)


def test_the_rms_is_about_the_target_and_not_from_before_a_time():
    times_s = np.arange(0, 20, 0.02)
    offset = np.where(times_s < 9.5, 5.0, 0.1)
    rms = error_rms(np.column_stack([times_s, offset, -2 * offset]), 9.98)
    assert rms.az_px == pytest.approx(0.1)
    assert rms.el_px == pytest.approx(0.2)
    assert rms.span_s == pytest.approx(10.0, abs=0.05)


def test_ticks_without_a_star_do_not_count():
    errors = np.array([[1.0, 0.3, 0.4], [1.1, math.nan, math.nan], [1.2, 0.3, 0.4]])
    rms = error_rms(errors, 0.0)
    assert (rms.az_px, rms.el_px) == (pytest.approx(0.3), pytest.approx(0.4))
    assert math.isnan(error_rms(errors[1:2], 0.0).az_px)
    assert math.isnan(error_rms(np.empty((0, 3)), 0.0).az_px)


def test_the_way_of_a_search_is_kept_until_the_next_one_begins():
    supervisor = FakeSupervisor("ACQUISITION")
    state = fed(supervisor, 300)
    trail = state.loop.search_trail_sky_arcsec
    assert len(trail) > 20
    assert math.dist(trail[0], (100.0, -40.0)) < 5.0
    message = supervisor.message()
    again = [msgspec.structs.replace(loop, since_s=START_S + 50) for loop in message.loops]
    state.accept(msgspec.structs.replace(message, loops=again), START_S)
    assert len(state.loop.search_trail_sky_arcsec) <= 3


def metrology_tick(time_s, **fields):
    numbers = {
        name: 0.0
        for name, kind in MetrologyTick.__annotations__.items()
        if kind in {"float", "int"}
    }
    texts = {"loop": "metrology", "mode": "LOCKED", "beam_state": "MEASURED", "late": False}
    return MetrologyTick(**numbers | texts | {"time_s": time_s} | fields)


def test_a_metrology_loop_has_a_past_of_its_beam_in_the_cameras_pixels():
    message = FakeSupervisor(loops=("metrology",)).message()
    scale = message.loops[0].sky_arcsec_per_px
    ticks = [
        metrology_tick(START_S + 0.1, beam_az_arcsec=2 * scale, beam_el_arcsec=-scale),
        metrology_tick(START_S + 0.2, beam_az_arcsec=math.nan, beam_el_arcsec=math.nan),
    ]
    state = ConsoleState(START_S)
    state.accept(msgspec.structs.replace(message, ticks=[], metrology_ticks=ticks), START_S)
    assert state.loop.tick is None
    assert state.loop.beam == ticks[-1]
    errors = state.loop.errors(10.0)
    assert errors[0] == pytest.approx([START_S + 0.1, 2.0, -1.0])
    assert np.isnan(errors[1, 1:]).all()


def test_the_visibility_has_a_past_until_another_supervisor_speaks():
    overlaps = [
        Overlap(
            time_s=START_S + 0.02 * number,
            loop="left",
            other_loop="right",
            number=number,
            tilt_az_arcsec=0.1,
            tilt_el_arcsec=-0.2,
            visibility=0.9 + 0.001 * number,
        )
        for number in range(3)
    ]
    supervisor = FakeSupervisor()
    state = ConsoleState(START_S)
    state.accept(msgspec.structs.replace(supervisor.message(), overlaps=overlaps), START_S)
    state.accept(supervisor.message(), START_S + 0.05)
    assert state.overlap == overlaps[-1]
    visibility = state.fringes.since(START_S, "time_s", "visibility")
    assert visibility == pytest.approx(
        np.array([[1000.0, 0.9], [1000.02, 0.901], [1000.04, 0.902]])
    )
    state.accept(FakeSupervisor(pid=2).message(), START_S + 1)
    assert state.overlap is None
    assert len(state.fringes) == 0


def test_windows_are_cycled():
    state = ConsoleState(START_S)
    seen = []
    for _ in range(len(WINDOWS) + 1):
        seen.append(state.window)
        state.next_window()
    assert seen == [*WINDOWS, WINDOWS[0]]


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


@given(
    st.lists(st.integers(0, 20)),
    st.integers(0, 30),
    st.integers(0, 30),
)
def test_events_of_the_past_are_put_in_their_places_once(times_s, begin, end):
    """Whatever part of them was heard: `begin` to `end`."""
    all_ = [
        Event(time_s=time_s, severity="info", source="x", message=str(number))
        for number, time_s in enumerate(sorted(times_s))
    ]
    state = ConsoleState(START_S)
    state.events.extendleft(all_[begin:end])
    state.recall(all_)
    assert sorted(event.message for event in state.events) == sorted(e.message for e in all_)
    shown_s = [event.time_s for event in state.events]
    assert shown_s == sorted(shown_s, reverse=True)


def test_events_of_a_clock_that_has_begun_anew_are_not_shown_with_false_times():
    state = fed(FakeSupervisor(pid=1), 1)
    assert state.events
    after_boot = msgspec.structs.replace(FakeSupervisor(pid=2).message(), time_s=5.0, events=[])
    state.accept(after_boot, START_S)
    assert not state.events


def test_loops_are_cycled_by_name():
    state = fed(FakeSupervisor(loops=("right", "left")), 3)
    assert state.shown == "right"
    state.show_next_loop()
    assert state.shown == "left"
    assert state.loop.tick.loop == "left"
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
    assert len(state.loop.past) < 10


def test_lost_records_are_the_greater_of_both_counts():
    message = FakeSupervisor().message()
    recorder = msgspec.structs.replace(message.recorder, lost=7)
    losses = msgspec.structs.replace(message.losses, records_lost=5)
    assert msgspec.structs.replace(message, losses=losses, recorder=recorder).records_lost == 7
    assert msgspec.structs.replace(message, losses=losses, recorder=None).records_lost == 5


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
