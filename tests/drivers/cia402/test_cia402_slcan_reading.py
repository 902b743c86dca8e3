"""What the driver takes from an SLCAN adapter: frames whole and sound, and nothing else."""

import queue
import socket

import pytest
from can import CanProtocol
from hypothesis import given
from hypothesis import strategies as st

from fitctl.drivers.cia402.link import BulkSlcanBus, CanLink
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceError, DeviceProtocolError

POSITIONS = (0x181, bytes.fromhex("0a000000ffffffff"))


def heard(data):
    """What a link makes of bytes that an adapter sends, error by error."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(data)
        bus = object.__new__(BulkSlcanBus)
        bus._buffer, bus._batch, bus._queue = bytearray(), None, queue.SimpleQueue()
        bus._is_shutdown, bus._can_protocol = True, CanProtocol.CAN_20
        bus._descriptor = ours.fileno()
        link = object.__new__(CanLink)
        link.endpoint, link._bus = Endpoint("drive", "an adapter"), bus
        results = []
        for _ in range(len(data) + 1):
            try:
                frame = link.receive(0.0)
            except DeviceError as error:
                results.append(type(error))
                continue
            if frame is not None:
                results.append(frame)
        return results


@pytest.mark.parametrize(
    "line",
    [
        b"t18180A000000FFFFFFFF\r",
        b"t18180a000000ffffffff\r",
        b"t18180A000000FFFFFFFF1F40\r",
        b"\r\rz\r\at18180A000000FFFFFFFF\r",
        b"V1013\rF00\rt18180A000000FFFFFFFF\r",
        b"T0000018180A000000FFFFFFFF\rr1818\rt18180A000000FFFFFFFF\r",
        b"d1818" + b"00" * 8 + b"\rt18180A000000FFFFFFFF\r",
    ],
    ids=["frame", "lower case", "time stamp", "acknowledgements", "answers", "others", "FD"],
)
def test_a_frame_is_found_among_what_adapters_say(line):
    assert heard(line) == [POSITIONS]


@pytest.mark.parametrize(
    "line",
    [
        b"t18180A000000FFFFFF\r",
        b"t18180A000000FFFFFFFFF\r",
        b"t18190A000000FFFFFFFF00\r",
        b"t1+180A000000FFFFFFFF\r",
        b"t1818 A000000FFFFFFFF\r",
        b"t9818" + b"0" * 16 + b"\r",
        b"t\r",
    ],
)
def test_a_broken_frame_is_no_reading(line):
    assert heard(line) == [DeviceProtocolError]
    assert heard(line + b"t18180A000000FFFFFFFF\r") == [DeviceProtocolError, POSITIONS]


@given(st.binary(max_size=120) | st.text("tTrRz\r0123456789ABCDEF", max_size=120).map(str.encode))
def test_any_bytes_are_frames_or_device_errors(data):
    for result in heard(data):
        if isinstance(result, tuple):
            can_id, payload = result
            assert 0 <= can_id < 2**11
            assert len(payload) <= 8
