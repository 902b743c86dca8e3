"""A LabJack T7 as tests have it: settings, and a mock with voltages that a test sets."""

from fitctl.config import Fault, LabJackMock, LabJackT7Device
from fitctl.mocks.labjack_t7.server import LabJackT7Mock

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
