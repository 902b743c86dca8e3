"""What is turned back at the door: garbage and too much, but never a stop."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.logging.records import RecorderStatus
from fitctl.messages.command_table import COMMANDS
from fitctl.messages.commands import RecorderReport, Reply, Status, Stop
from fitctl.service.intake import Accepted, Intake, Limit

STATUS, STOP = msgspec.msgpack.encode(Status()), msgspec.msgpack.encode(Stop())


@pytest.fixture
def intake():
    return Intake(10.0, ["right"])


@given(st.lists(st.floats(0.0, 0.5), max_size=200))
def test_no_more_come_in_than_the_rate_and_one_second_at_once(pauses_s):
    limit, now_s, taken = Limit(10.0, 10.0), 0.0, 0
    for pause_s in pauses_s:
        now_s += pause_s
        taken += limit.within("anna", now_s)

    assert taken <= 10 * (now_s + 1) + 1e-6


def test_who_always_sends_a_little_too_much_gets_as_much_as_the_rate_allows():
    limit = Limit(10.0, 10.0)
    taken = [limit.within("anna", number / 12.0) for number in range(12 * 60)]

    assert sum(taken[12 * 30 :]) == pytest.approx(10 * 30, abs=2)


def test_one_persons_flood_takes_nothing_from_another():
    limit = Limit(10.0, 10.0)
    for _ in range(100):
        limit.within("anna", 0.0)

    assert not limit.within("anna", 0.0)
    assert limit.within("bob", 0.0)


def test_a_stop_is_taken_even_when_it_is_one_too_many(intake):
    taken = [intake.accept("anna", "commander", STATUS, 0.0) for _ in range(11)]

    assert taken[:10] == [Accepted(Status(), over_rate=False)] * 10
    assert taken[10].text.startswith("more than 10 commands a second")
    assert intake.accept("anna", "commander", STOP, 0.0) == Accepted(Stop(), over_rate=True)


def test_of_a_flood_of_stops_fifty_a_second_are_taken(intake):
    replies = [intake.accept("anna", "commander", STOP, now_s) for now_s in [0.0] * 1000 + [1.0]]

    assert [isinstance(reply, Accepted) for reply in replies] == [True] * 60 + [False] * 940 + [
        True
    ]
    assert isinstance(intake.accept("bob", "commander", STOP, 0.0), Accepted)


@pytest.mark.parametrize(
    ("role", "loop"), [("viewer", ""), ("viewer", "right"), ("commander", "no such loop")]
)
def test_a_stop_that_will_not_be_obeyed_is_limited_as_any_command(intake, role, loop):
    stop = msgspec.msgpack.encode(Stop(loop=loop))
    replies = [intake.accept("anna", role, stop, 0.0) for _ in range(12)]

    assert [isinstance(reply, Reply) for reply in replies] == [False] * 10 + [True] * 2


def test_refusals_beyond_a_limit_are_neither_answered_nor_logged_but_counted(intake):
    answered = sum(intake.answers_refusal("anna", 0.0) for _ in range(100))
    logged = sum(intake.logs_refusal("anna", 0.0) for _ in range(100))

    assert (answered, logged) == (20, 10)
    assert intake.dropped(0.0) == [
        "anna: 80 messages, refused without an answer",
        "anna: 90 messages, refused without a record of its own",
    ]


@given(st.binary(max_size=100))
def test_whatever_comes_is_taken_or_told_why_not(payload):
    taken = Intake(10.0, ["right"]).accept("anna", "commander", payload, 0.0)

    assert isinstance(taken, Accepted) or (isinstance(taken, Reply) and not taken.accepted)


def test_what_was_turned_back_is_told_by_whose_it_was_and_not_too_often(intake):
    for _ in range(13):
        intake.accept("anna", "commander", STATUS, 0.0)
    intake.accept("bob", "viewer", b"garbage", 0.0)

    assert intake.dropped(0.0) == [
        "anna: 3 messages, over the rate limit",
        "bob: 1 messages, no commands",
    ]
    intake.accept("bob", "viewer", b"garbage", 1.0)
    assert intake.dropped(1.0) == []
    assert intake.dropped(10.0) == ["bob: 1 messages, no commands"]


@pytest.mark.parametrize("row", [row for row in COMMANDS if row.of_rig], ids=lambda row: row.name)
def test_a_command_for_the_whole_rig_is_for_no_loop(intake, row):
    values = {"action": "start", "rate_hz": 48.0}
    command = {"type": row.name, "loop": "right"} | {name: values[name] for name in row.values}

    reply = intake.accept("anna", "commander", msgspec.msgpack.encode(command), 0.0)

    assert not reply.accepted
    assert reply.text == f"{row.name} is for the whole rig; expected no loop, got right"


def test_a_persons_commands_do_not_use_up_the_rate_of_their_programs_reports(intake):
    status = RecorderStatus(time_s=1.0, path="x.mcap", records=5, lost=0, bytes_written=9)
    report = msgspec.msgpack.encode(RecorderReport(status=status))
    for _ in range(100):
        intake.accept("anna", "commander", STATUS, 0.0)

    accepted = [intake.accept("anna", "commander", report, 0.0) for _ in range(11)]

    assert [isinstance(each, Accepted) for each in accepted] == [True] * 10 + [False]
