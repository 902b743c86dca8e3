"""Writes of the D/A between frames: each at its time, none too many, and none after a failure."""

import math

import numpy as np
import pytest

from fitctl.clock import VirtualClock
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceTimeout
from fitctl.stages.mirror import MirrorStage

COURSE = [np.array([1e-5 * step, 0.0]) for step in range(1, 5)]


class Dac:
    """Keeps what it was sent and when, and fails from `fails_at` writes on."""

    def __init__(self, clock):
        self.clock, self.written, self.fails_at = clock, [], math.inf

    def send_v(self, volts):
        self.sent_v = volts

    def confirm(self):
        if len(self.written) >= self.fails_at:
            raise DeviceTimeout("D/A", "here", "an answer", "none", "look")
        self.written.append((self.clock.now_s(), self.sent_v))


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def dac(clock):
    return Dac(clock)


@pytest.fixture
def mirror(clock, dac):
    rig = load_rig(default_rig_path(), ["loops.right.fsm.dac.writes_per_frame=5"])
    stage = MirrorStage(rig, "right", dac, clock)
    stage.start_from(np.full(3, 5.0))
    stage.move_later(COURSE, 0.004, 0.004, hysteresis_inverse=True)
    return stage


def test_each_is_written_when_it_is_due_and_the_next_time_is_known(mirror, clock, dac):
    assert mirror.write_due() == 0.004
    dues_s = []
    for _ in COURSE:
        clock.sleep_until(mirror.write_due())
        dues_s.append(mirror.write_due())

    assert [time_s for time_s, _ in dac.written] == pytest.approx([0.004, 0.008, 0.012, 0.016])
    assert dues_s == pytest.approx([0.008, 0.012, 0.016, math.inf])
    assert mirror.at(0.009) == pytest.approx(COURSE[1])
    assert mirror.at(0.0119) == pytest.approx(COURSE[1])


def test_after_a_stall_only_the_newest_is_written(mirror, clock, dac):
    clock.sleep_until(0.0125)
    assert mirror.write_due() == pytest.approx(0.016)

    assert len(dac.written) == 1
    assert mirror.now_rad == pytest.approx(COURSE[2])


def test_the_next_tick_forgets_what_was_still_to_come(mirror, clock, dac):
    mirror.drop_later()
    clock.sleep_until(1.0)

    assert mirror.write_due() == math.inf
    assert dac.written == []


def test_what_was_written_is_told_once_with_its_time(mirror, clock, dac):
    clock.sleep_until(0.004)
    mirror.write_due()
    (written,) = mirror.drain_injections()

    assert written.time_s == 0.004
    assert written.stack_v == pytest.approx(dac.written[0][1])
    assert mirror.drain_injections() == []


def test_a_failure_is_kept_for_the_next_tick_and_nothing_more_is_written(mirror, clock, dac):
    dac.fails_at = 1
    for time_s in (0.004, 0.008, 0.012):
        clock.sleep_until(time_s)
        due_s = mirror.write_due()

    assert due_s == math.inf
    assert isinstance(mirror.fault, DeviceTimeout)
    assert not mirror.ready
    assert len(dac.written) == 1
    assert mirror.now_rad == pytest.approx(COURSE[0])


def test_a_mirror_that_is_given_up_is_not_written(mirror, clock, dac):
    mirror.ready = False
    clock.sleep_until(0.004)
    mirror.write_due()

    assert dac.written == []
