"""The step `stacks`: what the amplifier's readback says of order, gain, polarity and byte order."""

import signal

import numpy as np
import pytest
from commissioning.motor_bench import site_of

from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import stacks
from fitctl.commissioning.steps.stacks import STEP_V, check_stacks, opened

GAIN = 15.0


class BenchStacks:
    """A D/A and an amplifier between which `cables` (a matrix of gains) lead."""

    def __init__(
        self, cables=((1, 0, 0), (0, 1, 0), (0, 0, 1)), offsets_v=(0.0, 0.0, 0.0), swapped=False
    ):
        self.cables, self.offsets_v = GAIN * np.array(cables, float), np.array(offsets_v)
        self.swapped = swapped
        self.held_v = self.began_v = np.full(3, 5.0)
        self.furthest_v = 0.0

    def open(self):
        pass

    close = confirm = open

    def send_v(self, volts):
        self.held_v = volts
        self.furthest_v = max(self.furthest_v, *np.abs(volts - self.began_v))

    def read_v(self):
        return self.held_v

    def stack_volts(self):
        counts = np.rint(self.held_v / 10.0 * 65535).astype(int)
        given = ((counts & 0xFF) << 8 | counts >> 8) if self.swapped else counts
        return self.cables @ (given / 65535 * 10.0) + self.offsets_v


@pytest.fixture
def step(monkeypatch):
    def run(**wrong):
        bench = BenchStacks(**wrong)
        monkeypatch.setattr(stacks, "dac_of", lambda _settings: bench)
        monkeypatch.setattr(stacks, "piezo_of", lambda _settings: bench)
        try:
            return bench, check_stacks(site_of()), ""
        except StepError as error:
            return bench, None, str(error)

    return run


def test_stacks_that_follow_pass_and_are_left_where_they_were(step):
    bench, outcome, _ = step()
    assert outcome.state == "passed"
    assert bench.held_v == pytest.approx(bench.began_v)


@pytest.mark.parametrize("order", [(1, 0, 2), (0, 2, 1), (2, 0, 1), (1, 2, 0)])
def test_crossed_cables_become_an_order_of_channels(step, order):
    cables = np.zeros((3, 3))
    for channel, output in enumerate(order):
        cables[output, channel] = 1.0
    _, outcome, _ = step(cables=cables)
    channels = outcome.found["loops"]["right"]["fsm"]["dac"]["channels"]
    assert [order[channel - 1] for channel in channels] == [0, 1, 2]


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"cables": np.diag([1, 0, 1])}, "stack 2: check the cable"),
        ({"cables": np.diag([1, 1, 0.5])}, "stack 3"),
        ({"cables": np.diag([0.5, 0.5, 0.5])}, "dac.full_scale_v says 10"),
        ({"swapped": True}, "low byte"),
        ({"offsets_v": (20.0, 0.0, 0.0)}, "knob"),
        (
            {"cables": np.diag([-1, 1, 1]), "offsets_v": (150.0, 0.0, 0.0)},
            "stack 1: the output goes down",
        ),
        ({"cables": ((1, 0, 0), (0, 1, 0), (0, 1, 0))}, "two outputs followed|no output followed"),
        (
            {"cables": np.diag([1, 1, 0.6]), "offsets_v": (0, 0, 30.0)},
            "stack 3: the output follows",
        ),
    ],
)
def test_what_no_key_puts_right_is_named_after_a_small_step_at_most(step, wrong, named):
    bench, _, text = step(**wrong)
    assert any(one in text for one in named.split("|")), text
    assert bench.furthest_v <= STEP_V * 1.001


def end_of_way_back(monkeypatch, ending):
    """What ends a step that left the stacks 4 V from where they were, with a signal on their way back."""
    bench = BenchStacks()
    monkeypatch.setattr(stacks, "dac_of", lambda _settings: bench)
    monkeypatch.setattr(stacks, "piezo_of", lambda _settings: bench)
    send_v = bench.send_v

    def interrupt(volts):
        send_v(volts)
        monkeypatch.setattr(bench, "send_v", send_v)
        signal.raise_signal(signal.SIGINT)

    def step(moved):
        moved.set(bench.began_v + 4.0)
        monkeypatch.setattr(bench, "send_v", interrupt)
        if ending is not None:
            raise ending

    with pytest.raises((StepError, KeyboardInterrupt)) as caught, opened(site_of()) as moved:
        step(moved)
    return bench, caught.value


def test_an_interrupt_does_not_end_the_way_back_and_is_not_lost(monkeypatch):
    bench, ended = end_of_way_back(monkeypatch, None)
    assert isinstance(ended, KeyboardInterrupt)
    assert bench.held_v == pytest.approx(bench.began_v)


def test_an_interrupt_does_not_end_the_way_back_of_a_failed_step(monkeypatch):
    bench, ended = end_of_way_back(monkeypatch, StepError("a stop"))
    assert str(ended) == "a stop"
    assert bench.held_v == pytest.approx(bench.began_v)
