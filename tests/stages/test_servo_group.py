"""Several servos on one thread: what one waits for does not slow the others."""

import pytest

from fitctl.clock import VirtualClock
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceIdentity, ServoReading
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.servo_group import ServoGroup

PERIOD_S = 0.002
SLICE_S = 0.0007  # of a wait, between two looks at what is due


class Bus:
    meanwhile = None

    def synchronize(self):
        pass


class Amplifiers:
    """Motors at rest; `waits_s` is how long each command waits for an answer of the drive."""

    def __init__(self, clock, bus):
        self.clock, self.bus = clock, bus
        self.waits_s = 0.0
        self.read_s = []

    def open(self):
        return DeviceIdentity("test", "motors", "", "")

    def enable(self):
        pass

    reset_fault = enable

    def stage(self, _velocity_rad_s):
        end_s = self.clock.now_s() + self.waits_s
        while self.clock.now_s() < end_s:
            self.clock.sleep_until(self.clock.now_s() + SLICE_S)
            if self.bus.meanwhile is not None:
                self.bus.meanwhile()

    def exchange(self, _velocity_rad_s):
        self.read_s.append(self.clock.now_s())
        return ServoReading(self.clock.now_s(), (0.0, 0.0), True, "")


@pytest.fixture
def clock():
    return VirtualClock()


@pytest.fixture
def group(clock):
    """Of three servos, whose devices are open."""
    loop = load_rig(default_rig_path()).loops["right"]
    bus = Bus()
    servos = [SiderostatServo(name, loop, Amplifiers(clock, bus), clock, 0.02) for name in "abc"]
    for servo in servos:
        servo.open()
    return ServoGroup([(servo, bus) for servo in servos], clock)


def test_servos_keep_their_pace_while_another_waits_for_its_drive(group, clock):
    group.servos[0]._amplifiers.waits_s = 0.5
    begin_s = clock.now_s()
    group.period()

    for servo in group.servos[1:]:
        read_s = [at_s for at_s in servo._amplifiers.read_s if at_s > begin_s]
        late_s = [at_s - begin_s - n * PERIOD_S for n, at_s in enumerate(read_s[:-1], 1)]
        assert len(late_s) == pytest.approx(0.5 / PERIOD_S, abs=1)
        assert max(late_s) < 1.01 * SLICE_S


def test_a_drive_in_fault_is_commanded_but_not_waited_for(group):
    group.servos[0].fault = RuntimeError("the drive is silent")
    for servo in group.servos:
        servo._amplifiers.read_s.clear()
    group.period()

    assert [len(servo._amplifiers.read_s) for servo in group.servos] == [0, 1, 1]
