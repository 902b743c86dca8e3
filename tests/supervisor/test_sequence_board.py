"""Who may report a sequence, for how long, and what is made of it."""

import math

import msgspec
import pytest

from fitctl.clock import VirtualClock
from fitctl.logging.records import Event, SequenceAttempt
from fitctl.messages.commands import SequenceStatus
from fitctl.stages.journal import Journal
from fitctl.supervisor.sequence_board import SILENCE_S, SequenceBoard

FIRST = SequenceStatus(run="a", name="first", state="running", steps=3, step_number=1)
OTHER = SequenceStatus(run="b", name="other", state="running", steps=1)
ATTEMPT = SequenceAttempt(
    time_s=1.0, sequence_name="first", step_number=1, step="wait", loop="right", attempt=1, began_s=0.0,
    ended_s=1.0, outcome="done", message="", figures_json="{}",
)  # fmt: skip


class Board(SequenceBoard):
    def __init__(self):
        self.clock, self.records = VirtualClock(), []
        super().__init__(Journal(self.clock, self.records.append))

    def after(self, seconds):
        self.clock.sleep_until(self.clock.now_s() + seconds)


def test_a_second_sequence_is_refused_while_the_first_one_reports():
    board = Board()
    assert board.report(FIRST).accepted
    board.after(SILENCE_S)

    reply = board.report(OTHER)

    assert not reply.accepted
    assert "first is under way (step 1 of 3)" in reply.text
    assert board.status().name == "first"


def test_a_sequence_that_is_silent_has_lapsed():
    board = Board()
    board.report(FIRST)
    board.after(SILENCE_S + 0.1)

    assert board.status() is None
    assert not board.control("end").accepted
    assert board.report(OTHER).accepted
    assert not board.report(FIRST).accepted  # it is too late


def test_a_sequence_that_has_ended_makes_room_at_once():
    board = Board()
    board.report(FIRST)
    board.report(msgspec.structs.replace(FIRST, state="done"))

    assert not board.control("pause").accepted
    assert board.report(OTHER).accepted


def test_orders_stay_until_the_next_one_whatever_the_sequence_says():
    board = Board()
    board.report(FIRST)
    assert board.control("pause").accepted
    board.report(FIRST)
    assert board.status().wanted == "pause"
    board.control("resume")
    assert board.status().wanted == "run"
    board.control("end")
    assert not board.control("resume").accepted
    assert board.status().wanted == "end"
    board.report(msgspec.structs.replace(FIRST, state="stopped"))

    board.report(OTHER)

    assert board.status().wanted == "run"  # an order is not handed on


def test_each_attempt_is_recorded_once_and_beginning_and_end_are_events():
    board = Board()
    board.after(1.0)
    board.report(FIRST)
    with_attempt = msgspec.structs.replace(FIRST, last_attempt=ATTEMPT)
    board.report(with_attempt)
    board.report(with_attempt)
    board.report(msgspec.structs.replace(with_attempt, state="failed", message="no star"))

    assert [record for record in board.records if not isinstance(record, Event)] == [ATTEMPT]
    events = [(e.severity, e.message) for e in board.records if isinstance(e, Event)]
    assert events == [("info", "first begins, 3 steps"), ("warning", "first failed: no star")]


@pytest.mark.parametrize(
    "wrong",
    [
        {"steps": -1},
        {"step_number": 2**63},
        {"last_attempt": msgspec.structs.replace(ATTEMPT, time_s=math.nan)},
        {"last_attempt": msgspec.structs.replace(ATTEMPT, began_s=-1.0)},
        {"last_attempt": msgspec.structs.replace(ATTEMPT, ended_s=1e300)},
        {"last_attempt": msgspec.structs.replace(ATTEMPT, attempt=-3)},
    ],
)
def test_a_report_with_numbers_that_cannot_be_is_refused_and_shown_to_nobody(wrong):
    board = Board()
    board.after(1.0)

    reply = board.report(msgspec.structs.replace(FIRST, **wrong))

    assert not reply.accepted
    assert reply.text.startswith(
        "sequence first: expected numbers of steps, and times between 0 and"
    )
    assert board.status() is None
    assert board.records == []
