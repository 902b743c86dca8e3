"""`fitctl status` and `fitctl watch`: what they make of telemetry."""

import itertools
import json
import math

import msgspec
import pytest

from fitctl.commands.operate import watch
from fitctl.commands.operate.status import duration, status_document, status_lines
from fitctl.commands.shared.printing import to_json, utc
from fitctl.commands.shared.supervisor import print_reply
from fitctl.logging.records import Event
from fitctl.messages.commands import Reply
from fitctl.messages.telemetry import LoopFailure, TrippedInterlock
from fitctl.messages.troubles import RECORDER_SILENT_S, troubles
from tests.instruments.fake_supervisor import STAR_LOST, FakeSupervisor

TRIPPED = TrippedInterlock(
    name="flux_low",
    since_s=999.0,
    action="warn",
    reset="itself",
    reason="interlock flux_low: star of right: 0.7 is below 0.75; check the shutter",
)


def told(supervisor=None, **changes):
    """A message, with some of its fields replaced."""
    return msgspec.structs.replace((supervisor or FakeSupervisor()).message(), **changes)


def lines(message):
    return [trouble.line for trouble in troubles(message)]


def told_of_losses(count):
    supervisor = FakeSupervisor()
    supervisor.records_lost = count
    return supervisor.message()


# ---------------------------------------------------------------- what is not well


def test_an_instrument_that_holds_its_star_is_well():
    assert troubles(told()) == []


def test_an_instrument_that_is_off_is_well():
    assert troubles(told(FakeSupervisor("OFF"))) == []


@pytest.mark.parametrize(
    ("trouble", "expected"),
    [
        (lambda: told(FakeSupervisor("SAFE")), "right is SAFE: "),
        (lambda: told(recorder=None), "nothing is being recorded"),
        (lambda: told_of_losses(3), "3 records are missing"),
        (lambda: told(time_s=told().time_s + 1.1 * RECORDER_SILENT_S), "silent for 11 s"),
    ],
    ids=["safe", "no recorder", "losses", "silent recorder"],
)
def test_what_is_not_well_is_one_line_each(trouble, expected):
    (line,) = lines(trouble())

    assert expected in line


def test_a_recorder_that_has_not_reported_yet_is_no_trouble_until_it_has_been_silent():
    def after(started_s):
        now_s = told().time_s
        return lines(told(recorder=None, recorder_started_s=now_s - started_s))

    assert after(0.9 * RECORDER_SILENT_S) == []
    (line,) = after(1.1 * RECORDER_SILENT_S)
    assert "nothing is being recorded: the recorder has been silent for 11 s" in line


@pytest.mark.parametrize("mode", ["OFF", "STANDBY", "VERNIER"])
def test_without_a_recorder_that_runs_nothing_is_recorded_in_any_mode(mode):
    found = [
        one for one in troubles(told(FakeSupervisor(mode), recorder=None)) if one.key == "recorder"
    ]
    assert [one.severity for one in found] == ["warning"]


def test_a_tripped_interlock_and_a_device_in_fault_are_named_with_what_to_do():
    supervisor = FakeSupervisor()
    supervisor.interlocks = [TRIPPED]
    message = told(supervisor)
    camera = msgspec.structs.replace(message.devices[0], state="fault", detail="no frame came")
    found = lines(msgspec.structs.replace(message, devices=[camera, *message.devices[1:]]))

    assert found == [
        TRIPPED.reason,
        f"{camera.device} at {camera.endpoint}: no frame came; fitctl tries again",
    ]


@pytest.mark.parametrize("mode", ["STANDBY", "SAFE"])
def test_the_hexapod_s_fault_is_the_collector_s_and_of_no_loop(mode):
    message = told(FakeSupervisor(mode, loops=("right", "metrology", "left")))
    hexapod = next(one for one in message.devices if one.device == "hexapod")
    fault = msgspec.structs.replace(
        hexapod, state="fault", time_s=0.0, detail="no answer; then start the collector"
    )
    found = lines(msgspec.structs.replace(message, devices=[fault]))

    assert found[-1] == (
        f"hexapod at {hexapod.endpoint}: no answer; the collector's motion has ended; "
        "then start the collector"
    )


def test_a_lost_star_is_one_trouble_as_long_as_it_is_searched_for():
    supervisor = FakeSupervisor("ACQUISITION")
    supervisor.search_again = STAR_LOST
    supervisor.interlocks = [
        msgspec.structs.replace(TRIPPED, name="star_lost"),
        msgspec.structs.replace(TRIPPED, name="disk_space", reason="interlock disk_space: full"),
    ]

    found = lines(told(supervisor))

    assert found == [
        "right: star lost 133 s ago; the loop searches again, round 2, within 108 arcsec of its last place; "
        "check shutter and clouds; release, stop or acquire ends the search",
        "interlock disk_space: full",
    ]


def test_a_failed_command_is_a_trouble_with_what_to_do():
    supervisor = FakeSupervisor("OFF")
    supervisor.last_failure = LoopFailure(
        what="standby",
        time_s=999.0,
        text="piezo at ttyUSB0: expected an answer, got none; is it on?",
    )

    assert lines(told(supervisor)) == [
        "right: standby failed: piezo at ttyUSB0: expected an answer, got none; "
        "all devices were closed again; is it on?; then standby"
    ]


def test_an_interlock_on_the_lost_star_that_holds_the_stages_is_still_named():
    supervisor = FakeSupervisor("ACQUISITION")
    supervisor.search_again = STAR_LOST
    supervisor.interlocks = [msgspec.structs.replace(TRIPPED, name="star_lost", action="freeze")]

    assert "interlock flux_low: star of right: " in lines(told(supervisor))[1]


# ---------------------------------------------------------------- status


def test_the_document_has_all_of_a_message_but_its_streams():
    message = told()
    document = json.loads(msgspec.json.encode(status_document(message, [])))

    streams = {"frame", "events", "mode_changes"}
    assert document.keys() == {"well", "troubles", "time"} | (
        set(message.__struct_fields__) - streams
    )
    assert document["well"]
    assert document["loops"][0]["mode"] == "VERNIER"
    assert document["loops"][0]["since"] == utc(message, message.loops[0].since_s)
    assert [tick["number"] for tick in document["ticks"]] == [message.ticks[-1].number]


def test_people_read_the_verdict_first_then_loops_devices_and_log():
    message = told_of_losses(3)
    first, second, *rest = status_lines(message, lines(message))

    assert first == "fit-mock: not well"
    assert second.strip().startswith("! 3 records are missing from the log of this run")
    text = "\n".join(rest)
    assert "VERNIER for 2 min 13 s, controller minimum-variance" in text
    assert "unsent             nothing" in text
    for device in message.devices:
        assert device.endpoint in text
    assert message.recorder.path in text


def test_people_read_what_a_loop_waits_for():
    message = told(FakeSupervisor(loops=("right", "metrology", "left")))
    loops = [
        msgspec.structs.replace(loop, waits_for="metrology" if loop.name == "left" else "")
        for loop in message.loops
    ]
    rows = status_lines(msgspec.structs.replace(message, loops=loops), [])

    assert [row.split()[0] for row in rows if row.endswith(", waits for metrology")] == ["left"]


def test_people_read_of_the_queues_that_left_something_unsent():
    supervisor = FakeSupervisor()
    supervisor.ticks_unsent = 12

    (row,) = (row for row in status_lines(supervisor.message(), []) if row.startswith("  unsent"))

    assert row.split() == ["unsent", "12", "ticks"]


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (-1, "0 s"),
        (59.9, "59 s"),
        (3599, "59 min 59 s"),
        (7260, "2 h 1 min"),
        (90000, "1 d 1 h"),
    ],
)
def test_time_spans_read_in_their_two_largest_units(seconds, text):
    assert duration(seconds) == text


# ---------------------------------------------------------------- watch


def watched(monkeypatch, arrivals, duration_s=None, silent_s=0.0):
    """The entries of some messages; an arrival of None is silence, and `silent_s` goes by."""
    now_s = [0.0]
    monkeypatch.setattr(watch.time, "monotonic", lambda: now_s[0])
    coming = iter(arrivals)

    def receive(_timeout_s):
        message = next(coming)
        now_s[0] += silent_s if message is None else 0.05
        if isinstance(message, Exception):
            raise message
        return message

    made = watch.entries(receive, duration_s, lambda: "no telemetry; see fitctl run")
    try:
        yield from made
    except RuntimeError:  # the arrivals are over
        return


def test_a_second_has_the_rms_of_its_own_ticks(monkeypatch):
    messages = FakeSupervisor(error_px=0.05).messages(45)
    found = list(watched(monkeypatch, messages))

    seconds = [entry for entry in found if isinstance(entry, watch.Second)]
    assert len(seconds) == 2
    last_s = messages[0].time_s + 1.0
    of_first = [tick for message in messages for tick in message.ticks if tick.time_s <= last_s]
    rms_px = math.sqrt(sum(tick.error_el_px**2 for tick in of_first) / len(of_first))
    (loop,) = seconds[0].loops
    assert loop.rms_el_px == pytest.approx(rms_px)
    assert loop.ticks == len(of_first)


def test_every_frame_is_in_one_line_however_messages_are_spaced(monkeypatch):
    """Also those of the last, unfinished second."""
    messages = FakeSupervisor().messages(100)
    late = [
        msgspec.structs.replace(m, time_s=m.time_s + 0.03 * (i % 3)) for i, m in enumerate(messages)
    ]
    found = list(watched(monkeypatch, late, duration_s=4.88))

    ticks = [entry.loops[0].ticks for entry in found if isinstance(entry, watch.Second)]
    assert len(ticks) == 5
    assert sum(ticks) == sum(len(m.ticks) for m in late[:98])


def test_events_come_at_once_and_in_order(monkeypatch):
    message = FakeSupervisor().message()
    found = list(watched(monkeypatch, [message]))

    assert [entry.message for entry in found] == [event.message for event in message.events]


def test_silence_is_said_once_a_second_with_what_to_do(monkeypatch):
    found = list(watched(monkeypatch, [None] * 12, silent_s=0.25))

    assert len(found) == 3
    assert all("fitctl run" in entry.message for entry in found)


def test_what_cannot_be_read_is_said_in_the_place_of_silence(monkeypatch):
    unreadable = [ConnectionError("of another version")] * 25
    found = list(watched(monkeypatch, unreadable))

    assert found
    assert {entry.message for entry in found} == {"of another version"}


def test_it_ends_after_its_time(monkeypatch):
    forever = itertools.cycle(FakeSupervisor().messages(3))
    found = list(watched(monkeypatch, forever, duration_s=2.0))

    assert found


def test_a_supervisor_whose_clock_begins_anew_is_followed(monkeypatch):
    late = [
        msgspec.structs.replace(each, time_s=each.time_s + 1e5)
        for each in FakeSupervisor().messages(5)
    ]
    found = list(watched(monkeypatch, [*late, *FakeSupervisor().messages(45)]))

    assert sum(isinstance(entry, watch.Second) for entry in found) == 2


@pytest.mark.parametrize("mode", ["OFF", "ACQUISITION", "VERNIER"])
def test_a_line_of_text_says_what_the_mode_needs(monkeypatch, mode):
    supervisor = FakeSupervisor(mode)
    supervisor.interlocks = [TRIPPED]
    (second,) = (
        each
        for each in watched(monkeypatch, supervisor.messages(23))
        if isinstance(each, watch.Second)
    )
    line = watch._text(second)

    assert f"right {mode}" in line
    assert "tripped: flux_low" in line
    assert ("searched" in line) == (mode == "ACQUISITION")
    assert ("RMS az" in line) == (mode == "VERNIER")
    assert "nan" not in line


@pytest.mark.parametrize("mode", ["ACQUISITION", "LOCKED"])
def test_a_metrology_loop_has_its_ticks_and_its_beam_s_rms(monkeypatch, mode):
    supervisor = FakeSupervisor(mode, loops=("metrology",))
    messages = supervisor.messages(23)
    second = next(each for each in watched(monkeypatch, messages) if isinstance(each, watch.Second))
    (loop,) = second.loops
    last_s = messages[0].time_s + 1.0
    beams = [t for each in messages for t in each.metrology_ticks if t.time_s <= last_s]
    line = watch._text(second)

    assert loop.ticks == len(beams) > 0
    assert ("RMS az" in line and "arcsec" in line) == (mode == "LOCKED")
    assert ("searched" in line) == (mode == "ACQUISITION")
    assert "nan" not in line


def test_a_line_of_text_says_that_the_star_was_lost(monkeypatch):
    supervisor = FakeSupervisor("ACQUISITION")
    supervisor.search_again = STAR_LOST
    seconds = [
        each
        for each in watched(monkeypatch, supervisor.messages(23))
        if isinstance(each, watch.Second)
    ]

    assert "searched, star lost" in watch._text(seconds[0])


def test_a_line_of_text_says_which_command_failed(monkeypatch):
    supervisor = FakeSupervisor("OFF")
    supervisor.last_failure = LoopFailure(what="standby", time_s=999.0, text="no such port")
    seconds = [
        each
        for each in watched(monkeypatch, supervisor.messages(23))
        if isinstance(each, watch.Second)
    ]

    assert watch._text(seconds[0]).endswith("standby failed")


def test_each_line_of_json_says_what_it_is_of(monkeypatch):
    message = told(events=[Event(time_s=1000.0, severity="error", source="x", message="y")])
    lines = [
        json.loads(to_json(entry))
        for entry in watched(monkeypatch, [message, *FakeSupervisor().messages(25)])
    ]

    assert {line["kind"] for line in lines} == {"event", "second"}
    assert lines[0]["severity"] == "error"


@pytest.mark.parametrize("wall_s", [math.nan, math.inf, 1e300, -1e30])
def test_times_that_no_clock_can_have_are_left_out(wall_s):
    """A remote program may send any number."""
    message = told(wall_minus_monotonic_s=wall_s)
    assert utc(message, message.time_s) == ""
    assert status_document(message, [])["time"] == ""
    assert status_lines(message, [])


@pytest.mark.parametrize("since_s", [math.nan, -math.inf, -1e300])
def test_a_time_in_a_mode_that_cannot_be_is_no_error(since_s):
    message = told()
    loops = [msgspec.structs.replace(loop, since_s=since_s) for loop in message.loops]
    assert status_lines(told(loops=loops), [])


def test_a_second_without_a_tick_has_no_time_of_computing():
    timing = [msgspec.structs.replace(told().timing[0], ticks=0, compute_worst_s=math.nan)]
    (line,) = [line for line in status_lines(told(timing=timing), []) if "last second" in line]
    assert "nan" not in line
    assert "0 late, 0 stalls of the machine" in line


@pytest.mark.parametrize("time_s", [math.nan, 1e30])
def test_an_event_at_a_time_that_cannot_be_is_printed(capsys, time_s):
    event = Event(time_s=time_s, severity="info", source="right", message="here")
    assert print_reply(Reply(accepted=True, events=[event]), "send", as_json=False) == 0
    assert "at no time  info: right: here" in capsys.readouterr().out
