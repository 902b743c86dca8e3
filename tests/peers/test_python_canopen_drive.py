"""Our driver on python-can's virtual bus against a drive that is python-canopen's LocalNode.

Its SDO server, NMT slave, heartbeat and EMCY are python-canopen 2.4's; it has no synchronous TPDOs and no
drive profile, so these few lines of it are the test's own.
"""

import struct
import time
from importlib.resources import files

import canopen
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.interface import DeviceFault, DeviceMismatch, DeviceTimeout

pytestmark = pytest.mark.peer

EDS = str(files("fitctl.mocks.cia402") / "fit_drive.eds")
STILL = (0.0, 0.0)
STATUSWORDS = {0x00: 0x0250, 0x06: 0x0231, 0x07: 0x0233, 0x0F: 0x1237, 0x80: 0x0250}
AXES = (0, 0x800)


class Drive:
    """A LocalNode that walks the states as it is told, and answers each SYNC by its positions."""

    def __init__(self, channel):
        self.network = canopen.Network()
        self.network.connect(interface="virtual", channel=channel)
        self.node = self.network.create_node(1, EDS)
        self.velocities = (0, 0)
        self.positions = (100, -200)
        self.node.add_write_callback(self._on_write)
        for offset in AXES:
            self.node.sdo[0x6041 + offset].raw = STATUSWORDS[0x00]
        self.network.subscribe(0x201, self._on_velocities)
        self.network.subscribe(0x080, self._on_sync)

    def fail(self, offset, code):
        self.node.sdo[0x6041 + offset].raw = 0x0238
        self.node.sdo[0x603F + offset].raw = code
        self.node.emcy.send(code, register=1)
        self._send_statuswords()

    def close(self):
        self.node.nmt.stop_heartbeat()
        self.network.disconnect()

    def _on_write(self, index, data, **_object):
        if index in {0x6040, 0x6840}:
            (controlword,) = struct.unpack("<H", data)
            self.node.sdo[index + 1].raw = STATUSWORDS[controlword]
            self._send_statuswords()

    def _on_velocities(self, _can_id, data, _timestamp):
        self.velocities = struct.unpack("<ii", data)

    def _on_sync(self, *_message):
        if self.node.nmt.state == "OPERATIONAL":
            self.network.send_message(0x181, struct.pack("<ii", *self.positions))
            self._send_statuswords()

    def _send_statuswords(self):
        words = [self.node.sdo[0x6041 + offset].raw for offset in AXES]
        self.network.send_message(0x281, struct.pack("<HH", *words))


@pytest.fixture
def drive(request):
    drive = Drive(request.node.name)
    yield drive
    drive.close()


@pytest.fixture
def amplifiers(drive, request):
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat
    device = siderostat.device.model_copy(
        update={"interface": "virtual", "channel": request.node.name, "response_timeout_s": 1.0}
    )
    # Its threads share this process with the driver: a period that they can keep.
    servo = siderostat.servo.model_copy(update={"rate_hz": 20.0})
    amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"device": device, "servo": servo}))
    yield amplifiers
    amplifiers.close()


def reading_of(amplifiers, velocity_rad_s=STILL):
    deadline_s = time.monotonic() + 3
    while (reading := amplifiers.exchange(velocity_rad_s)) is None:
        assert time.monotonic() < deadline_s, "no reading"
    return reading


def exchange_for(amplifiers, seconds):
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        amplifiers.exchange(STILL)


def test_it_is_opened_enabled_moved_and_left(drive, amplifiers):
    identity = amplifiers.open()
    assert identity.model == "FIT two-axis servo drive (mock)"
    amplifiers.enable()
    assert drive.node.sdo[0x6060].raw == 9
    assert drive.node.sdo[0x60A9].raw == 0xFDB44700
    assert drive.node.sdo[0x607D][2].raw == 50929
    reading = reading_of(amplifiers, (1.0, -1.0))
    assert reading.position_rad == pytest.approx((0.15708, -0.31416), abs=1e-5)
    assert reading.fault == ""
    assert drive.velocities == (9549, -9549)
    amplifiers.disable()
    assert drive.velocities == (0, 0)
    assert not reading_of(amplifiers).enabled


def test_its_emergency_and_state_come_in_the_reading_and_are_reset(drive, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    drive.fail(0x800, 0x7306)
    deadline_s = time.monotonic() + 3
    while not (fault := reading_of(amplifiers).fault):
        assert time.monotonic() < deadline_s
    assert "elevation: fault" in fault
    assert "0x7306" in fault
    with pytest.raises(DeviceFault, match="elevation"):
        amplifiers.enable()
    amplifiers.reset_fault()
    assert reading_of(amplifiers).fault == ""


def test_its_heartbeat_is_missed(drive, amplifiers):
    amplifiers.open()
    drive.node.nmt.stop_heartbeat()
    with pytest.raises(DeviceTimeout, match="heartbeat"):
        exchange_for(amplifiers, 3.0)


def test_another_profile_is_not_taken(drive, amplifiers):
    drive.node.sdo[0x1000].raw = 401
    with pytest.raises(DeviceMismatch, match="402"):
        amplifiers.open()
