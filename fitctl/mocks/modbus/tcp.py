"""Modbus/TCP on 127.0.0.1, as in MODBUS Messaging on TCP/IP Implementation Guide V1.0b."""

from __future__ import annotations

import struct
from typing import Literal, NamedTuple

from fitctl.drivers.modbus_dac.protocol import NO_SUCH_DEVICE
from fitctl.mocks.faults import Faults
from fitctl.mocks.modbus.pdu import PDU_BYTES_MAX, DataModel, answer, exception
from fitctl.mocks.tcp import Link, TcpServer

UnknownUnit = Literal["refuse", "ignore", "serve"]

_THIS_DEVICE = {0, 0xFF}  # a server that is reached by its IP address alone needs no unit
_HEADER = struct.Struct(">HHHB")  # transaction, protocol, length from the unit on, unit


class Message(NamedTuple):
    """One message without its frame; `protocol` is 0 for Modbus."""

    transaction: int
    unit: int
    pdu: bytes
    protocol: int = 0


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A PDU in its frame."""
    return _HEADER.pack(transaction, 0, 1 + len(pdu), unit) + pdu


def pop_message(pending: bytearray) -> Message | None:
    """Remove the first whole message from `pending`; None while there is none.

    Raises
    ------
    ValueError
        If no message can be that long, so that nobody knows where the next one begins.
    """
    if len(pending) < _HEADER.size:
        return None
    transaction, protocol, length, unit = _HEADER.unpack_from(pending)
    if not 2 <= length <= 1 + PDU_BYTES_MAX:
        msg = f"protocol {protocol}, length {length}"
        raise ValueError(msg)
    end = _HEADER.size - 1 + length
    if len(pending) < end:
        return None
    pdu = bytes(pending[_HEADER.size : end])
    del pending[:end]
    return Message(transaction, unit, pdu, protocol)


class ModbusTcpServer(TcpServer):
    """Serves a data model to any number of clients.

    Parameters
    ----------
    model : DataModel
    faults : Faults
        With `WIRE_FAULTS` among its kinds.
    unit : int
        The device's own unit identifier; 0 and 255 are the device as well.
    unknown_unit : {"refuse", "ignore", "serve"}
        What requests to other units get: exception 0B as from a gateway, nothing, or the device itself.
    """

    def __init__(
        self, model: DataModel, faults: Faults, *, unit: int, unknown_unit: UnknownUnit
    ) -> None:
        super().__init__(faults, lambda: _Link(self))
        self._model = model
        self._units = range(256) if unknown_unit == "serve" else {unit, *_THIS_DEVICE}
        self._ignores = unknown_unit == "ignore"

    def respond(self, request: Message) -> bytes:
        """The framed answer to a request; empty where it gets none, as one of another protocol."""
        if request.protocol != 0:
            return b""
        if request.unit in self._units:
            pdu = answer(request.pdu, self._model)
        elif self._ignores:
            return b""
        else:
            pdu = exception(request.pdu[0], NO_SUCH_DEVICE)
        return frame(request.transaction, request.unit, pdu)


class _Link(Link):
    """One client."""

    def __init__(self, server: ModbusTcpServer) -> None:
        super().__init__(server)
        self._respond = server.respond
        self._pending = bytearray()

    def data_received(self, data: bytes) -> None:
        if self.wire.dead:
            self._pending.clear()
            return
        self._pending += data
        try:
            while (request := pop_message(self._pending)) is not None:
                if framed := self._respond(request):
                    self.wire.send(framed)
        except ValueError:
            self.transport.abort()
