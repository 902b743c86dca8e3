"""Modbus/TCP on 127.0.0.1, as in MODBUS Messaging on TCP/IP Implementation Guide V1.0b."""

from __future__ import annotations

import asyncio
import math
import struct
from collections.abc import Callable
from typing import Literal, NamedTuple

from fitctl.drivers.modbus_dac.protocol import NO_SUCH_DEVICE
from fitctl.mocks.faults import Faults
from fitctl.mocks.modbus.pdu import PDU_BYTES_MAX, DataModel, answer, exception
from fitctl.mocks.tcp import Link, TcpServer

UnknownUnit = Literal["refuse", "ignore", "serve"]

_THIS_DEVICE = {0, 0xFF}  # a server that is reached by its IP address alone needs no unit
_AHEAD_BYTES_MAX = 16_384  # of requests that a client may send before their turn comes
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
    """Serves a data model to its clients.

    Parameters
    ----------
    model : DataModel
    faults : Faults
        With `WIRE_FAULTS` among its kinds.
    unit : int
        The device's own unit identifier; 0 and 255 are the device as well.
    unknown_unit : {"refuse", "ignore", "serve"}
        What requests to other units get: exception 0B as from a gateway, nothing, or the device itself.
    clients_max : float
        How many connections it has at once; without a limit by default.
    service_s : callable, optional
        How long the device is busy with a request PDU before it answers; it is busy with one request at a
        time, whoever sent it. Without it every answer is given at once.
    """

    def __init__(
        self,
        model: DataModel,
        faults: Faults,
        *,
        unit: int,
        unknown_unit: UnknownUnit,
        clients_max: float = math.inf,
        service_s: Callable[[bytes], float] | None = None,
    ) -> None:
        super().__init__(faults, lambda: _Link(self), clients_max)
        self._model = model
        self._service_s = service_s
        self._free_s = 0.0
        self._units = range(256) if unknown_unit == "serve" else {unit, *_THIS_DEVICE}
        self._ignores = unknown_unit == "ignore"

    def turn_s(self, request: Message) -> float | None:
        """Loop time at which a request that has just come is answered; None is at once."""
        if self._service_s is None:
            return None
        begin_s = max(self._free_s, asyncio.get_running_loop().time())
        self._free_s = begin_s + self._service_s(request.pdu)
        return self._free_s

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
        self._modbus = server
        self._pending = bytearray()
        self._busy = False

    def data_received(self, data: bytes) -> None:
        if self.wire.dead:
            self._pending.clear()
            return
        self._pending += data
        self._serve()
        if len(self._pending) > _AHEAD_BYTES_MAX:
            self.transport.abort()

    def _serve(self) -> None:
        try:
            while not self._busy and (request := pop_message(self._pending)) is not None:
                turn_s = self._modbus.turn_s(request)
                if turn_s is None:
                    self._answer(request)
                else:
                    self._busy = True
                    asyncio.get_running_loop().call_at(turn_s, self._take_turn, request)
        except ValueError:
            self.transport.abort()

    def _take_turn(self, request: Message) -> None:
        self._busy = False
        if not self.transport.is_closing():
            self._answer(request)
            self._serve()

    def _answer(self, request: Message) -> None:
        if framed := self._modbus.respond(request):
            self.wire.send(framed)
