"""The console shows its last ten minutes again, every panel as it was, and goes on keeping what is new."""

import asyncio

import msgspec
import pytest

from fitctl.messages.commands import Acquire, Release, SetTarget, Stop, TakeOver
from fitctl.tui.commands import VIEWS
from fitctl.tui.dialogs import Running
from fitctl.tui.history import KEPT_S
from fitctl.tui.rewind import recent as recent_module
from fitctl.tui.rewind.bar import RewindBar
from fitctl.tui.rewind.moment import state_of
from fitctl.tui.rewind.recent import REWIND_S, Recent
from fitctl.tui.widgets.header import Header
from fitctl.tui.widgets.keys import Keys
from fitctl.tui.widgets.loglist import LogList
from fitctl.tui.widgets.panel import Panel
from tests.instruments.fake_supervisor import MESSAGE_S, START_S, FakeSupervisor
from tests.tui.drawn import plain
from tests.tui.fixed import FixedApp, settle
from tests.tui.piloted import pressed, run, sent

# What says that it is the past, or is not of the telemetry.
NOT_OF_THE_PAST = (Header, Keys, RewindBar, LogList)


def kept(supervisor, count):
    recent = Recent(tuple)
    for message in supervisor.messages(count):
        recent.add(message, message.time_s)
    return recent


def panels(app):
    """What every panel of a screen shows, were it of one size; the bar of the past takes some rows."""
    shown = {
        type(panel).__name__: plain(panel.draw(70, 16))
        for panel in app.view.query()
        if isinstance(panel, Panel) and not isinstance(panel, NOT_OF_THE_PAST)
    }
    if "Traces" in shown:
        shown["Traces"].pop()  # the time axis, which ends at the time of the past
    return shown


@pytest.mark.long
@pytest.mark.parametrize("view", VIEWS[:4], ids=lambda view: view.label)
@pytest.mark.parametrize("mode", ["VERNIER", "ACQUISITION"])
def test_every_panel_is_as_it_was(view, mode):
    app = FixedApp(FakeSupervisor(mode, loops=("right", "left")))
    first, last = app.recorded[:300], app.recorded[300:]

    async def main():
        async with app.run_test(size=(120, 40)) as pilot:
            app.recorded = first
            app.feed()
            await pressed(app, pilot, view.key)
            then = panels(app)
            app.recorded = last
            app.feed()
            await settle(app, pilot)
            now = panels(app)
            app.playback.to(first[-1].time_s + app.silent_s)
            await settle(app, pilot)
            assert panels(app) == then
            assert not app.state.live
            await pressed(app, pilot, "end")
            assert panels(app) == now
            return then, now

    then, now = asyncio.run(main())
    if view.name in {"operate", "loop"}:
        assert then != now


@pytest.mark.long
def test_the_state_of_a_moment_has_the_minute_before_it():
    recent = kept(FakeSupervisor(), 2000)
    time_s = START_S + 90.0
    state, _ = state_of(recent.at(time_s), time_s)
    times_s = state.loop.errors(1000.0)[:, 0]
    assert times_s[-1] == pytest.approx(time_s, abs=MESSAGE_S)
    assert times_s[-1] - times_s[0] == pytest.approx(KEPT_S, abs=2 * MESSAGE_S)
    assert not state.usable_commands


def test_ten_minutes_are_kept_and_no_more():
    message = FakeSupervisor().message()
    recent = Recent(tuple)
    for second in range(1000):
        recent.add(msgspec.structs.replace(message, time_s=START_S + second), START_S + second)
    assert recent.span_s() == (START_S + 999 - REWIND_S, START_S + 999)
    assert recent.at(START_S + 999 - REWIND_S - KEPT_S - 1) is None
    assert recent.at(START_S + 999 - REWIND_S).message.time_s == START_S + 999 - REWIND_S


def test_what_is_kept_never_exceeds_its_bytes(monkeypatch):
    monkeypatch.setattr(recent_module, "MOST_BYTES", 50_000)
    recent = kept(FakeSupervisor(), 100)
    oldest_s, newest_s = recent.span_s()
    assert recent.packed_bytes <= 50_000
    assert recent.packed_bytes > 40_000
    assert newest_s - oldest_s < 100 * MESSAGE_S
    assert recent.at(newest_s).message.sequence == 100


def test_ticks_of_another_supervisor_are_not_mixed_in():
    recent = kept(FakeSupervisor(pid=1), 100)
    for message in FakeSupervisor(pid=2).messages(300)[200:]:
        recent.add(message, message.time_s)
    oldest_s, newest_s = recent.span_s()
    ticks = recent.at(newest_s).message.ticks
    assert ticks[0].time_s > START_S + 9.9
    assert recent.at(oldest_s + 4.9).message.pid == 1


def test_silence_of_the_supervisor_is_silent_in_the_past_too():
    recent = kept(FakeSupervisor(), 100)
    time_s = START_S + 8.0
    state, alarms = state_of(recent.at(time_s), time_s)
    assert state.stale
    assert [alarm.key for alarm in alarms.in_order] == ["no data"]


def bar(app):
    panel = app.view.query_one(RewindBar)
    panel.redraw()
    return "\n".join(panel.render_line(y).text for y in range(panel.content_size.height))


@pytest.mark.long
def test_live_data_go_on_being_kept_while_the_past_is_shown():
    supervisor = FakeSupervisor()

    async def scenario(app, pilot):
        await pressed(app, pilot, "less_than_sign")
        shown = app.state.newest.sequence
        for message in supervisor.messages(500)[420:]:
            app.fixed_s = message.time_s
            app._accept(message)
        app.draw_all()
        assert app.state.newest.sequence == shown
        assert app.playback.live.newest.sequence == 500
        assert app.playback.recording.span_s()[1] == message.time_s
        assert "PAST" in bar(app)
        assert "0:14 ago" in bar(app)
        await pressed(app, pilot, "end")
        assert app.state.live
        assert app.state.newest.sequence == 500
        app._accept(supervisor.message())
        assert app.state.newest.sequence == 501

    run(scenario)


@pytest.mark.long
@pytest.mark.parametrize(
    "command", [Acquire(), Release(), TakeOver(), SetTarget(az_px=20.0, el_px=20.0)]
)
def test_commands_wait_until_the_console_is_live_again(command):
    async def scenario(app, pilot):
        sent = []
        app._wire.send = sent.append
        await pressed(app, pilot, "comma")
        app.send(command)
        app.send(Stop())
        await pilot.pause()
        assert sent == [Stop()]
        notes = " ".join(note.message for note in app._notifications)
        assert "the console shows the past" in notes
        await pressed(app, pilot, "end")
        app.send(command)
        assert type(sent[-1]) is type(command)

    run(scenario)


@pytest.mark.long
def test_keys_that_would_be_refused_are_not_in_the_last_line():
    async def scenario(app, pilot):
        def keys():
            return app.view.query_one(Keys).render_line(0).text

        assert "Release" in keys()
        assert "Target" in keys()
        await pressed(app, pilot, "comma")
        assert "Release" not in keys()
        assert "Target" not in keys()
        assert "STOP" in keys()
        assert "Now" in keys()

    run(scenario)


@pytest.mark.long
def test_an_alarm_of_now_is_on_the_screen_of_the_past():
    supervisor = FakeSupervisor()
    supervisor.messages(420)

    async def scenario(app, pilot):
        bells = []
        app.bell = lambda: bells.append(1)
        await pressed(app, pilot, "comma")
        supervisor.records_lost = 7
        message = supervisor.message()
        app.fixed_s = message.time_s
        app._accept(message)
        app.draw_all()
        assert "NOW ▲ 7 records are missing" in bar(app)
        assert bells
        assert not app.alarms.alarms
        await pressed(app, pilot, "k")
        assert app.playback.live_alarms.unacknowledged
        await pressed(app, pilot, "end", "k")
        assert not app.alarms.unacknowledged

    run(scenario)


@pytest.mark.long
def test_an_alarm_opens_five_seconds_before_it():
    supervisor = FakeSupervisor()
    app = FixedApp(FakeSupervisor())

    async def main():
        async with app.run_test(size=(120, 40)) as pilot:
            for lost in (0, 7):
                supervisor.records_lost = lost
                for messages in (1, 199):
                    app.recorded = supervisor.messages(messages)
                    app.feed()
            await pilot.pause()
            assert app.alarms.in_order[0].since_s == pytest.approx(START_S + 10.0, abs=0.1)
            await pressed(app, pilot, "v", "enter")
            assert app.playback.shown_s == pytest.approx(START_S + 5.0, abs=0.1)
            assert not app.alarms.alarms

    asyncio.run(main())


@pytest.mark.long
def test_the_console_stays_within_what_is_kept():
    async def scenario(app, pilot):
        await pressed(app, pilot, "left_curly_bracket")
        oldest_s = app.playback.recording.span_s()[0]
        assert app.playback.shown_s == oldest_s
        await pressed(app, pilot, "comma")
        assert app.playback.shown_s == oldest_s
        assert "older data are in the log" in " ".join(n.message for n in app._notifications)
        await pressed(app, pilot, "right_curly_bracket")
        assert app.state.live
        await pressed(app, pilot, "full_stop")
        assert app.state.live

    run(scenario)


@pytest.mark.long
def test_loop_and_window_stay_as_chosen():
    async def scenario(app, pilot):
        await pressed(app, pilot, "l", "w", "comma")
        assert app.state.shown == "left"
        assert app.state.window.rms_s == 60.0
        await pressed(app, pilot, "l", "end")
        assert app.state.shown == "right"
        assert app.state.window.rms_s == 60.0

    run(scenario, supervisor=FakeSupervisor(loops=("right", "left")))


@pytest.mark.parametrize(
    ("text", "ago_s"),
    [("-0:05", 5.0), ("-5", 5.0), ("−1:00:00", 3600.0), ("07:00:20", 1.0), ("08:00:00", 82821.0)],
)
def test_a_time_is_typed(text, ago_s):
    async def scenario(app, _pilot):
        newest_s = app.playback.recording.span_s()[1]
        wall_s = app.state.wall_s(newest_s)
        assert wall_s % 86400 == pytest.approx(7 * 3600 + 21, abs=0.03)
        assert newest_s - app.playback.time_of(text) == pytest.approx(ago_s, abs=0.03)

    run(scenario)


@pytest.mark.parametrize(
    "text",
    ["", "noon", "1:2:3:4", "25:00:00", "nan", "-inf", "10:00", "03:60:00", "03:00:60", "-1:99"],
)
def test_what_is_no_time_is_refused(text):
    async def scenario(app, _pilot):
        assert app.playback.time_of(text) is None
        assert app.playback.refused(text) == "a time is 03:14:07, or -2:30"

    run(scenario)


def test_a_time_before_the_oldest_data_is_refused_with_theirs():
    async def scenario(app, _pilot):
        assert app.playback.refused("-0:10") == ""
        why = "the oldest data here are of 07:00:00; older data are in the log"
        assert app.playback.refused("-1:00") == app.playback.refused("03:00:00") == why

    run(scenario)


@pytest.mark.long
def test_a_rehearsal_is_a_process_of_its_own_and_ends_with_its_dialog():
    async def scenario(app, pilot):
        await pressed(app, pilot, "t", "right", "d", "enter")
        job = app.jobs[-1]
        assert job.arguments == ["rehearse", "target", "24.5", "19.5", "--loop", "right"]
        assert isinstance(app.screen, Running)
        await pressed(app, pilot, "escape")
        assert job.ended
        assert sent(app) == []

    run(scenario)


@pytest.mark.long
def test_nothing_is_rehearsed_from_the_past():
    async def scenario(app, pilot):
        await pressed(app, pilot, "comma", "d")
        assert "press end first" in " ".join(note.message for note in app._notifications)
        assert not app.screen.is_modal

    run(scenario)
