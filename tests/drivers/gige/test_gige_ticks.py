from __future__ import annotations

import pytest

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.gige.ticks import CameraTime
from fitctl.drivers.interface import DeviceUnreachable


class Camera:
    """A camera whose clock ticks once at each latch."""

    endpoint = Endpoint("camera", "127.0.0.1:3956")
    answered_s = 0.0

    def __init__(self) -> None:
        self.ticks = 1000

    def read_register(self, address: int) -> int:
        low = {Register.TICK_FREQUENCY_LOW: 1000, Register.TIMESTAMP_LOW: self.ticks}
        return low.get(Register(address), 0)

    def write_register(self, _address: int, _value: int) -> None:
        self.ticks += 1


def test_a_clock_that_goes_back_is_a_camera_that_has_restarted() -> None:
    camera = Camera()
    clock = CameraTime(camera)
    before_s = clock.host_s(1000)
    camera.ticks = 0

    with pytest.raises(DeviceUnreachable, match=r"more than 1005 ticks.*1.*restarted"):
        clock.latch()

    assert clock.host_s(1000) == before_s  # frames from before the restart keep their times
