"""`fitctl console --log`: every panel as it was, from a log that anyone may have written."""

import asyncio
import queue
import random
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from fitctl.commands.operate import console
from fitctl.commands.operate.logged_loops import loops_at_start
from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.logging.errors import LogError
from fitctl.logging.records import RunInfo, Snapshot
from fitctl.logging.writer import LogWriter
from fitctl.tui.alarms import notes
from fitctl.tui.app import ConsoleApp
from fitctl.tui.commands import VIEWS
from fitctl.tui.loops.fringes import fringe_line
from fitctl.tui.rewind import logged as logged_module
from fitctl.tui.rewind.logged import LoggedRun, _state_of
from fitctl.tui.rewind.moment import state_of
from fitctl.tui.rewind.player import Player
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.events import Events
from fitctl.tui.widgets.focalplane import FocalPlane
from fitctl.tui.widgets.health import Devices, Timing
from fitctl.tui.widgets.readings import DeviceList, Readings
from fitctl.tui.widgets.stages import Stages
from fitctl.tui.widgets.timing import Breakdown, Histograms
from fitctl.tui.widgets.traces import Traces
from fitctl.tui.wire import NoLink
from tests.instruments.fake_supervisor import (
    START_S,
    TESTBED,
    WALL_MINUS_MONOTONIC_S,
    FakeSupervisor,
)
from tests.samples.log_samples import SETTINGS
from tests.tui.drawn import plain
from tests.tui.fixed import FakeJob, PromptPlayer
from tests.tui.live import screen_text, until

RIG_JSON = load_rig(default_rig_path()).model_dump_json()
PANELS = (Traces, Stages, Devices, Timing, Events, DeviceList, Readings, Histograms, Breakdown)


def records_of(message):
    """What a supervisor logs of what it publishes."""
    yield from (*message.mode_changes, *message.events, *message.ticks, message.frame)
    yield from (*message.devices, *message.piezo, *message.timing)
    yield from (*message.metrology_ticks, *message.overlaps)
    yield from (message.recorder, message.losses)
    yield Snapshot(time_s=message.time_s, state_msgpack=msgspec.msgpack.encode(message.unlogged))


def write_log(path, messages, change=lambda record: record, *, snapshots=True, rig_json=RIG_JSON):
    info = RunInfo(
        time_s=START_S,
        wall_minus_monotonic_s=WALL_MINUS_MONOTONIC_S,
        rig_name="fit-mock",
        rig_json=rig_json,
        versions={},
        scheduling="SCHED_OTHER: real-time priority not permitted",
    )
    with LogWriter(path, SETTINGS) as writer:
        writer.write(info, START_S + WALL_MINUS_MONOTONIC_S)
        for message in messages:
            for record in records_of(message):
                if snapshots or not isinstance(record, Snapshot):
                    writer.write(change(record), message.time_s + WALL_MINUS_MONOTONIC_S)
    return path


def live_state(messages):
    state = ConsoleState(START_S)
    for message in messages:
        state.accept(message, message.time_s)
    state.now_s = state.received_s
    return state


def drawn(state):
    shown = {kind.__name__: plain(kind(state).draw(70, 12)) for kind in PANELS}
    plane = FocalPlane(state, "", None)
    return shown | {"FocalPlane": plain(plane.draw(40, 21))}


def at(run, time_s):
    return state_of(run.at(time_s), time_s)[0]


@pytest.mark.long
@pytest.mark.parametrize("torn", [False, True], ids=["finished", "torn"])
@pytest.mark.parametrize("mode", ["VERNIER", "ACQUISITION", "SAFE"])
def test_every_panel_of_a_log_is_as_it_was(tmp_path, mode, torn):
    messages = FakeSupervisor(mode, loops=("right", "left")).messages(500)
    path = write_log(tmp_path / "log.mcap", messages)
    if torn:
        path.write_bytes(path.read_bytes()[:-3000])
    run = LoggedRun(path, loops_at_start)
    for number in (40, 300):
        then = live_state(messages[:number])
        then.live = False  # the time axis ends at the time of the past
        assert drawn(at(run, messages[number - 1].time_s)) == drawn(then)


@pytest.mark.long
def test_who_stopped_the_loops_and_what_visibility_is_expected_are_as_they_were(tmp_path):
    stopped = FakeSupervisor(loops=TESTBED, modes={"left": "SAFE"}).messages(300)
    state = at(LoggedRun(write_log(tmp_path / "log.mcap", stopped), loops_at_start), START_S + 14.0)
    assert notes(state)[0].what == "left SAFE: stopped by anna"

    held = FakeSupervisor(loops=TESTBED).messages(300)
    state = at(LoggedRun(write_log(tmp_path / "held.mcap", held), loops_at_start), held[-1].time_s)
    (line,) = plain([fringe_line(state, 80)])
    assert line == plain([fringe_line(live_state(held), 80)])[0]
    assert "expected 0.9" in line


def test_a_log_without_snapshots_shows_what_its_records_have(tmp_path):
    messages = FakeSupervisor().messages(200)
    path = write_log(tmp_path / "log.mcap", messages, snapshots=False)
    state = at(LoggedRun(path, loops_at_start), messages[-1].time_s)
    known = live_state(messages)
    assert state.mode == "VERNIER"
    assert state.loop.state.since_s == pytest.approx(known.loop.state.since_s)
    assert state.loop.state.sky_arcsec_per_px == pytest.approx(2.708, abs=1e-3)
    assert state.loop.state.requirement_px == 0.1
    assert state.loop.state.limits.fsm_range_rad == pytest.approx(1.772e-4, rel=1e-3)
    assert state.loop.errors(5.0) == pytest.approx(known.loop.errors(5.0), abs=1e-6)


@pytest.mark.long
def test_where_the_supervisor_was_silent_the_past_is_silent(tmp_path):
    messages = FakeSupervisor().messages(400)
    path = write_log(tmp_path / "log.mcap", [*messages[:100], *messages[300:]])
    run = LoggedRun(path, loops_at_start)
    assert not at(run, START_S + 4.9).stale
    assert at(run, START_S + 14.0).stale
    assert not at(run, START_S + 15.5).stale


def test_events_are_those_until_then(tmp_path):
    messages = FakeSupervisor().messages(100)
    run = LoggedRun(write_log(tmp_path / "log.mcap", messages), loops_at_start)
    assert len(run.events()) == len({event for message in messages for event in message.events})
    state = at(run, START_S + 2.0)
    assert state.events[0].message.startswith("COARSE -> VERNIER: ")
    assert not run.at(START_S - 200.0).events


def test_a_flood_of_events_is_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(logged_module, "MOST_EVENTS", 20)
    messages = FakeSupervisor().messages(100)
    flood = [
        msgspec.structs.replace(
            message,
            events=[
                msgspec.structs.replace(messages[0].events[0], time_s=message.time_s)
                for _ in range(10)
            ],
        )
        for message in messages
    ]
    run = LoggedRun(write_log(tmp_path / "log.mcap", flood), loops_at_start)
    assert len(run.events()) == 20
    assert run.events()[0].time_s == pytest.approx(messages[-1].time_s)


@pytest.mark.parametrize(
    "content", [b"", b"no log", b"\x89MCAP0\r\n", b"\x89MCAP0\r\n" + b"\x06" * 99]
)
def test_what_is_no_log_is_refused_in_words(tmp_path, content):
    path = tmp_path / "log.mcap"
    path.write_bytes(content)
    with pytest.raises(LogError, match=r"log\.mcap"):
        LoggedRun(path, loops_at_start)


NUMBERS = [float("nan"), float("inf"), -1e300, 1e14, -1.0, 0.0, 1e-30, 3.7]
WHOLE = [0, -1, 2**62, 10**14, 40_000, -(2**31)]
TEXTS = ["", "\x1b[2J\x1b]0;x\x07", "x" * 4_000, "\u202e", "right", "[red]x[/]", "[/", "VERNIER"]
PACKED = [b"", b"\xff" * 100, b"\x80", msgspec.msgpack.encode({"loops": []})]


def test_a_snapshot_with_a_text_that_no_supervisor_writes_is_left_out():
    """Each panel draws such a text anew several times a second."""
    message = FakeSupervisor().message()
    fits, too_long = (
        Snapshot(
            time_s=0.0,
            state_msgpack=msgspec.msgpack.encode(
                msgspec.structs.replace(message, stopped_by="x" * length).unlogged
            ),
        )
        for length in (4_000, 4_001)
    )
    assert _state_of(fits) is not None
    assert _state_of(too_long) is None


class Hostile:
    """Changes about every fourth field of a record, and of what is packed in one, as its type allows."""

    def __init__(self, seed):
        self.random = random.Random(seed)

    def value(self, value):
        choices = {float: NUMBERS, int: WHOLE, str: TEXTS, bytes: PACKED}.get(type(value))
        if type(value) is bool:
            return not value
        return self.random.choice(choices) if choices else value

    def deep(self, value):
        if isinstance(value, dict):
            return {key: self.deep(item) for key, item in value.items()}
        if isinstance(value, list):
            return [self.deep(item) for item in value]
        return self.value(value) if self.random.random() < 0.05 else value

    def __call__(self, record):
        if isinstance(record, Snapshot):
            state = msgspec.to_builtins(msgspec.msgpack.decode(record.state_msgpack))
            packed = msgspec.msgpack.encode(self.deep(state))
            return msgspec.structs.replace(record, state_msgpack=packed)
        changed = {
            field: self.value(getattr(record, field))
            for field in record.__struct_fields__
            if field not in {"time_s", "loop"} and self.random.random() < 0.25
        }
        if isinstance(changed.get("number"), int) or hasattr(record, "severity"):
            changed = {k: v for k, v in changed.items() if k not in {"number", "severity"}}
        return msgspec.structs.replace(record, **changed)


def wild(change):
    """Only what protobuf can hold."""

    def checked(record):
        for _ in range(50):
            new = change(record)
            try:
                new_values = msgspec.structs.asdict(new)
                if hasattr(new, "width_px"):
                    assert 0 <= new_values["width_px"] < 2**32
                    assert 0 <= new_values["height_px"] < 2**32
                    assert new_values["width_px"] * 2 < 2**32
            except AssertionError:
                continue
            return new
        return record

    return checked


@pytest.mark.long
@pytest.mark.parametrize("seed", range(3))
def test_a_hostile_log_stays_harmless(tmp_path, seed):
    loops = TESTBED if seed == 2 else ("right", "left")
    supervisor = FakeSupervisor("ACQUISITION" if seed == 0 else "VERNIER", loops=loops)
    path = write_log(tmp_path / "log.mcap", supervisor.messages(120), wild(Hostile(seed)))
    run = LoggedRun(path, loops_at_start)
    app = ConsoleApp(
        NoLink(),
        rig_arguments=None,
        log_folder=tmp_path,
        log=run,
        log_name=path.name,
        start_job=FakeJob,
    )
    app.playback._player.__class__ = PromptPlayer

    async def main():
        async with app.run_test(size=(120, 40)) as pilot:
            await until(pilot, lambda: not app.state.live)
            for view in VIEWS:
                await pilot.press(view.key)
                for key in (
                    "right_curly_bracket",
                    "less_than_sign",
                    "v",
                    "escape",
                    "e",
                    "escape",
                    "l",
                ):
                    await pilot.press(key)
                    app.draw_all()
                for time_s in (START_S + 1.0, START_S + 3.0, START_S + 5.0):
                    app.playback.to(time_s)
                    await pilot.pause()
                    app.draw_all()
                await pilot.press("down", "enter", "escape")
            text = screen_text(app)
            assert "\x1b" not in text
            assert "LOG" in text

    asyncio.run(main())


@pytest.mark.long
def test_nothing_is_sent_from_a_log(tmp_path):
    messages = FakeSupervisor().messages(100)
    run = LoggedRun(write_log(tmp_path / "log.mcap", messages), loops_at_start)
    app = ConsoleApp(
        NoLink(), rig_arguments=None, log_folder=tmp_path, log=run, log_name="log.mcap"
    )
    sent = []
    app._wire.send = sent.append

    async def main():
        async with app.run_test(size=(120, 40), notifications=True) as pilot:
            await until(pilot, lambda: not app.state.live)
            await pilot.press("s", "a", "end", "k", "right_parenthesis")
            await pilot.pause()
            assert "no instrument is attached to a log" in " ".join(
                note.message for note in app._notifications
            )

    asyncio.run(main())
    assert sent == []


@pytest.mark.parametrize("options", [{"web": True}, {"remote": Path("key.toml")}])
def test_a_log_is_shown_from_this_machine_in_this_terminal(options):
    with pytest.raises(ConfigError, match="leave out --web and --remote"):
        console._show_log(
            Path("log.mcap"), **{"remote": None, "web": False} | options, graphics="auto"
        )


def test_a_log_that_cannot_be_read_is_named_before_the_console_opens(tmp_path):
    with pytest.raises(ConfigError, match=r"none\.mcap: cannot be opened"):
        console._show_log(tmp_path / "none.mcap", None, "auto", web=False)


def with_states(messages, change):
    """The same telemetry with other states of its loops."""
    return [
        msgspec.structs.replace(message, loops=[change(loop) for loop in message.loops])
        for message in messages
    ]


def test_a_moment_that_cannot_be_shown_is_told_and_the_next_one_is_shown(tmp_path):
    messages = FakeSupervisor().messages(100)

    class Odd(LoggedRun):
        def at(self, time_s):
            if time_s > messages[50].time_s:
                msg = "a record of an unknown kind"
                raise TypeError(msg)
            return super().at(time_s)

    path = write_log(tmp_path / "log.mcap", messages)
    made = queue.Queue()
    player = Player(Odd(path, loops_at_start), lambda _, what: made.put(what))
    try:
        player.seek(messages[-1].time_s)
        assert "this moment cannot be shown: " in made.get(timeout=10.0)
        player.seek(messages[30].time_s)
        assert made.get(timeout=10.0)[0].mode == "VERNIER"
    finally:
        player.close()


def test_a_snapshot_whose_loop_has_no_proper_name_is_left_out(tmp_path):
    messages = FakeSupervisor().messages(100)
    renamed = with_states(messages, lambda loop: replace(loop, name="it's"))
    run = LoggedRun(write_log(tmp_path / "log.mcap", renamed), loops_at_start)
    assert set(at(run, messages[-1].time_s).loops) == {"right"}
