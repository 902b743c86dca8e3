"""Modbus RTU on a pty, as in MODBUS over Serial Line Specification and Implementation Guide V1.02."""

from __future__ import annotations

import asyncio
from collections.abc import Callable

from fitctl.drivers.modbus_dac.protocol import rtu_silence_s
from fitctl.mocks.faults import Faults, Wire
from fitctl.mocks.modbus.pdu import BROADCAST_FUNCTIONS, PDU_BYTES_MAX, DataModel, answer
from fitctl.mocks.pty import Pty

_BROADCAST = 0
_BITS_PER_BYTE = 11  # start, eight data, parity or a second stop, stop
_FRAME_BYTES_MAX = 1 + PDU_BYTES_MAX + 2


def crc16(data: bytes) -> bytes:
    """The check of a frame, low byte first (section 2.5.1.2)."""
    crc = 0xFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc.to_bytes(2, "little")


def frame(unit: int, pdu: bytes) -> bytes:
    """A PDU in its frame."""
    message = bytes([unit]) + pdu
    return message + crc16(message)


def parse_frame(data: bytes) -> tuple[int, bytes] | None:
    """Unit and PDU of what came between two silences; None if that is not one whole frame."""
    if not 4 <= len(data) <= _FRAME_BYTES_MAX or crc16(data[:-2]) != data[-2:]:
        return None
    return data[0], data[1:-2]


class ModbusRtuServer:
    """Serves a data model on one end of a pty, at the pace of its baud rate.

    A frame ends with a silence. Who talks while the answer is on its way destroys it, as on a line of
    two wires. A client that has set the pty to another baud rate is not understood.

    Parameters
    ----------
    model : DataModel
    faults : Faults
        With `WIRE_FAULTS` among its kinds. On this line `disconnect` is an unplugged cable: silence.
    unit : int
        The device's own unit, 1 to 247.
    baud_rate : int
    """

    def __init__(self, model: DataModel, faults: Faults, *, unit: int, baud_rate: int) -> None:
        self._model = model
        self._unit = unit
        self._baud_rate = baud_rate
        self._silence_s = rtu_silence_s(baud_rate)
        self._byte_s = _BITS_PER_BYTE / baud_rate
        self._wire = Wire(faults, self._write)
        self._pending = bytearray()
        self._due: asyncio.TimerHandle | None = None
        self._pty: Pty | None = None

    async def start(self) -> str:
        """Open the pty; returns the path of the clients' end."""
        self._pty = Pty(self._baud_rate)
        self._pty.read_into(self._receive)
        return self._pty.path

    async def stop(self) -> None:
        """Close the pty; safe to call twice."""
        self._wire.close()
        self._cancel()
        if self._pty is not None:
            self._pty.close()
            self._pty = None

    def respond(self, data: bytes) -> bytes:
        """The framed answer to what came between two silences; empty where it gets none."""
        parsed = parse_frame(data)
        if parsed is None:
            return b""
        unit, request = parsed
        if unit == _BROADCAST:
            if request[0] in BROADCAST_FUNCTIONS:
                answer(request, self._model)
            return b""
        return frame(unit, answer(request, self._model)) if unit == self._unit else b""

    def _receive(self, data: bytes) -> None:
        if self._wire.dead or self._pty is None or not self._pty.is_at_our_baud_rate():
            self._pending.clear()
            return
        room = _FRAME_BYTES_MAX + 1 - len(self._pending)
        self._pending += data[:room]
        # A pty gives at once what a line gives byte by byte.
        self._after(len(data) * self._byte_s + self._silence_s, self._frame_ends)

    def _frame_ends(self) -> None:
        data = bytes(self._pending)
        self._pending.clear()
        if framed := self.respond(data):
            self._after(len(framed) * self._byte_s, lambda: self._wire.send(framed))

    def _after(self, delay_s: float, action: Callable[[], None]) -> None:
        self._cancel()
        self._due = asyncio.get_running_loop().call_later(delay_s, action)

    def _cancel(self) -> None:
        if self._due is not None:
            self._due.cancel()
            self._due = None

    def _write(self, data: bytes) -> None:
        if self._pty is not None:
            self._pty.write(data)
