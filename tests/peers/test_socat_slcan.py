"""The driver on a serial port: socat makes one, with the mock's SLCAN adapter at its far end."""

import shutil
import subprocess
import time

import pytest
from instruments.mock_bench import ToldMotors

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.interface import DeviceError
from fitctl.mocks.cia402.drive import Cia402DriveMock

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(
        shutil.which("socat") is None, reason="socat is not installed: Debian package socat"
    ),
]


@pytest.fixture
def mock_port(in_loop):
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat

    async def made():
        mock = Cia402DriveMock(siderostat, ToldMotors(1.0, -1.0), port=0)
        return mock, await mock.start()

    mock, port = in_loop(made())
    yield port
    in_loop(mock.stop())


@pytest.fixture
def serial_port(mock_port, tmp_path):
    path = tmp_path / "slcan"
    socat = subprocess.Popen(
        ["socat", f"pty,raw,echo=0,link={path}", f"tcp:127.0.0.1:{mock_port},nodelay"]
    )
    deadline_s = time.monotonic() + 5
    while not path.exists():
        assert time.monotonic() < deadline_s, "socat made no serial port"
        time.sleep(0.01)
    yield path, socat
    socat.terminate()
    socat.wait(5)


def exchange_for(amplifiers, seconds):
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        amplifiers.exchange((0.0, 0.0))


def test_the_amplifiers_are_had_and_lost_there_as_on_a_socket(serial_port):
    path, socat = serial_port
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat
    device = siderostat.device.model_copy(update={"channel": str(path)})
    amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"device": device}))
    amplifiers.open()
    amplifiers.enable()
    deadline_s = time.monotonic() + 3
    while (reading := amplifiers.exchange((0.0, 0.0))) is None or not reading.enabled:
        assert time.monotonic() < deadline_s, "no reading"
    assert reading.position_rad == pytest.approx((1.0, -1.0), abs=1e-3)
    socat.terminate()
    socat.wait(5)
    with pytest.raises(DeviceError):
        exchange_for(amplifiers, 3.0)
    amplifiers.close()
