"""The learner beside a running instrument: it learns from telemetry, and may die."""

import os
import signal

import pytest

from fitctl.learn.process import NICENESS

from .conftest import NEAR, running

LEARNS = "loops.right.learn=on"
FIRST_REPORT_S = 130.0  # a minute of undisturbed frames, estimate and design, on a busy machine

pytestmark = pytest.mark.timeout(
    FIRST_REPORT_S + 60.0
)  # so that a late report is told with its events


@pytest.fixture
def rig(tmp_path):
    with running(tmp_path, NEAR, LEARNS) as rig:
        rig.to_vernier()
        yield rig


def test_a_learner_that_is_killed_is_started_again_and_the_loop_changes_over(rig):
    first = rig.child("learner")
    assert first.nice() == NICENESS
    os.kill(first.pid, signal.SIGKILL)
    messages = rig.follow(
        lambda telemetry: any("a design learnt from" in each.message for each in telemetry.events),
        FIRST_REPORT_S,
    )
    events = [event.message for message in messages for event in message.events]

    assert any("the learner was killed by signal 9" in text for text in events)
    assert rig.child("learner").pid != first.pid
    assert {message.loops[0].mode for message in messages} == {"VERNIER"}
    # The state of a message is no older than its events; it may be newer.
    assert messages[-1].loops[0].controller == "learnt"
