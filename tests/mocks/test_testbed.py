"""The testbed's cables: what a device is told on its wire shows on the camera."""

import asyncio
import math
import socket
import threading
import time

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.mocks.bench import Residual, ResidualQuestion, StagesNow, StagesQuestion, ask_bench
from fitctl.mocks.testbed import Testbed as MockTestbed
from fitctl.model.hysteresis import stack_gains
from fitctl.model.optics import scales

FREE = [
    "mocks.gvcp_port=0",
    "mocks.bench_port=0",
    "mocks.loops.right.slcan_port=0",
    "mocks.loops.right.modbus_port=0",
    "mocks.loops.right.mdt693_port=0",
    "plant.loops.right.star_offset_sky_arcsec_max=0.0",
    "plant.loops.right.air_path.gain_px=0.0",
    "plant.loops.right.backlash_sky_arcsec=0.0",
    "mocks.loops.right.dac.watchdog_s=60.0",
]


class Running:
    """A testbed on an event loop of its own, and the rig that leads to it."""

    def __init__(self, *overrides):
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.testbed = MockTestbed(load_rig(default_rig_path(), [*FREE, *overrides]), seed=1)
        self.endpoints = self.call(self.testbed.start())
        devices = [f"{k}={v}" for k, v in self.endpoints.items() if not k.startswith("mocks.")]
        self.rig = load_rig(default_rig_path(), [*FREE, *overrides, *devices])

    def call(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop).result(60)

    def stop(self):
        self.call(self.testbed.stop())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join()
        self.loop.close()


@pytest.fixture
def running(request):
    running = Running(*getattr(request, "param", ()))
    yield running
    running.stop()


@pytest.fixture
def camera(running):
    camera = GigeCamera(running.rig.camera)
    camera.open()
    camera.start()
    yield camera
    camera.close()


def star_px(camera, after_s):
    """Where the star is on the first frame exposed after `after_s`."""
    end_s = time.monotonic() + 10
    while time.monotonic() < end_s:
        frame = camera.next_frame(1.0)
        if frame is not None and frame.mid_exposure_s > after_s:
            light = frame.image[:, 20:].astype(float) - 1000.0  # without the fringe spot
            light[light < 100] = 0
            rows, columns = np.indices(light.shape)
            return np.array([(light * (columns + 20)).sum(), (light * rows).sum()]) / light.sum()
    raise AssertionError("no frame")


def test_a_voltage_written_to_the_da_moves_the_star_on_the_camera(running, camera):
    fsm = running.rig.loops["right"].fsm
    dac = ModbusDac(fsm.dac)
    dac.open()
    before = star_px(camera, time.monotonic() + 0.1)
    dac.send_v(np.array([6.0, 5.0, 4.0]))  # Eq. 1: both axes, azimuth and elevation, half each
    dac.confirm()
    after = star_px(camera, time.monotonic() + 0.2)
    dac.close()

    gains = stack_gains(running.rig.plant.loops["right"].hysteresis, fsm)
    px_per_m = (
        scales(running.rig, running.rig.loops["right"]).mirror_px_per_rad / fsm.stack_radius_m
    )
    # Volts that turn round meet the slope of the linear element alone, volts that go on meet all of
    # them; each axis is half the difference of two stacks.
    least, most = 0.5 * gains[0] * px_per_m, 0.5 * gains.sum() * px_per_m
    moved = after - before
    assert np.all((least * 0.95 < moved) & (moved < most * 1.05))


@pytest.mark.parametrize(
    "running", [("mocks.loops.right.mdt693.limit_switch_v=75",)], indirect=True
)
def test_the_piezo_amplifiers_limit_holds_the_star_back(running, camera):
    dac = ModbusDac(running.rig.loops["right"].fsm.dac)
    dac.open()
    dac.send_v(np.array([5.0, 5.0, 4.0]))
    dac.confirm()
    at_limit = star_px(camera, time.monotonic() + 0.2)
    dac.send_v(np.array([5.5, 5.5, 4.0]))  # 82 V wanted, 75.5 V allowed: as good as 5.03 V
    dac.confirm()
    beyond = star_px(camera, time.monotonic() + 0.2)
    dac.close()

    assert np.abs(beyond - at_limit).max() < 0.1


def test_a_motor_turned_over_can_moves_the_star_as_the_gear_says(running, camera):
    siderostat = running.rig.loops["right"].siderostat
    amplifiers = Cia402Amplifiers(siderostat)
    amplifiers.open()
    amplifiers.enable()
    before = star_px(camera, time.monotonic() + 0.1)
    velocity = (2.0, 0.0)
    end_s = time.monotonic() + 0.4
    reading = None
    while time.monotonic() < end_s:
        reading = amplifiers.exchange(velocity) or reading
    velocity = (0.0, 0.0)
    for _ in range(50):
        reading = amplifiers.exchange(velocity) or reading
    after = star_px(camera, time.monotonic() + 0.1)
    amplifiers.close()

    turned_rad = reading.position_rad[0]
    assert turned_rad > 0.5
    scale = scales(running.rig, running.rig.loops["right"])
    assert after[0] - before[0] == pytest.approx(turned_rad * scale.motor_px_per_rad, abs=0.1)
    assert after[1] == pytest.approx(before[1], abs=0.1)


def test_the_bench_knows_where_the_star_truly_is(running):
    since_s = time.monotonic()
    wait = threading.Event()
    wait.wait(0.5)
    port = running.endpoints["mocks.bench_port"]

    residual = ask_bench(
        port, ResidualQuestion("right", since_s, since_s + 0.3, 24.0, 18.5), Residual
    )

    assert residual.az_rms_px == pytest.approx(0.0, abs=1e-6)
    assert residual.el_rms_px == pytest.approx(1.0, abs=1e-6)
    assert residual.samples == pytest.approx(600, abs=2)


def test_the_bench_knows_where_the_stages_truly_are(running):
    port = running.endpoints["mocks.bench_port"]
    dac = ModbusDac(running.rig.loops["right"].fsm.dac)
    dac.open()
    dac.send_v(np.array([6.0, 5.0, 4.0]))
    dac.confirm()
    dac.close()

    stages = ask_bench(port, StagesQuestion("right"), StagesNow)

    assert stages.stack_v == pytest.approx([6.0, 5.0, 4.0], abs=1e-3)
    assert stages.motor_rad == [0.0, 0.0]
    assert "no loop is named left" in ask_bench(port, StagesQuestion("left"), StagesNow).error


def images(camera, count, after_s=0.0):
    """So many of the next frames that are exposed after `after_s`, shape (count, height, width)."""
    found, end_s = [], time.monotonic() + 10
    while len(found) < count and time.monotonic() < end_s:
        frame = camera.next_frame(1.0)
        if frame is not None and frame.mid_exposure_s > after_s:
            found.append(frame.image.astype(float))
    assert len(found) == count
    return np.array(found)


@pytest.mark.parametrize(
    "running",
    [("camera.electrons_per_dn=0.5", "camera.pixel_noise_dn=2.0")],
    indirect=True,
)
def test_the_stars_own_light_has_photon_noise_on_the_wire(running, camera):
    seen = images(camera, 60)
    light_dn = seen.mean(axis=0) - running.rig.camera.bias_dn
    lit = light_dn > 500
    assert np.median(seen.var(axis=0)[lit] / light_dn[lit]) == pytest.approx(2.0, rel=0.25)


FAST_LINE = (
    "plant.loops.right.lines=[{frequency_hz=60.0,rms_px=0.8,direction_deg=0.0,damping=0.0,"
    "drift_hz_per_min=0.0}]"
)


@pytest.mark.parametrize(
    ("running", "smears"),
    [((FAST_LINE,), False), ((FAST_LINE, "plant.exposure_instants=5"), True)],
    indirect=["running"],
)
def test_what_moves_during_an_exposure_smears_the_spot_on_the_wire(running, camera, smears):
    light_dn = images(camera, 60)[:, :, 16:] - running.rig.camera.bias_dn  # without the fringe spot
    light_dn[light_dn < 100] = 0
    columns, across = np.arange(light_dn.shape[2]), light_dn.sum(axis=1)
    mean_px = (across * columns).sum(axis=1) / across.sum(axis=1)
    wide_px2 = (across * (columns - mean_px[:, None]) ** 2).sum(axis=1) / across.sum(axis=1)
    at_rest_px2 = 0.75**2 + 1 / 12  # of the spot, and of a pixel
    assert (np.median(wide_px2) > 1.3 * at_rest_px2) == smears


@pytest.mark.parametrize(
    "running",
    [("plant.timeline=[{at_s=2.0,pixel_noise_dn=200.0}]", "camera.pixel_noise_dn=10.0")],
    indirect=True,
)
def test_a_night_changes_on_the_wire_when_its_timeline_says_so(running, camera):
    before = images(camera, 5)[:, :8].std()
    after = images(camera, 5, after_s=time.monotonic() + 2.2)[:, :8].std()
    assert before == pytest.approx(10.0, rel=0.2)
    assert after == pytest.approx(200.0, rel=0.2)


def test_the_bench_answers_nonsense_with_an_error(running):
    port = running.endpoints["mocks.bench_port"]

    assert (
        "no loop is named left"
        in ask_bench(port, ResidualQuestion("left", 0, 1, 0, 0), Residual).error
    )
    assert ask_bench(port, ResidualQuestion("right", 5.0, 1.0, 0, 0), Residual).samples == 0
    assert ask_bench(port, ResidualQuestion("right", 1e300, 1e301, 0, 0), Residual).samples == 0
    assert ask_bench(port, ResidualQuestion("right", float("nan"), 1.0, 0, 0), Residual).error
    assert math.isnan(
        ask_bench(port, ResidualQuestion("right", 5.0, 1.0, 0, 0), Residual).az_rms_px
    )


def test_every_device_listens_on_loopback_only(running):
    ports = [
        running.endpoints["loops.right.fsm.dac.port"],
        int(running.endpoints["loops.right.siderostat.device.channel"].rpartition(":")[2]),
        int(running.endpoints["loops.right.fsm.piezo.port"].rpartition(":")[2]),
        running.endpoints["mocks.bench_port"],
    ]
    # 127.0.0.2 is this machine too, but not the address that they were bound to.
    for port in ports:
        with socket.socket() as probe, pytest.raises(ConnectionRefusedError):
            probe.connect(("127.0.0.2", port))
