"""A LabJack T7 as tests have it: settings, a mock with voltages that a test sets, and how a loop asks."""

import time

import pytest

from fitctl.config import Fault, LabJackMock, LabJackT7Device
from fitctl.mocks.labjack_t7.server import LabJackT7Mock

AT_ONCE_S = 0.1  # the machine itself may stand still for tens of milliseconds
DEVICE = LabJackT7Device(
    driver="labjack_t7",
    host="127.0.0.1",
    port=1,
    inputs=[0, 1, 2, 3],
    range_v=10.0,
    resolution_index=4,
    settling_us=0.0,
    response_timeout_s=0.25,
)
SETTINGS = LabJackMock(
    modbus_port=0, serial_number=470012345, firmware=1.0312, pro=False, overhead_s=0.0
)


class Bench:
    """A mock, and what its photodiodes give; made inside the event loop that it will serve in.

    Attributes
    ----------
    volts : list of four floats
        Of the photodiodes az+, az-, el+ and el-.
    sampled_s : list of float
        Host times at which the mock has sampled them.
    """

    def __init__(self, *, device=DEVICE, **settings):
        self.volts = [5.0, 4.0, 3.0, 2.0]
        self.sampled_s = []
        self.mock = LabJackT7Mock(device, SETTINGS.model_copy(update=settings), self._sample)

    def begin(self, kind, **settings):
        """Begin a fault."""
        self.mock.faults.set(Fault(device="metrology.labjack", kind=kind, **settings))

    def _sample(self, time_s):
        self.sampled_s.append(time_s)
        return list(self.volts)


def device_at(port, **changes):
    return DEVICE.model_copy(update={"port": port, **changes})


def sampled(driver, within_s=5.0):
    """The next sample that arrives."""
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        if (reading := driver.receive()) is not None:
            return reading
        time.sleep(0.001)
    return pytest.fail("no sample")


def ask_every_20_ms(driver):
    """Ask as a loop does, for a second, and never wait."""
    for _ in range(50):
        started_s = time.monotonic()
        driver.send_request()
        driver.receive()
        assert time.monotonic() - started_s < AT_ONCE_S
        time.sleep(0.02)
