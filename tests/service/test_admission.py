"""Who may command: one person at a time, stops aside."""

import pytest

from fitctl.logging.records import RecorderStatus
from fitctl.messages.command_table import ROWS
from fitctl.messages.commands import (
    Acquire,
    RecentEvents,
    RecorderReport,
    Release,
    SequenceControl,
    Status,
    Stop,
    TakeOver,
)
from fitctl.service.admission import Admission, Sender

ANNA = Sender("anna", "10.0.0.1", "commander", is_local=False)
OWNER = Sender("owner@here", "process 7", "commander", is_local=True)
BOB = Sender("bob", "10.0.0.2", "viewer", is_local=False)
LEASE_S = 30.0
NOTHING = RecorderStatus(time_s=0.0, path="", records=0, lost=0, bytes_written=0)


@pytest.fixture
def admission():
    return Admission(LEASE_S)


def test_the_first_who_commands_has_the_instrument(admission):
    assert admission.commander(0.0) == ""
    assert admission.refusal(ANNA, Acquire(), 1.0) == ""
    assert admission.commander(1.0) == "anna"


def test_another_is_refused_and_told_who_has_it_and_what_to_do(admission):
    admission.refusal(ANNA, Acquire(), 0.0)

    assert admission.refusal(OWNER, Release(), 1.0).startswith("anna has the instrument")
    assert "take-over" in admission.refusal(OWNER, Release(), 1.0)
    assert admission.commander(1.0) == "anna"


def test_the_same_person_may_command_from_several_places(admission):
    admission.refusal(OWNER, Acquire(), 0.0)

    assert admission.refusal(OWNER._replace(address="process 8"), Release(), 1.0) == ""


def test_who_takes_over_has_it(admission):
    admission.refusal(ANNA, Acquire(), 0.0)

    assert admission.refusal(OWNER, TakeOver(), 1.0) == ""
    assert admission.commander(1.0) == "owner@here"
    assert "owner@here has the instrument" in admission.refusal(ANNA, Release(), 2.0)


@pytest.mark.parametrize(
    ("command", "after"), [(Status(), "owner@here"), (RecorderReport(status=NOTHING), "")]
)
def test_what_people_send_keeps_the_lease_and_what_processes_report_does_not(
    admission, command, after
):
    admission.refusal(OWNER, Acquire(), 0.0)
    for now_s in range(2 * round(LEASE_S)):
        assert admission.refusal(OWNER, command, float(now_s)) == ""

    assert admission.commander(2 * LEASE_S) == after


@pytest.mark.parametrize("command", [Stop(), SequenceControl(action="pause"), Status()])
def test_some_things_need_no_lease_and_take_none(admission, command):
    admission.refusal(ANNA, Acquire(), 0.0)

    assert admission.refusal(OWNER, command, 1.0) == ""
    assert admission.commander(1.0) == "anna"


def test_the_lease_lapses_when_its_holder_is_silent(admission):
    admission.refusal(ANNA, Acquire(), 0.0)
    admission.refusal(OWNER, Status(), LEASE_S)  # another's word is not the holder's

    assert admission.commander(LEASE_S + 0.1) == ""
    assert admission.refusal(OWNER, Release(), LEASE_S + 0.1) == ""


def test_an_open_console_keeps_the_lease(admission):
    admission.refusal(ANNA, Acquire(), 0.0)
    for now_s in range(0, 200, 20):
        admission.refusal(ANNA, Status(), float(now_s))

    assert admission.commander(200.0) == "anna"


def test_a_status_revives_no_lease_that_has_lapsed(admission):
    admission.refusal(ANNA, Acquire(), 0.0)
    admission.refusal(ANNA, Status(), 100.0)

    assert admission.commander(100.0) == ""


@pytest.mark.parametrize("row", ROWS.values(), ids=lambda row: row.name)
def test_a_viewer_may_ask_for_the_status_and_past_events_and_nothing_else(admission, row):
    refusal = admission.refusal(BOB, _example(row), 0.0)

    assert (refusal == "") == (row.make in {Status, RecentEvents})
    assert admission.commander(0.0) == ""


@pytest.mark.parametrize("row", ROWS.values(), ids=lambda row: row.name)
def test_only_the_rigs_own_machine_speaks_for_its_recorder(admission, row):
    refusal = admission.refusal(ANNA, _example(row), 0.0)

    assert (refusal == "") == (row.needs != "the Unix socket")


def test_a_revoked_holder_has_it_no_more(admission):
    admission.refusal(ANNA, Acquire(), 0.0)

    admission.release("bob")
    assert admission.commander(0.0) == "anna"
    admission.release("anna")
    assert admission.commander(0.0) == ""


def _example(row):
    """A command without its values: who may give it does not depend on them."""
    return row.make(**dict.fromkeys(row.values))
