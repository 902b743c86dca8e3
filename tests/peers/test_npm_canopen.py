"""npm canopen 6.2.1 as a master of the mock drive, by an SLCAN transport of its own."""

import asyncio
import json
import shutil
from pathlib import Path

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.cia402.drive import Cia402DriveMock

CLIENT = Path(__file__).parent / "canopen"

pytestmark = [
    pytest.mark.peer,
    pytest.mark.skipif(shutil.which("node") is None, reason="node is not installed"),
    pytest.mark.skipif(
        not (CLIENT / "node_modules" / "canopen").exists(),
        reason="npm canopen is not installed: `npm --prefix tests/peers/canopen ci`",
    ),
]


class StandingMotors:
    """Azimuth stands at ten counts, elevation at none."""

    def __init__(self, rad_per_count):
        self.angles_rad = (10 * rad_per_count, 0.0)
        self.velocities_rad_s = []

    def position_rad(self):
        return self.angles_rad

    def command_velocity_rad_s(self, az, el):
        self.velocities_rad_s.append((az, el))

    def set_enabled(self, axis, enabled):
        """Power is seen by the statusword here."""


async def conversation():
    siderostat = load_rig(default_rig_path()).loops["right"].siderostat
    motors = StandingMotors(2 * 3.141592653589793 / siderostat.encoder_counts_per_rev)
    mock = Cia402DriveMock(siderostat, motors, port=0)
    port = await mock.start()
    try:
        process = await asyncio.create_subprocess_exec(
            "node",
            str(CLIENT / "client.js"),
            str(port),
            stdout=asyncio.subprocess.PIPE,
            stderr=asyncio.subprocess.PIPE,
        )
        out, err = await asyncio.wait_for(process.communicate(), 20)
        assert process.returncode == 0, err.decode()
    finally:
        await mock.stop()
    return json.loads(out), motors


def test_it_finds_nothing_strange():
    saw, motors = asyncio.run(conversation())
    assert saw["name"].rstrip("\0") == "FIT two-axis servo drive (mock)"
    assert saw["serial"] == 20261121
    assert saw["abort"] == 0x0602_0000
    assert saw["statuswords"] == [0x0231, 0x0233, 0x1237]
    assert saw["counts"] == 10
    assert saw["target"] == 60
    assert max(az for az, _el in motors.velocities_rad_s) == pytest.approx(6.283, abs=1e-3)
    assert [1, 5] in saw["heartbeats"]
    assert saw["emergencies"] == [0x8130]
