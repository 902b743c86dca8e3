"""Sequences on the virtual clock, and somebody who meddles with them."""

import msgspec
import pytest
from instruments.simulated import SOON
from sequence_runs import run_sequence

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import SequenceReport
from fitctl.sequences.links import SimulatedLink
from fitctl.sequences.reading import sequence_from_document
from fitctl.sequences.view import SequenceError

# A star in the middle of the field is found at once.
NEAR = ("plant.loops.right.star_offset_sky_arcsec_max=5.0", SOON)


class MeddledLink(SimulatedLink):
    """The simulated instrument, with a second shell: `meddling` does something at some virtual times."""

    def __init__(self, rig, seed):
        super().__init__(rig, seed)
        self.meddling = []
        self.commands = []

    def send(self, command):
        if not isinstance(command, SequenceReport):
            self.commands.append(command)
        return super().send(command)

    def receive(self, timeout_s):
        telemetry = super().receive(timeout_s)
        while self.meddling and telemetry.time_s >= self.meddling[0][0]:
            _, what = self.meddling.pop(0)
            if callable(what):
                what(self)
            else:
                assert super().send(what).accepted
        return telemetry

    def mode(self):
        return super().receive(1.0).loops[0].mode

    def target_px(self):
        return self._simulation.supervisor.loops["right"].target_px.tolist()


class Run:
    """A sequence of some steps on a simulated rig; what came of it."""

    def __init__(self, rig, link):
        self.rig, self.link = rig, link
        self.attempts, self.states, self.error = [], [], ""

    def __call__(self, *steps):
        document = {"schema_version": 1, "name": "tried", "description": "Of a test."}
        sequence = sequence_from_document(document | {"steps": list(steps)}, "tried.toml")
        try:
            self.attempts = run_sequence(self.link, self.rig, sequence, self.hear)
        except SequenceError as error:
            self.error = str(error)
        return self.attempts

    def hear(self, status):
        if status.last_attempt is not None and status.last_attempt not in self.attempts:
            self.attempts.append(status.last_attempt)
        if self.states[-1:] != [status.state]:
            self.states.append(status.state)

    def figures(self, number=-1):
        return msgspec.json.decode(self.attempts[number].figures_json)

    def outcomes(self):
        return [attempt.outcome for attempt in self.attempts]


@pytest.fixture
def tried():
    """Make a run on a rig, its stars near, with some values replaced."""

    def make(*overrides, seed=1, rig="fit-mock.toml"):
        rig = load_rig(default_rig_path().parent / rig, [*NEAR, *overrides])
        return Run(rig, MeddledLink(rig, seed))

    return make
