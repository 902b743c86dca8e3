"""Coverage-guided fuzzing of what reads the LabJack T7's wire: the driver, and the mock's registers.

The first byte chooses who reads the rest. Framing and functions are those of all Modbus mocks: see
fuzz_modbus_dac.py.
"""

from __future__ import annotations

import socket

from fitctl.config import LabJackMock, LabJackT7Device
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceError
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.labjack_t7.link import T7Link
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.modbus.pdu import answer
from fitctl.mocks.modbus.tcp import frame

_DEVICE = LabJackT7Device(
    driver="labjack_t7",
    host="127.0.0.1",
    port=502,
    inputs=[0, 1, 2, 3],
    range_v=10.0,
    resolution_index=4,
    settling_us=0.0,
    response_timeout_s=0.001,
)
_SETTINGS = LabJackMock(
    modbus_port=0, serial_number=470012345, firmware=1.0312, pro=False, overhead_s=0.0
)
_MOST_V = 11.5


def read_requests(data: bytes) -> None:
    """Requests get their own answer or an exception, whatever was asked before.

    Of each ten bytes the first chooses one of the addresses that the T7 has.
    """
    mock = LabJackT7Mock(_DEVICE, _SETTINGS, lambda _time_s: [1.0] * 4)
    addresses = sorted(mock._cells)
    for begin in range(0, len(data) - 1, 10):
        address = addresses[data[begin] % len(addresses)].to_bytes(2, "big")
        request = data[begin + 1 : begin + 2] + address + data[begin + 2 : begin + 10]
        got = answer(request, mock._server._model)
        assert got[0] & 0x7F == request[0] & 0x7F
        assert mock._service_s(request) >= 0
        if got[0] & 0x80:
            assert 1 <= got[1] <= 4


def read_answers(data: bytes) -> None:
    """The driver, and a T7 that sends `data`, bare and then framed: a sample or a device error."""
    for said in (data, frame(1, 1, data[:253]) if data else b""):
        ours, theirs = socket.socketpair()
        with ours, theirs:
            ours.setblocking(False)
            link = T7Link.__new__(T7Link)
            link._endpoint, link._socket, link._pending = Endpoint("T7", ""), ours, bytearray()
            link._unit, link._timeout_s, link._transaction, link._owed = 1, 0.001, 0, 0
            link._station, link._keys, link.arrived_s = "the T7", "sensor.device", 0.0
            driver = LabJackT7(_DEVICE)
            driver._link = link
            try:
                driver.send_request()
                theirs.sendall(said[:4096])
                reading = driver.receive()
            except DeviceError:
                continue
            assert reading is None or all(abs(value) <= _MOST_V for value in reading.volts)


_READERS = (read_requests, read_answers)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - the name that fuzzers call
    """Run one input."""
    if data:
        _READERS[data[0] % len(_READERS)](data[1:])


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
