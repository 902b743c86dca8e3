"""Consoles and sequences of the swarm."""

from functools import partial
from typing import get_args

import msgspec
import pytest

from benchmarks.swarm import plan as plans
from benchmarks.swarm.clients import STEPS
from benchmarks.swarm.happenings import Cloud, FullDisk, RecorderDeath, Sequence
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.service import SwarmService
from fitctl.messages.commands import Acquire, Stop
from fitctl.messages.modes import Mode
from fitctl.sequences.contact import Contact
from fitctl.sequences.steps import AnyStep
from fitctl.tui.state import ConsoleState
from tests.benchmarks.plans import gives, plan


@pytest.mark.long
def test_a_sequence_runs_beside_operators_and_ends():
    happenings = [
        Sequence(at_s=0.1, who="ada", steps=["acquire", "offset", "hold", "off"]),
        gives(9.0, Stop(), "ben"),
        RecorderDeath(at_s=4.0),
        FullDisk(at_s=5.0, lasts_s=2.0),
    ]

    result = run_plan(plan(*happenings, duration_s=12.0))

    assert result.violations == []
    assert result.modes["SAFE"] >= 1
    assert {"VERNIER", "ACQUISITION"} <= result.modes.keys()


def test_the_steps_of_sequences_are_those_that_plans_draw():
    drawn = set(" ".join((*plans._STEPS, *plans._CALIBRATING, *plans._OF_TESTBED)).split())
    assert drawn == STEPS.keys()
    assert {type(make("right")) for make in STEPS.values()} == set(get_args(AnyStep))


def ends_of(monkeypatch, happenings, **plan_options):
    """How each sequence of a plan ended."""
    ends, end = [], Contact.end

    def noted(self, state, text=""):
        ends.append(f"{state}{': ' if text else ''}{text}")
        end(self, state, text)

    monkeypatch.setattr(Contact, "end", noted)
    assert run_plan(plan(*happenings, **plan_options)).violations == []
    return ends


BY_WORDS = {
    words: "fit-mock.toml" if words not in plans._OF_TESTBED else "fit-testbed.toml"
    for words in (*plans._STEPS, *plans._CALIBRATING, *plans._OF_TESTBED)
    if words != "overlap"  # the plant's fringe spots lie on each other from the beginning
}


@pytest.mark.long
@pytest.mark.parametrize("words", BY_WORDS)
def test_each_step_that_plans_draw_succeeds_on_a_healthy_rig(monkeypatch, words):
    sequences = [
        Sequence(at_s=0.2, who="ada", steps=["acquire"]),
        Sequence(at_s=50.0, who="ada", steps=words.split(), loop="right"),
    ]
    if words.endswith("dark"):
        sequences.append(Cloud(at_s=49.0, lasts_s=60.0, part=0.0))

    ends = ends_of(monkeypatch, sequences, rig=BY_WORDS[words], duration_s=110.0)

    assert ends == ["done", "done"]


@pytest.mark.long
@pytest.mark.parametrize("answers", [0, 2])
def test_an_answer_that_a_sequence_never_or_twice_receives_is_found(monkeypatch, answers):
    take = SwarmService._take_answer

    def wrong(self, tag, payload):
        of_sequence = not isinstance(self._sent[tag][2], partial)  # people's have a number
        for _ in range(answers if of_sequence else 1):
            take(self, tag, payload)

    monkeypatch.setattr(SwarmService, "_take_answer", wrong)
    happenings = [Sequence(at_s=1.0, who="ada", steps=["standby"])]

    found = run_plan(plan(*happenings, duration_s=8.0)).violations

    assert "a command is answered once" in {one.invariant for one in found}


@pytest.mark.long
def test_a_console_that_shows_another_mode_is_noticed(monkeypatch):
    accept = ConsoleState.accept

    def accept_late(self, message, now_s):
        for loop in message.loops:
            if loop.mode == Mode.ACQUISITION.name:
                message = msgspec.structs.replace(
                    message, loops=[msgspec.structs.replace(loop, mode="STANDBY")]
                )
        accept(self, message, now_s)

    monkeypatch.setattr(ConsoleState, "accept", accept_late)
    result = run_plan(plan(gives(0.1, None), gives(1.0, Acquire()), duration_s=2.0))

    assert "the console shows what is" in {one.invariant for one in result.violations}


@pytest.mark.long
@pytest.mark.parametrize("kind", ["ticks", "piezo", "timing", "events"])
def test_a_console_that_does_not_show_the_newest_of_a_kind_is_noticed(monkeypatch, kind):
    accept = ConsoleState.accept

    def forget(self, message, now_s):
        accept(self, msgspec.structs.replace(message, **{kind: getattr(message, kind)[:-1]}), now_s)

    monkeypatch.setattr(ConsoleState, "accept", forget)
    happens = [gives(at_s, None) for at_s in (0.1, 1.0, 2.0, 3.0)]
    (violation,) = run_plan(plan(*happens, duration_s=12.0)).violations

    assert violation.invariant == "the console shows what is"
