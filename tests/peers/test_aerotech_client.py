"""github.com/robmarkcole/aerotech, a public client of the Ensemble's TCP interface, against our mock.

It is no package: its ``aerotech.py`` must be on the path, as with ``PYTHONPATH=checkout make test-peers``.
"""

import asyncio

import pytest

from fitctl import config
from fitctl.drivers.ensemble.protocol import AxisStatus
from fitctl.mocks.ensemble.controller import EnsembleControllerMock

pytestmark = pytest.mark.peer

RIG = config.load_rig(config.default_rig_path().parent / "ensemble.toml")
SIDEROSTAT = RIG.loops["right"].siderostat
SETTINGS = RIG.mocks.loops["right"].ensemble.model_copy(update={"tcp_port": 0})


class FollowingMotors:
    """Motors that turn as they are told."""

    def __init__(self):
        self.enabled = [False, False]
        self._angle_rad = [0.0, 0.0]
        self._velocity_rad_s = (0.0, 0.0)
        self._at_s = 0.0

    def position_rad(self):
        now_s = asyncio.get_running_loop().time()
        for axis, velocity in enumerate(self._velocity_rad_s):
            self._angle_rad[axis] += velocity * (now_s - self._at_s)
        self._at_s = now_s
        return tuple(self._angle_rad)

    def command_velocity_rad_s(self, az, el):
        self._velocity_rad_s = (az, el)

    def set_enabled(self, axis, enabled):
        self.enabled[axis] = enabled


@pytest.fixture
def served(in_loop):
    async def made():
        motors = FollowingMotors()
        mock = EnsembleControllerMock(SIDEROSTAT, SETTINGS, motors)
        return mock, motors, (await mock.start()).tcp_port

    mock, motors, port = in_loop(made())
    yield motors, port
    in_loop(mock.stop())


def test_it_enables_moves_and_reads_positions(served):
    aerotech = pytest.importorskip(
        "aerotech", reason="aerotech.py of github.com/robmarkcole/aerotech is not on the path"
    )
    motors, port = served
    client = aerotech.Ensemble("127.0.0.1", port)
    client.connect()
    client.enable()  # X and Y, and Z, which is refused
    assert motors.enabled == [True, True]
    client.write_read("MOVEABS X0.500000 XF10.0 Y-0.250000 YF10.0")
    while any(int(client.write_read(f"AXISSTATUS({name})")) & AxisStatus.MOVING for name in "XY"):
        pass
    assert float(client.write_read("PFBK X")) == pytest.approx(0.5, abs=1e-3)
    assert float(client.write_read("PFBK Y")) == pytest.approx(-0.25, abs=1e-3)
    client.close()
