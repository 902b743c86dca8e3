"""The step `controller` with what was learnt: it waits for a design, and switches only to a better one."""

import msgspec
import pytest
from samples.learner_reports import SHAKEN, report
from sequence_runs import run_sequence

from fitctl.sequences.links import SimulatedLink
from fitctl.sequences.reading import sequence_from_document
from fitctl.sequences.view import SequenceError

ACQUIRE = {"step": "acquire"}
LEARNT = {"step": "controller", "name": "learnt", "timeout_s": 60.0}


class Told(SimulatedLink):
    """The simulated instrument, whose learner reports at a time."""

    def __init__(self, rig, at_s, made):
        super().__init__(rig, 1)
        self.at_s, self.made = at_s, made

    def receive(self, timeout_s):
        telemetry = super().receive(timeout_s)
        if self.made is not None and telemetry is not None and telemetry.time_s >= self.at_s:
            made, self.made = self.made, None
            assert self.send(made).accepted
        return telemetry


def run(tried, made, learn="advise"):
    """The attempt at the step, and the controller at its end."""
    rig = tried(*SHAKEN, f"loops.right.learn={learn}").rig
    link = Told(rig, 40.0, made)
    document = {"schema_version": 1, "name": "tried", "description": "Of a test."}
    sequence = sequence_from_document(document | {"steps": [ACQUIRE, LEARNT]}, "tried.toml")
    assert sequence.uses_what_is_learnt
    attempt = run_sequence(link, rig, sequence, lambda _: None)[-1]
    return attempt, link.receive(1.0).loops[0].controller


@pytest.mark.long
def test_it_waits_for_a_design_and_switches_to_it(tried):
    attempt, controller = run(tried, report())

    assert attempt.outcome == "done"
    assert attempt.ended_s > 40.0
    assert controller == "learnt"


@pytest.mark.long
def test_it_keeps_a_design_that_is_as_good(tried):
    attempt, controller = run(tried, report(worth_it=False))

    assert attempt.outcome == "done"
    assert "kept minimum-variance" in attempt.message
    assert msgspec.json.decode(attempt.figures_json) == {"learnt_px": 0.024}
    assert controller == "minimum-variance"


@pytest.mark.long
def test_without_a_design_it_times_out(tried):
    with pytest.raises(SequenceError, match="timed out: not done within 60 s"):
        run(tried, None)


def test_a_loop_that_does_not_learn_is_a_mistake_of_the_sequence(tried):
    run_on = tried(*SHAKEN, "loops.right.learn=off")
    run_on(ACQUIRE, LEARNT)

    assert 'loops.right.learn is "off"' in run_on.error


@pytest.mark.parametrize("advises", [True, False])
def test_only_a_sequence_that_uses_advice_has_it_computed(tried, advises):
    link = SimulatedLink(tried("loops.right.learn=advise").rig, 1, advises=advises)

    assert bool(link._simulation.learners) == advises
