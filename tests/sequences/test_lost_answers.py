"""Commands that are not answered, and reports that are refused: what the sequence still stops."""

import pytest
from sequence_runs import REFERENCE, SINE, WAIT, lose

from fitctl.messages.commands import (
    MoveCollector,
    Release,
    Reply,
    SequenceControl,
    SequenceReport,
    SequenceStatus,
)

NOWHERE = "plant.loops.right.star_offset_sky_arcsec_max=5000.0"
TOO_MANY = Reply(accepted=False, text="more than 50 commands a second; wait, then try again")


def refuse_reports(link, from_s, to_s):
    """The supervisor refuses reports for some time, as it does if commands exceed their rate."""
    send = link.send

    def sends(command):
        if isinstance(command, SequenceReport) and from_s <= link.now_s() < to_s:
            return TOO_MANY
        return send(command)

    link.send = sends


def is_start(command):
    return isinstance(command, MoveCollector) and command.action == "start"


def is_stop(command):
    return isinstance(command, MoveCollector) and command.action == "stop"


def collector_moves(link):
    for _ in range(20):
        telemetry = link.receive(0.5)
    return bool(telemetry.collector.motion)


@pytest.mark.long
def test_a_motion_whose_start_is_not_answered_is_stopped(tried):
    run = tried(rig="fit-testbed.toml")
    lose(run.link, is_start, obeyed=True)

    with pytest.raises(ConnectionError):
        run(REFERENCE, SINE, WAIT)

    assert not collector_moves(run.link)


@pytest.mark.long
def test_a_stop_of_the_collector_that_is_not_answered_is_sent_once_more(tried):
    run = tried(rig="fit-testbed.toml")
    lose(run.link, is_stop)

    run(REFERENCE, SINE, WAIT)

    assert run.outcomes() == ["done"] * 3
    assert not collector_moves(run.link)


def test_each_loop_is_released_even_if_the_release_of_another_is_not_answered(tried):
    run = tried(rig="fit-testbed.toml")
    run.link.meddling = [(5.0, SequenceControl(action="end"))]
    lose(run.link, lambda command: isinstance(command, Release))

    run(
        *({"step": "standby", "loop": name} for name in ("left", "right")),
        {**WAIT, "duration_s": 60.0},
    )

    released = [command.loop for command in run.link.commands if isinstance(command, Release)]
    assert released == ["right"]  # the other one was lost on the way


def test_a_step_that_loses_an_answer_ends_its_search(tried):
    run = tried(NOWHERE)
    lose(run.link, lambda command: isinstance(command, SequenceReport) and run.link.now_s() > 2.0)

    with pytest.raises(ConnectionError):
        run({"step": "acquire"})

    assert run.link.mode() == "STANDBY"
    assert run.link.now_s() < 4.0  # long before the search is exhausted


def test_a_sequence_that_another_has_replaced_leaves_the_loops_to_that_one(tried):
    def other_begins(link):
        link._simulation.run(4.0)  # the first sequence is silent
        other = SequenceStatus(run="b", name="other", state="running", steps=1)
        assert link.send(SequenceReport(status=other)).accepted

    run = tried(NOWHERE)
    run.link.meddling = [(1.5, other_begins)]

    with pytest.raises(ConnectionError, match="sequence other is under way"):
        run({"step": "acquire"})

    assert run.link.mode() == "ACQUISITION"


def test_reports_that_are_refused_for_a_moment_do_not_end_the_sequence(tried):
    run = tried()
    refuse_reports(run.link, 2.0, 4.0)

    run({"step": "wait", "duration_s": 6.0})

    assert (run.outcomes(), run.error) == (["done"], "")
    assert run.link.receive(1.0).running_sequence.state == "done"


def test_a_sequence_ends_if_its_reports_are_refused_for_so_long_that_another_may_begin(tried):
    run = tried()
    refuse_reports(run.link, 2.0, 60.0)

    with pytest.raises(
        ConnectionError, match="no longer knows this sequence: more than 50 commands"
    ):
        run({"step": "wait", "duration_s": 30.0})

    assert run.link.now_s() < 7.0
