"""Motors with power: what is commanded before the encoders have been read."""

from pathlib import Path

import pytest
from commissioning.motor_bench import BenchAmplifiers, rig_with_limit, site_of

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps import motors
from fitctl.commissioning.steps.motors import Servo, powered
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import ServoReading

AT_RAD = (5.0, -3.0)


class LateAmplifiers:
    """Standing at `AT_RAD`; the first answers give no usable reading."""

    def __init__(self, clock, late):
        self._clock, self._late = clock, late
        self.commanded = []

    def open(self):
        self._clock.sleep_until(self._clock.now_s() + 1.0)

    def enable(self):
        pass

    def close(self):
        pass

    def exchange(self, velocity_rad_s):
        self.commanded.append(velocity_rad_s)
        self._late -= 1
        if self._late >= 0:
            return None
        return ServoReading(time_s=self._clock.now_s(), position_rad=AT_RAD, enabled=True, fault="")


def site_with(monkeypatch, late):
    clock = VirtualClock()
    amplifiers = LateAmplifiers(clock, late)
    monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: amplifiers)
    rig = load_rig(default_rig_path())
    site = Site(rig, "right", lambda _line: None, Path("rig.toml"), (), clock=clock)
    return site, amplifiers


def test_motors_are_held_where_they_are_though_the_first_readings_are_late(monkeypatch):
    site, amplifiers = site_with(monkeypatch, late=3)
    with powered(site) as held:
        servo = Servo(site, held)
        servo.hold()

    assert tuple(servo.goal_rad) == AT_RAD
    assert set(amplifiers.commanded) == {(0.0, 0.0)}


def test_motors_without_a_reading_are_not_commanded_to_move(monkeypatch):
    site, amplifiers = site_with(monkeypatch, late=10**6)
    with pytest.raises(StepError, match="no usable reading"), powered(site):
        pass

    assert set(amplifiers.commanded) == {(0.0, 0.0)}


def test_motors_turn_to_an_angle_no_faster_than_their_limit(monkeypatch):
    clock = VirtualClock()
    bench = BenchAmplifiers(clock)
    monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
    site = site_of(rig_with_limit(1.0), clock)
    with powered(site) as held:
        Servo(site, held).turn_to((6.0, 0.0))

    assert bench.motor_rad[0] == pytest.approx(6.0, abs=0.02)
    assert bench.fastest_rad_s == 1.0
