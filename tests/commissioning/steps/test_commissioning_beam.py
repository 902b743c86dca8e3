"""What motions of the metrology beam make of the rig file: photodiodes' order, the hexapod's direction."""

import itertools

import numpy as np
import pytest
from commissioning.motor_bench import BenchAmplifiers, site_of
from hypothesis import given
from hypothesis import strategies as st

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import StepError
from fitctl.commissioning.steps import beam, motors
from fitctl.commissioning.steps.beam import (
    _collector_outcome,
    _photodiodes_outcome,
    check_photodiodes,
)
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DiodeReading
from fitctl.model.metrology.geometry import transverse_axes
from fitctl.model.optics import rotation

RIG = load_rig(default_rig_path().with_name("fit-testbed.toml"))
OFFSET_M = RIG.metrology_loops["metrology"].sensor.diode_offset_m
CORNERS_M = OFFSET_M * np.array([[1, 0], [-1, 0], [0, 1], [0, -1]])
LIGHTS_V = np.full(4, 5.0)
SITE = site_of(RIG, name="metrology")


@given(
    st.sampled_from(list(itertools.permutations(range(4)))),
    st.lists(st.floats(-0.2, 0.2), min_size=8, max_size=8),
)
def test_photodiodes_on_other_inputs_get_theirs_in_the_rig_file(order, noise):
    """`order[n]` is the input that has the n-th photodiode."""
    places_m = np.empty((4, 2))
    places_m[list(order)] = CORNERS_M
    outcome = _photodiodes_outcome(SITE, places_m + OFFSET_M * np.reshape(noise, (4, 2)), LIGHTS_V)
    if order == (0, 1, 2, 3):
        assert outcome.state == "passed"
    else:
        device = outcome.found["loops"]["metrology"]["sensor"]["device"]
        assert device["inputs"] == list(order)


def test_photodiodes_that_are_no_four_corners_are_named():
    places_m = CORNERS_M.copy()
    places_m[2] = places_m[0]
    with pytest.raises(StepError, match="check that all four"):
        _photodiodes_outcome(SITE, places_m, LIGHTS_V)


@given(st.floats(-170.0, 170.0), st.floats(0.85, 1.15))
def test_a_turned_hexapod_gets_its_link_azimuth(turned_deg, scale):
    """With the azimuth that was found, a motion along it is one along the photodiodes' azimuth."""
    seen = scale * rotation(turned_deg)
    outcome = _collector_outcome(RIG.collector, seen)
    if abs(turned_deg) <= 4.9:
        assert outcome.state == "passed"
    if abs(turned_deg) <= 5.1:
        return
    azimuth = outcome.found["collector"]["geometry"]["link_azimuth"]
    along = transverse_axes(RIG.collector.geometry) @ azimuth
    assert seen @ along == pytest.approx([scale, 0.0], abs=1e-6)


@pytest.mark.parametrize("seen", [np.diag([1.0, -1.0]), np.zeros((2, 2)), 3.0 * np.eye(2)])
def test_a_hexapod_that_moves_the_beam_otherwise_is_named(seen):
    with pytest.raises(StepError, match="hexapod"):
        _collector_outcome(RIG.collector, seen)


class BeamDiodes:
    """A Gaussian beam on four photodiodes, moved by a bench's motors; `order` is how they are connected."""

    def __init__(self, bench, start_m, order, light=1.0):
        self.bench, self.start_m, self.order = bench, np.array(start_m), order
        self.light = np.array(light)
        self.sensor = RIG.metrology_loops["metrology"].sensor
        self.m_per_rad = (
            self.sensor.link_length_m * RIG.loops["metrology"].siderostat.sky_rad_per_motor_rad
        )

    def open(self):
        pass

    def close(self):
        pass

    def send_request(self):
        pass

    def receive(self):
        self.bench.clock.sleep_until(self.bench.clock.now_s() + 1e-3)
        at_m = self.start_m + self.m_per_rad * self.bench.motor_rad
        apart_m = np.linalg.norm(CORNERS_M - at_m, axis=1)
        on_a_diode = self.sensor.on_axis_v * np.exp(2 * (OFFSET_M / self.sensor.beam_radius_m) ** 2)
        lights = self.light * on_a_diode * np.exp(-2 * (apart_m / self.sensor.beam_radius_m) ** 2)
        volts = np.empty(4)
        volts[list(self.order)] = lights
        return DiodeReading(self.bench.clock.now_s(), tuple(volts + self.sensor.ambient_v))


@pytest.fixture
def step(monkeypatch):
    def run(start_m, order=(0, 1, 2, 3), light=1.0):
        clock = VirtualClock()
        bench = BenchAmplifiers(clock)
        monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
        diodes = BeamDiodes(bench, start_m, order, light)
        monkeypatch.setattr(beam, "PHOTODIODES", {"labjack_t7": lambda _device: diodes})
        return bench, check_photodiodes(site_of(RIG, clock, "metrology"))

    return run


@pytest.mark.long
@pytest.mark.parametrize("start_m", [(0.0, 0.0), (0.03, -0.02), (-0.03, 0.03)])
@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (1, 2, 3, 0)])
def test_the_beam_is_brought_to_the_middle_and_each_photodiode_is_found(step, start_m, order):
    bench, outcome = step(start_m, order)
    device = outcome.found.get("loops", {}).get("metrology", {}).get("sensor", {}).get("device", {})
    assert device.get("inputs", [0, 1, 2, 3]) == list(order)
    assert outcome.figures["offset_over_expected"] == pytest.approx(1.0, abs=0.02)
    assert not bench.powered


def test_without_light_the_step_ends(step):
    with pytest.raises(StepError, match="no photodiode has light"):
        step((0.0, 0.0), light=0.0)


@pytest.mark.long
def test_a_photodiode_without_light_is_named(step):
    with pytest.raises(StepError, match="AIN3: no light"):
        step((0.01, 0.02), light=(1.0, 1.0, 1.0, 0.0))
