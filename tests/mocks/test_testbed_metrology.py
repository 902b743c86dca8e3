"""The metrology loop's cables: where the beam falls shows on the photodiodes, by way of the LabJack's wire."""

import asyncio
import json
import math
import threading
import time

import numpy as np
import pytest

from fitctl.commands.set_up.doctor import ask_devices
from fitctl.config import Fault, default_rig_path, load_rig
from fitctl.daemon.devices import rig_devices
from fitctl.drivers.interface import Pose
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.mocks.bench import Beam, BeamQuestion, Visibility, VisibilityQuestion, ask_bench
from fitctl.mocks.testbed import Testbed as MockTestbed

RIG_FILE = default_rig_path().parent / "fit-testbed.toml"
LOOP = "metrology"
FREE = [
    "mocks.gvcp_port=0",
    "mocks.bench_port=0",
    "mocks.hexapod.tcp_port=0",
    "mocks.hexapod.reference_s=0.1",
    "mocks.loops.metrology.slcan_port=0",
    "mocks.loops.metrology.labjack.modbus_port=0",
    *(
        f"mocks.loops.{loop}.{port}=0"
        for loop in ("right", "left")
        for port in ("slcan_port", "modbus_port", "mdt693_port")
    ),
    "plant.loops.metrology.beam_offset_sky_arcsec_max=0.0",
    "plant.loops.metrology.air_path.rms_sky_arcsec=0.0",
    "plant.loops.metrology.backlash_sky_arcsec=0.0",
]


class Running:
    """A testbed on an event loop of its own, and the rig that leads to it."""

    def __init__(self):
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.testbed = MockTestbed(load_rig(RIG_FILE, FREE), seed=1)
        self.endpoints = self.call(self.testbed.start())
        where = self.endpoints.items()
        devices = [f"{key}={value}" for key, value in where if key[:5] != "mocks"]
        self.rig = load_rig(RIG_FILE, [*FREE, *devices])

    def call(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(60)

    def wrong(self, kind="", **settings):
        """Begin a fault of the LabJack, or end all without a kind."""

        async def change():
            faults = self.testbed._labjacks[LOOP].faults
            if kind:
                faults.set(Fault(device=f"{LOOP}.labjack", kind=kind, **settings))
            else:
                faults.clear()

        self.call(change())

    def stop(self):
        self.call(self.testbed.stop())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()


@pytest.fixture(scope="module")
def running():
    running = Running()
    yield running
    running.stop()


@pytest.fixture
def devices(running):
    devices = rig_devices(running.rig).loops[LOOP]
    devices.photodiodes.open()
    yield devices
    devices.photodiodes.close()


def sampled(photodiodes):
    photodiodes.send_request()
    end_s = time.monotonic() + 5.0
    while time.monotonic() < end_s:
        if (reading := photodiodes.receive()) is not None:
            return np.array(reading.volts)
        time.sleep(0.001)
    return pytest.fail("no sample")


def test_the_rig_files_photodiodes_are_behind_a_labjack(devices):
    assert isinstance(devices.photodiodes, LabJackT7)
    identity = devices.photodiodes.open()
    assert (identity.model, identity.serial) == ("T7", "470012345")


def test_with_the_beam_on_the_centre_each_photodiode_gives_its_light_and_its_ambient(
    running, devices
):
    sensor = running.rig.plant.loops[LOOP].sensor
    samples = np.array([sampled(devices.photodiodes) for _ in range(50)])
    expected_v = sensor.on_axis_v + np.array(sensor.ambient_v)
    assert samples.mean(axis=0) == pytest.approx(expected_v, abs=5 * sensor.noise_v)
    assert samples.std(axis=0) == pytest.approx(sensor.noise_v, rel=0.5)  # of 50: 10 %


def test_a_motor_that_turns_moves_the_beam_along_its_axis_on_the_photodiodes(running, devices):
    sensor = running.rig.plant.loops[LOOP].sensor
    before = sampled(devices.photodiodes)
    devices.amplifiers.open()
    try:
        devices.amplifiers.enable()
        end_s = time.monotonic() + 0.5
        while time.monotonic() < end_s:
            devices.amplifiers.exchange((20.0, 0.0))
        devices.amplifiers.exchange((0.0, 0.0))
    finally:
        devices.amplifiers.close()
    after = sampled(devices.photodiodes)
    # For a Gaussian, ln(i+ / i-) = 8 d p / w^2 of each axis.
    metres = sensor.beam_radius_m**2 / (8 * sensor.diode_offset_m)
    light = np.array([before, after]) - np.array(sensor.ambient_v)
    az_m, el_m = (metres * np.log(light[:, plus] / light[:, plus + 1]) for plus in (0, 2))
    assert abs(az_m[1] - az_m[0]) > 1e-4
    assert abs(el_m[1] - el_m[0]) < 1e-5


def test_with_the_laser_off_only_the_ambient_light_is_left(running, devices):
    ambient_v = running.rig.plant.loops[LOOP].sensor.ambient_v
    running.wrong("laser_dim")
    try:
        assert sampled(devices.photodiodes) == pytest.approx(ambient_v, abs=0.01)
    finally:
        running.wrong()
    assert min(sampled(devices.photodiodes)) > 10 * max(ambient_v)


def go_to(hexapod, pose):
    hexapod.move_to(pose, 8.0)
    end_s = time.monotonic() + 5.0
    while hexapod.pose().moving:
        assert time.monotonic() < end_s


def test_a_hexapod_that_moves_carries_the_photodiodes_across_the_beam(running, devices):
    live = running.testbed._live
    beam = live.plant.metrology_loops[LOOP]
    hexapod = rig_devices(running.rig).hexapod
    hexapod.open()
    try:
        hexapod.reference()
        sampled(devices.photodiodes)  # brings the plant to now
        before_m = beam.offset_m(live.plant.time_s)[0].copy()
        go_to(hexapod, Pose(y_mm=1.0, z_mm=-0.5))
        sampled(devices.photodiodes)
        moved_m = beam.offset_m(live.plant.time_s)[0] - before_m
        assert moved_m == pytest.approx([-1e-3, 0.5e-3], abs=1e-9)
    finally:
        go_to(hexapod, Pose())
        hexapod.close()


def test_the_bench_knows_beam_and_visibility_and_where_it_does_not_says_why(running, devices):
    port = running.endpoints["mocks.bench_port"]
    since_s = time.monotonic()
    time.sleep(0.2)
    sampled(devices.photodiodes)
    live = running.testbed._live
    beam = ask_bench(port, BeamQuestion(LOOP, since_s, since_s + 0.15), Beam)
    part = live.plant.metrology_loops[LOOP]
    angle_arcsec = np.abs(part.offset_m(live.plant.time_s)[0]) / 10.0 * 206264.8
    assert (beam.az_rms_arcsec, beam.el_rms_arcsec) == pytest.approx(tuple(angle_arcsec), rel=1e-3)
    assert beam.samples == pytest.approx(300, abs=2)
    targets = ((12.0, 20.0), (28.0, 20.0))
    question = VisibilityQuestion(("left", "right"), targets, 0.15, 7e-7, since_s, since_s + 0.15)
    assert 0.0 <= ask_bench(port, question, Visibility).mean <= 1.0

    assert "start_s and end_s" in ask_bench(port, BeamQuestion(LOOP, math.inf, 1.0), Beam).error
    assert (
        "no metrology loop is named left" in ask_bench(port, BeamQuestion("left", 0, 1), Beam).error
    )
    nobody = VisibilityQuestion(("left", "nobody"), targets, 0.15, 7e-7, 0.0, 1.0)
    assert "no two loops are named left, nobody" in ask_bench(port, nobody, Visibility).error
    no_aperture = VisibilityQuestion(("left", "right"), targets, -0.15, 7e-7, since_s, since_s)
    assert "aperture_m: must be " in ask_bench(port, no_aperture, Visibility).error
    assert ask_bench(port, BeamQuestion(LOOP, since_s, since_s + 0.15), Beam).samples > 0


def test_doctor_asks_the_labjack_who_it_is(running, capsys):
    ask_devices(running.rig, RIG_FILE, as_json=True)
    found = {one["device"]: one for one in json.loads(capsys.readouterr().out)["devices"]}
    photodiodes = found["metrology photodiodes"]
    assert photodiodes["disagreements"] == []
    assert photodiodes["identity"]["model"] == "T7"
    assert 0 < photodiodes["round_trip_ms"] < 1e3
    assert math.isfinite(photodiodes["round_trip_ms"])
