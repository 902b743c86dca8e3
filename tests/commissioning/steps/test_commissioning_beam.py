"""What motions of the metrology beam make of the rig file: photodiodes' order, the hexapod's direction."""

import itertools
from types import SimpleNamespace

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
    check_collector,
    check_photodiodes,
    collector_moves,
)
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceFault, DiodeReading, HexapodReading, Pose
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


# ---------------------------------------------------------------- the hexapod
class BenchHexapod:
    """A hexapod over motors of a bench. While it moves, it reports `error`, or `interrupts` the step."""

    def __init__(self, now_s, bench, **wrong):
        self.now_s, self.bench = now_s, bench
        self.interrupts, self.keeps_moving, self.referenced = False, False, True
        self.error, self.servos_on = "", True
        self.velocities_mm_s, self.powered_at_stop = [], []
        self.at, self.arrives_s = Pose(), 0.0
        vars(self).update(wrong)

    def open(self):
        pass

    close = open

    def reference(self):
        raise KeyboardInterrupt

    def move_to(self, pose, velocity_mm_s):
        self.velocities_mm_s.append(velocity_mm_s)
        way_mm = float(np.linalg.norm(np.subtract(pose, self.at)))
        self.at, self.arrives_s = pose, self.now_s() + way_mm / velocity_mm_s

    def pose(self):
        moves = self.now_s() < self.arrives_s
        if moves and self.interrupts:
            raise KeyboardInterrupt
        error, servos_on = (self.error, self.servos_on) if moves else ("", True)
        return HexapodReading(self.now_s(), self.at, moves, self.referenced, servos_on, error)

    def stop(self):
        self.powered_at_stop.append(self.bench.powered)
        if self.keeps_moving:
            raise DeviceFault("hexapod", "nowhere", "all axes at rest", "a platform that moves", "")


def rig_with_hexapod_limit(velocity_mm_s):
    hexapod = RIG.collector.hexapod.model_copy(update={"velocity_limit_mm_s": velocity_mm_s})
    collector = RIG.collector.model_copy(update={"hexapod": hexapod})
    return RIG.model_copy(update={"collector": collector})


@pytest.fixture
def carried(monkeypatch):
    """Runs the step `collector` on a bench; gives the hexapod, and how the step ended."""

    def run(rig=RIG, **wrong):
        clock, looks = VirtualClock(), itertools.count()

        def now_s():
            return 0.05 * next(looks)

        bench = BenchAmplifiers(clock)
        diodes = BeamDiodes(bench, (0.0, 0.0), range(4))
        hexapod = BenchHexapod(now_s, bench, **wrong)
        monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
        monkeypatch.setattr(beam, "PHOTODIODES", {"labjack_t7": lambda _device: diodes})
        monkeypatch.setattr(beam, "HEXAPODS", {"c887": lambda _device: hexapod})
        monkeypatch.setattr(beam, "time", SimpleNamespace(monotonic=now_s))
        with pytest.raises((StepError, KeyboardInterrupt)) as caught:
            check_collector(site_of(rig, clock, "metrology"))
        assert not bench.powered
        return hexapod, caught.value

    return run


@pytest.mark.parametrize("limit_mm_s", [0.1, 8.0])
def test_the_hexapod_moves_no_faster_than_its_limit_and_is_given_the_time(carried, limit_mm_s):
    rig = rig_with_hexapod_limit(limit_mm_s)
    hexapod, ended = carried(rig)
    assert "does not move as it should" in str(ended)  # the beam of this bench stays where it is
    assert hexapod.velocities_mm_s == [min(1.0, limit_mm_s)] * 6
    assert f"at {min(1.0, limit_mm_s):g} mm/s" in collector_moves(site_of(rig, name="metrology"))


@pytest.mark.parametrize(
    ("wrong", "named"),
    [
        ({"error": "error 500, the emergency stop is pressed"}, "the emergency stop is pressed"),
        ({"servos_on": False}, "a servo is off"),
    ],
)
def test_what_the_hexapod_reports_on_its_way_ends_the_step(carried, wrong, named):
    hexapod, ended = carried(**wrong)
    assert named in str(ended)
    assert len(hexapod.velocities_mm_s) == 1


def test_an_interrupt_stops_the_hexapod_before_the_motors_lose_their_power(carried):
    hexapod, ended = carried(interrupts=True)
    assert isinstance(ended, KeyboardInterrupt)
    assert hexapod.powered_at_stop == [True]


def test_an_interrupt_stops_a_reference_move(carried):
    hexapod, ended = carried(referenced=False)
    assert isinstance(ended, KeyboardInterrupt)
    assert hexapod.powered_at_stop == [False]


@pytest.mark.parametrize(
    "wrong", [{"interrupts": True}, {"servos_on": False}, {"referenced": False}]
)
def test_a_hexapod_that_does_not_stop_is_named_with_its_emergency_stop(carried, wrong):
    _, ended = carried(keeps_moving=True, **wrong)
    assert str(ended).endswith(
        "a platform that moves; the hexapod may still move: press its emergency stop"
    )
