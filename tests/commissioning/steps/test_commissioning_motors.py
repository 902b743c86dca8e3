"""Motors with power: what is commanded before the encoders have been read, and how they lose power."""

import signal
from pathlib import Path

import pytest
from commissioning.motor_bench import BenchAmplifiers, rig_with_limit, site_of

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps import motors
from fitctl.commissioning.steps.motors import Servo, powered
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceFault, DeviceProtocolError, ServoReading

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

    def disable(self):
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


# ---------------------------------------------------------------- how they lose power
class Stubborn(BenchAmplifiers):
    """Amplifiers that fail to disable `kept` times, or, `out_of_step`, until they are opened again.

    The first `signals` attempts are interrupted.
    """

    def __init__(self, clock, kept=0, out_of_step=False, signals=0):
        super().__init__(clock)
        self.kept, self.out_of_step, self.signals = kept, out_of_step, signals
        self.opened = 0

    def open(self):
        self.opened += 1
        if self.opened > 1:
            self.out_of_step = False

    def disable(self):
        if self.signals:
            self.signals -= 1
            signal.raise_signal(signal.SIGINT)
        if self.out_of_step:
            raise DeviceProtocolError("amplifiers", "nowhere", "one of %!#$", "b'1'", "recover")
        if self.kept:
            self.kept -= 1
            raise DeviceFault(
                "amplifiers", "nowhere", "azimuth disabled", "not within 1 s", "cut it"
            )
        super().disable()

    def close(self):
        pass


@pytest.fixture
def stubborn(monkeypatch):
    """Makes such amplifiers and their site."""

    def make(**how):
        clock = VirtualClock()
        bench = Stubborn(clock, **how)
        monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
        return bench, site_of(clock=clock)

    return make


def end_of_step(site, step=lambda: None):
    """What ends a step with powered motors."""
    with pytest.raises((StepError, KeyboardInterrupt)) as caught, powered(site):
        step()
    return caught.value


def stops():
    raise StepError("a stop", {"furthest_rad": 1.0})


def interrupted():
    raise KeyboardInterrupt


def test_amplifiers_that_keep_power_fail_a_step_that_went_well(stubborn):
    _, site = stubborn(kept=10)
    assert str(end_of_step(site)) == (
        "amplifiers at nowhere: expected azimuth disabled, got not within 1 s; cut it; "
        "a motor may still have power: press the emergency stop"
    )


def test_amplifiers_that_keep_power_are_named_after_what_ended_the_step(stubborn):
    _, site = stubborn(kept=10)
    ended = end_of_step(site, stops)
    assert str(ended).startswith("a stop; amplifiers at nowhere: expected azimuth disabled")
    assert str(ended).endswith("press the emergency stop")
    assert ended.figures == {"furthest_rad": 1.0}


def test_after_an_interrupt_amplifiers_that_keep_power_are_named(stubborn):
    _, site = stubborn(kept=10)
    ended = end_of_step(site, interrupted)
    assert str(ended).startswith("amplifiers at nowhere: expected azimuth disabled")
    assert str(ended).endswith("press the emergency stop")


def test_a_line_out_of_step_after_an_interrupt_is_opened_anew_to_take_the_power(stubborn):
    bench, site = stubborn(out_of_step=True)
    assert isinstance(end_of_step(site, interrupted), KeyboardInterrupt)
    assert bench.opened == 2
    assert not bench.powered


def test_an_interrupt_while_the_motors_lose_power_does_not_end_that_and_is_not_lost(stubborn):
    bench, site = stubborn(signals=2)
    assert isinstance(end_of_step(site), KeyboardInterrupt)
    assert bench.signals == 0
    assert not bench.powered


def test_an_interrupt_while_a_failed_step_takes_the_power_does_not_end_that(stubborn):
    bench, site = stubborn(signals=1)
    assert str(end_of_step(site, stops)) == "a stop"
    assert bench.signals == 0
    assert not bench.powered
