"""Three loops and a moving collector on the virtual clock, and what a run of them gives."""

import json
import math
import subprocess
import sys

import numpy as np
import pytest

from fitctl.config import ARCSEC_PER_RAD, ConfigError, default_rig_path, load_rig
from fitctl.controllers.visibility import visibility
from fitctl.drivers.interface import DeviceRefused, Pose
from fitctl.model.metrology.fringes import mean_visibility
from fitctl.simulation.simulation import Simulation, simulate_rig

pytestmark = pytest.mark.long

TESTBED = default_rig_path().parent / "fit-testbed.toml"
EARLY = ["collector.motion.kind=sine", "collector.motion.start_s=25.0"]


@pytest.fixture(scope="module")
def result():
    return simulate_rig(load_rig(TESTBED, EARLY), seed=1, duration_s=50.0)


def test_all_three_loops_hold_while_the_collector_moves(result):
    stars = {name: result.loops[name] for name in ("right", "left")}
    for star in stars.values():
        assert star.vernier_s < 25.0
        # What a rig of one loop shows with Eq. 20, with its scatter over 25 s.
        assert max(star.rms_px.values()) < 0.03
        assert star.judged_s == pytest.approx(25.0, abs=0.1)
    beam = result.loops["metrology"]
    assert beam.acquired_s < beam.locked_s < 10.0
    assert max(beam.rms_arcsec.values()) < 1.0
    assert beam.samples == pytest.approx(2500, abs=25)
    assert result.visibility == pytest.approx(0.985, abs=0.01)


def test_without_feedforward_the_left_star_is_lost_to_the_mirrors_reach(result):
    rig = load_rig(TESTBED, [*EARLY, "loops.left.feedforward.gain=0.0"])
    without = simulate_rig(rig, seed=1, duration_s=50.0)
    assert max(without.loops["left"].rms_px.values()) > 5 * max(
        result.loops["left"].rms_px.values()
    )
    assert without.loops["right"].rms_px == pytest.approx(result.loops["right"].rms_px, rel=0.02)
    assert without.visibility < result.visibility


def test_the_command_prints_loops_by_name_beside_what_they_have_in_common():
    done = subprocess.run(
        [sys.executable, "-m", "fitctl", "simulate", "--rig", str(TESTBED), "--duration", "20",
         "--json", "--set", "collector.motion.kind=still"],
        capture_output=True, text=True, check=False, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    printed = json.loads(done.stdout.splitlines()[-1])
    assert set(printed) == {"loops", "visibility", "speed_x"}
    assert list(printed["loops"]) == ["right", "metrology", "left"]
    assert set(printed["loops"]["left"]["rms_px"]) == {"az", "el"}
    assert set(printed["loops"]["metrology"]["rms_arcsec"]) == {"az", "el"}


def test_a_collector_that_is_to_move_beyond_its_travel_is_bad_input():
    """From zero: elsewhere it would have room, so that the rig file's check allows it."""
    too_far = ["collector.motion.kind=sine", "collector.motion.amplitude_mm=30.0"]
    too_far += [f"collector.hexapod.travel.{axis}=[-20.0,50.0]" for axis in ("x_mm", "y_mm")]
    slowly = ["collector.motion.frequency_hz=0.01", "collector.motion.start_s=0.5"]

    with pytest.raises(ConfigError, match=r"collector.motion: .* within -20 and 50"):
        simulate_rig(load_rig(TESTBED, [*too_far, *slowly]), 0, 3.0)


def test_a_seed_is_a_run():
    def course(seed):
        simulation = Simulation(load_rig(TESTBED, ["collector.motion.kind=random"]), seed)
        simulation.acquire()
        simulation.run(1.0)
        simulation.move_collector()
        simulation.run(2.0)
        part = simulation.plant.metrology_loops["metrology"]
        return part.history_offset_m(0.0, 3.0)

    first, again, other = course(3), course(3), course(4)
    assert np.array_equal(first, again)
    assert not np.allclose(first, other)


# ---------------------------------------------------------------- simulated devices


@pytest.fixture
def simulation():
    return Simulation(load_rig(TESTBED), 1)


def go_on(simulation, duration_s):
    simulation.clock.sleep_until(simulation.clock.now_s() + duration_s)


def test_a_sample_comes_after_the_links_round_trip_and_is_of_its_middle(simulation):
    photodiodes = simulation.devices.loops["metrology"].photodiodes
    photodiodes.open()
    go_on(simulation, 0.1)
    photodiodes.send_request()
    go_on(simulation, 0.0299)
    assert photodiodes.receive() is None
    go_on(simulation, 0.0002)
    assert photodiodes.receive().time_s == pytest.approx(0.115)
    assert photodiodes.receive() is None, "each sample comes once"


def test_of_two_samples_that_have_arrived_the_newest_counts(simulation):
    photodiodes = simulation.devices.loops["metrology"].photodiodes
    photodiodes.open()
    for _ in range(2):
        photodiodes.send_request()
        go_on(simulation, 0.02)
    go_on(simulation, 0.05)
    assert photodiodes.receive().time_s == pytest.approx(0.035)
    assert photodiodes.receive() is None


def test_samples_have_the_noise_of_the_plant_and_the_steps_of_the_converter(simulation):
    photodiodes = simulation.devices.loops["metrology"].photodiodes
    part = simulation.plant.metrology_loops["metrology"]
    part.inputs.laser[:] = 0.0  # or the beam's motion would be in the scatter
    photodiodes.open()
    samples = []
    for _ in range(400):
        photodiodes.send_request()
        go_on(simulation, 0.04)
        samples.append(photodiodes.receive().volts)
    assert np.std(samples, axis=0) == pytest.approx(part.sensor.noise_v, rel=0.15)
    assert np.mean(samples, axis=0) == pytest.approx(part.sensor.ambient_v, abs=3e-4)
    steps = np.array(samples) / (20.0 / 2**16)
    assert steps == pytest.approx(np.rint(steps), abs=1e-6)


def test_the_hexapod_goes_nowhere_before_it_is_referenced_or_beyond_its_travel():
    rig = load_rig(TESTBED)
    hexapod = Simulation(rig.model_copy(update={"fringes": None}), 1).hexapod
    with pytest.raises(DeviceRefused, match="a referenced hexapod"):
        hexapod.move_to(Pose(y_mm=1.0), 8.0)
    hexapod.reference()
    hexapod.move_to(Pose(y_mm=1.0), 8.0)
    with pytest.raises(DeviceRefused, match=r"expected y_mm within -50 and 50, got 51"):
        hexapod.move_to(Pose(y_mm=51.0), 8.0)


def test_a_reference_move_leads_a_hexapod_back_to_zero(simulation):
    simulation.hexapod.reference()
    simulation.hexapod.move_to(Pose(y_mm=4.0), 8.0)
    go_on(simulation, 2.0)
    simulation.hexapod.reference()
    assert simulation.hexapod.pose().moving
    go_on(simulation, 2.0)
    reading = simulation.hexapod.pose()
    assert (reading.moving, reading.pose.y_mm) == (False, pytest.approx(0.0, abs=1e-9))


def test_a_hexapod_that_is_stopped_brakes(simulation):
    simulation.hexapod.reference()
    simulation.hexapod.move_to(Pose(y_mm=40.0), 8.0)
    go_on(simulation, 1.0)
    simulation.hexapod.stop()
    assert simulation.hexapod.pose().moving
    go_on(simulation, 0.5)
    reading = simulation.hexapod.pose()
    assert not reading.moving
    # 8 mm/s, reached and left with 20 mm/s2: 1.6 mm each, and 0.6 s between.
    assert reading.pose.y_mm == pytest.approx(1.6 + 0.6 * 8.0 + 1.6, abs=1e-6)


def test_a_hexapod_that_is_stopped_in_its_reference_move_is_not_referenced(simulation):
    simulation.hexapod.reference()
    simulation.hexapod.move_to(Pose(y_mm=4.0), 8.0)
    go_on(simulation, 2.0)
    simulation.hexapod.reference()
    simulation.hexapod.stop()
    assert not simulation.hexapod.pose().referenced
    simulation.hexapod.reference()
    go_on(simulation, 2.0)
    simulation.hexapod.stop()
    assert simulation.hexapod.pose().referenced


# ---------------------------------------------------------------- figure of merit


def test_the_mean_visibility_is_that_of_the_live_loops_formula():
    fringes = load_rig(TESTBED).fringes
    tilts = np.random.default_rng(1).normal(0.0, 0.5 / ARCSEC_PER_RAD, (50, 2))
    each = [
        visibility(math.hypot(*tilt), fringes.aperture_m, fringes.wavelength_m)
        for tilt in tilts.tolist()
    ]
    assert mean_visibility(tilts, fringes) == pytest.approx(np.mean(each), abs=1e-7)
    assert mean_visibility(np.zeros((3, 2)), fringes) == pytest.approx(1.0)
    assert math.isnan(mean_visibility(np.empty((0, 2)), fringes))
    quarter = np.array([[0.25 / ARCSEC_PER_RAD, 0.0]])
    assert mean_visibility(quarter, fringes) == pytest.approx(0.92, abs=0.005)
