"""What is turned back at the door: garbage and too much, but never a stop."""

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.messages.commands import Reply, Status, Stop
from fitctl.service.intake import Accepted, Intake

STATUS, STOP = msgspec.msgpack.encode(Status()), msgspec.msgpack.encode(Stop())


@pytest.fixture
def intake():
    return Intake(commands_per_s=10.0)


@given(st.lists(st.floats(0.0, 0.5), max_size=200))
def test_no_more_come_in_than_the_rate_and_one_second_at_once(pauses_s):
    intake, now_s, taken = Intake(commands_per_s=10.0), 0.0, 0
    for pause_s in pauses_s:
        now_s += pause_s
        taken += intake.within_rate("anna", now_s)

    assert taken <= 10 * (now_s + 1) + 1e-6


def test_one_persons_flood_takes_nothing_from_another(intake):
    for _ in range(100):
        intake.within_rate("anna", 0.0)

    assert not intake.within_rate("anna", 0.0)
    assert intake.within_rate("bob", 0.0)


def test_a_stop_is_taken_even_when_it_is_one_too_many(intake):
    taken = [intake.accept("anna", STATUS, 0.0) for _ in range(11)]

    assert taken[:10] == [Accepted(Status(), over_rate=False)] * 10
    assert taken[10].text.startswith("more than 10 commands a second")
    assert intake.accept("anna", STOP, 0.0) == Accepted(Stop(), over_rate=True)


@given(st.binary(max_size=100))
def test_whatever_comes_is_taken_or_told_why_not(payload):
    taken = Intake(commands_per_s=10.0).accept("anna", payload, 0.0)

    assert isinstance(taken, Accepted) or (isinstance(taken, Reply) and not taken.accepted)


def test_what_was_turned_back_is_told_by_whose_it_was_and_not_too_often(intake):
    for _ in range(13):
        intake.accept("anna", STATUS, 0.0)
    intake.accept("bob", b"garbage", 0.0)

    assert intake.dropped(0.0) == [
        "anna: 3 messages, over the rate limit",
        "bob: 1 messages, no commands",
    ]
    intake.accept("bob", b"garbage", 1.0)
    assert intake.dropped(1.0) == []
    assert intake.dropped(10.0) == ["bob: 1 messages, no commands"]
