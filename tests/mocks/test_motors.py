"""Motors as a rig's cables and ends have them."""

import math

import pytest

from fitctl.config.wiring import STRAIGHT
from fitctl.mocks.motors import WiredMotors


class Turning:
    """Motors that turn by a second at each command."""

    def __init__(self):
        self.at_rad = [0.0, 0.0]

    def position_rad(self):
        return self.at_rad

    def command_velocity_rad_s(self, az, el):
        self.at_rad = [self.at_rad[0] + az, self.at_rad[1] + el]


@pytest.mark.parametrize("way", [1.0, -1.0])
def test_a_motor_stops_at_its_end_and_turns_back_from_there(way):
    turning = Turning()
    motors = WiredMotors(turning, STRAIGHT, [1.0, 1.0], [2.0, math.inf])
    for _ in range(5):
        motors.command_velocity_rad_s(way, way)
    assert turning.at_rad == [2 * way, 5 * way]
    motors.command_velocity_rad_s(-way, -way)
    assert turning.at_rad == [way, 4 * way]
