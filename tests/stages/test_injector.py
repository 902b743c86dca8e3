"""An experiment's voltages: written while it runs, never before, after, or after a failure."""

import threading

import numpy as np
import pytest

from fitctl.clock import VirtualClock
from fitctl.model.drives import Drive
from fitctl.stages.injector import PERIOD_S, Injector

BIAS_V, FULL_SCALE_V = 5.0, 10.0
AT_BIAS_V, SLEW_V_PER_S = np.full(3, BIAS_V), 50.0
STACK_V_PER_PX = np.array([[0.1, 0.0], [0.0, 0.1], [-0.1, -0.1]])
STEP = Drive(
    channel="fsm_az", shape="square", amplitude=2.0, frequency_hz=0.1, duration_s=60.0, start_s=0.0
)
FAR = Drive(
    channel="fsm_az",
    shape="square",
    amplitude=900.0,
    frequency_hz=0.1,
    duration_s=60.0,
    start_s=0.0,
)


class RecordingDac:
    """Keeps what is written; `fails` is raised instead, `held` lets a write wait."""

    def __init__(self):
        self.written_v = []
        self.fails = None
        self.writing = threading.Event()
        self.held = threading.Event()
        self.held.set()

    def send_v(self, volts):
        self._sent_v = volts

    def confirm(self):
        self.writing.set()
        assert self.held.wait(10)
        if self.fails:
            raise self.fails
        self.written_v.append(self._sent_v)


@pytest.fixture
def dac():
    return RecordingDac()


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def injector(dac, clock):
    return Injector(dac, clock, STACK_V_PER_PX, BIAS_V, FULL_SCALE_V, SLEW_V_PER_S)


def periods(injector, clock, number):
    for _ in range(number):
        injector.period()
        clock.sleep_until(clock.now_s() + PERIOD_S)


def test_nothing_is_written_before_an_experiment(injector, clock, dac):
    periods(injector, clock, 3)
    assert dac.written_v == []


def test_each_period_writes_what_the_drives_ask_for_about_the_bias(injector, clock, dac):
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    periods(injector, clock, 3)
    asked_v = BIAS_V + STACK_V_PER_PX @ [2.0, 0.0]
    assert np.array(dac.written_v) == pytest.approx(np.array([asked_v] * 3))


def test_a_mirror_off_its_bias_goes_back_no_faster_than_its_slew_beneath_the_motions(
    injector, clock, dac
):
    injector.start([STEP], clock.now_s(), np.array([8.2, BIAS_V, 4.5]))
    periods(injector, clock, 20)

    off_v = np.array(dac.written_v) - (BIAS_V + STACK_V_PER_PX @ [2.0, 0.0])
    assert off_v[0] == pytest.approx([3.2, 0.0, -0.5])
    assert np.abs(np.diff(off_v, axis=0)).max() == pytest.approx(SLEW_V_PER_S * PERIOD_S)
    assert off_v[-1] == pytest.approx([0.0, 0.0, 0.0])


def test_what_was_written_is_given_once_with_its_times(injector, clock, dac):
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    periods(injector, clock, 3)

    injections = injector.drain_written()

    assert [one.time_s for one in injections] == pytest.approx([0.0, PERIOD_S, 2 * PERIOD_S])
    assert [list(one.stack_v) for one in injections] == [list(volts) for volts in dac.written_v]
    assert injector.drain_written() == []


def test_the_stacks_stay_within_the_range_of_the_d_a(injector, clock, dac):
    injector.start([FAR], clock.now_s(), AT_BIAS_V)
    periods(injector, clock, 1)
    assert list(dac.written_v[0]) == [FULL_SCALE_V, BIAS_V, 0.0]


def test_after_its_end_an_experiment_writes_nothing_more(injector, clock, dac):
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    periods(injector, clock, 2)
    injector.end()
    periods(injector, clock, 3)
    assert len(dac.written_v) == 2


def test_a_failure_ends_the_experiment_and_is_kept(injector, clock, dac):
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    dac.fails = OSError("the D/A is gone")
    periods(injector, clock, 1)
    dac.fails = None
    periods(injector, clock, 3)

    assert str(injector.fault) == "the D/A is gone"
    assert dac.written_v == []
    assert injector.drain_written() == []


def test_the_next_experiment_begins_without_what_an_earlier_one_left(injector, clock, dac):
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    periods(injector, clock, 2)
    dac.fails = OSError("the D/A is gone")
    periods(injector, clock, 1)
    dac.fails = None

    injector.start([FAR], clock.now_s(), AT_BIAS_V)
    assert injector.fault is None
    periods(injector, clock, 1)

    (only,) = injector.drain_written()
    assert only.stack_v[0] == FULL_SCALE_V


def test_the_end_waits_for_the_write_that_is_going_on(injector, clock, dac):
    dac.held.clear()
    injector.start([STEP], clock.now_s(), AT_BIAS_V)
    writing = threading.Thread(target=injector.period)
    writing.start()
    assert dac.writing.wait(10)
    ending = threading.Thread(target=injector.end)
    ending.start()

    ending.join(0.1)
    assert ending.is_alive()
    dac.held.set()
    ending.join(10)
    writing.join(10)
    assert not ending.is_alive()
    assert len(dac.written_v) == 1
