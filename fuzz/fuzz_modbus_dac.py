"""Fuzz what reads Modbus: the mock's framing and functions, and the driver over both wires.

The first byte chooses who reads the rest. ``python fuzz/fuzz_modbus_dac.py CORPUS`` runs atheris.
"""

from __future__ import annotations

import socket

import numpy as np

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceError
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.drivers.modbus_dac.link import RtuLink, TcpLink, limit_receiving
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.modbus import rtu, tcp
from fitctl.mocks.modbus.pdu import DataModel, answer

_DAC = (
    load_rig(default_rig_path())
    .loops["right"]
    .fsm.dac.model_copy(update={"response_timeout_s": 0.001})
)
_MODEL = DataModel(
    range(2000),
    lambda address, count: [1] * count,
    lambda address, values: None,
    (b"maker", b"model", b"1.0"),
)


def read_pdu(data: bytes) -> None:
    """A request gets its own answer or an exception of the standard."""
    if not data:
        return
    got = answer(data[:253], _MODEL)
    assert len(got) <= 253
    assert got[0] & 0x7F == data[0] & 0x7F
    if got[0] & 0x80:
        assert len(got) == 2
        assert 1 <= got[1] <= 4


def read_tcp(data: bytes) -> None:
    """A stream gives whole messages, each with an answer, or is out of step."""
    server = tcp.ModbusTcpServer(_MODEL, Faults(WIRE_FAULTS), unit=1, unknown_unit="refuse")
    pending = bytearray(data)
    try:
        while (message := tcp.pop_message(pending)) is not None:
            back = tcp.pop_message(bytearray(server.respond(message)))
            if message.protocol == 0:
                assert back is not None
                assert (back.transaction, back.unit) == (message.transaction, message.unit)
            else:
                assert back is None
    except ValueError:
        return
    assert len(pending) < 260


def read_rtu(data: bytes) -> None:
    """What comes between two silences gets a sound frame or nothing, whatever its check is."""
    server = rtu.ModbusRtuServer(_MODEL, Faults(WIRE_FAULTS), unit=1, baud_rate=115200)
    for frame in (data, data + rtu.crc16(data)):
        framed = server.respond(frame)
        assert not framed or rtu.parse_frame(framed) is not None


def _write(dac: ModbusDac) -> None:
    dac.send_v(np.zeros(3))
    dac.confirm()


def _use(dac: ModbusDac) -> None:
    """Nothing but device errors come out, and no voltage that the D/A does not have."""
    for request in (dac._identify, dac.read_v, lambda: _write(dac)):
        try:
            got = request()
        except DeviceError:
            continue
        if isinstance(got, np.ndarray):
            assert got.shape == (3,)
            assert np.all((got >= 0) & (got <= _DAC.full_scale_v))


def drive_tcp(data: bytes) -> None:
    """The driver, and a station that says `data` whatever it is asked."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(data[:4096])
        theirs.shutdown(socket.SHUT_WR)
        link = TcpLink.__new__(TcpLink)
        link._unit, link._timeout_s, link._transaction = _DAC.device_id, _DAC.response_timeout_s, 0
        link._pending, link._socket = bytearray(), ours
        limit_receiving(ours, _DAC.response_timeout_s)
        dac = ModbusDac(_DAC)
        dac._link = link
        _use(dac)
        dac.close()


class _Port:
    """A serial port whose far end answers every request by the same bytes."""

    is_open = True

    def __init__(self, data: bytes) -> None:
        self._answer = data
        self._buffer = b""

    @property
    def in_waiting(self) -> int:
        return len(self._buffer)

    def write(self, request: bytes) -> int:
        self._buffer = self._answer
        return len(request)

    def read(self, size: int) -> bytes:
        got, self._buffer = self._buffer[:size], self._buffer[size:]
        return got

    def close(self) -> None:
        self._buffer = b""


def drive_rtu(data: bytes) -> None:
    """The driver on a serial port; once as the bytes are, once with a right check at their end."""
    for said in (data, data + rtu.crc16(data)):
        link = RtuLink.__new__(RtuLink)
        link._unit, link._timeout_s = _DAC.device_id, _DAC.response_timeout_s
        link._silence_s = link._free_s = 0.0
        link._port = _Port(said)
        dac = ModbusDac(_DAC)
        dac._link = link
        _use(dac)
        dac.close()


_READERS = (read_pdu, read_tcp, read_rtu, drive_tcp, drive_rtu)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - the name that fuzzers call
    """Run one input."""
    if data:
        _READERS[data[0] % len(_READERS)](data[1:])


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
