"""The step `amplifiers`: what each pulse says, and that a motor never turns further than stated."""

import pytest
from commissioning.motor_bench import RIG, BenchAmplifiers, site_of, step_on_bench

from fitctl.clock import VirtualClock
from fitctl.commissioning.steps import motors
from fitctl.commissioning.steps.amplifiers import BOUND_RAD, check_amplifiers


@pytest.fixture
def step(monkeypatch):
    return step_on_bench(monkeypatch, check_amplifiers)


def test_motors_that_do_as_commanded_pass(step):
    bench, outcome, _ = step()
    assert outcome.state == "passed"
    assert outcome.figures["azimuth_counted_per_commanded"] == pytest.approx(1.0, abs=0.02)
    assert bench.furthest_rad < BOUND_RAD
    assert not bench.powered


@pytest.mark.parametrize(("az", "el"), [(-1, 1), (1, -1), (-1, -1)])
def test_a_reversed_motor_or_encoder_becomes_a_sign_in_the_rig_file(step, az, el):
    for wrong in ("gains", "counts"):
        _, outcome, _ = step(**{wrong: ((az, 0), (0, el))})
        wiring = outcome.found["loops"]["right"]["siderostat"]["wiring"]
        assert wiring["velocity_signs"] == [az, el]
        assert wiring["axes"] == [0, 1]


@pytest.mark.parametrize(
    ("wiring", "named"),
    [
        ({"counts": ((0, 1), (1, 0))}, "exchanged"),
        ({"counts": ((1, 0), (0, 0))}, "elevation: no encoder counted"),
        ({"gains": ((0, 0), (0, 1))}, "azimuth: no encoder counted"),
        ({"counts": ((0.25, 0), (0, 0.25))}, "1000 counts a revolution"),
        ({"counts": ((4, 0), (0, 4))}, "16000 counts a revolution"),
        ({"gains": ((10, 0), (0, 10))}, "10 times as fast"),
        ({"counts": ((1, 0.5), (0, 1))}, "elevation: its pulse was counted by the other axis"),
        ({"runs_away_rad_s": 0.1}, "azimuth moved"),
    ],
)
def test_what_no_key_puts_right_is_named_before_a_motor_has_turned_far(step, wiring, named):
    bench, _, text = step(**wiring)
    assert named in text
    assert bench.furthest_rad < BOUND_RAD
    assert not bench.powered


def test_a_fault_of_an_amplifier_ends_the_step_with_power_off(step, monkeypatch):
    monkeypatch.setattr(
        BenchAmplifiers, "enable", lambda self: setattr(self, "fault", "azimuth: x")
    )
    bench, _, text = step()
    assert "azimuth: x" in text
    assert not bench.powered


def test_an_interrupt_takes_the_power_away(step, monkeypatch):
    def interrupted(self, _velocity):
        if self.powered:
            self.powered_at_interrupt = True
            monkeypatch.undo()
            raise KeyboardInterrupt

    clock = VirtualClock()
    bench = BenchAmplifiers(clock)
    monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
    monkeypatch.setattr(BenchAmplifiers, "exchange", interrupted)
    with pytest.raises(KeyboardInterrupt):
        check_amplifiers(site_of(RIG, clock))
    assert bench.powered_at_interrupt
    assert not bench.powered
