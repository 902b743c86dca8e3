"""Modbus/TCP on 127.0.0.1, as in MODBUS Messaging on TCP/IP Implementation Guide V1.0b."""

from __future__ import annotations

from typing import Literal

from fitctl.drivers.modbus import Message, frame, pop_message
from fitctl.drivers.modbus_dac.protocol import NO_SUCH_DEVICE
from fitctl.mocks.faults import Faults
from fitctl.mocks.modbus.pdu import DataModel, answer, exception
from fitctl.mocks.tcp import Link, TcpServer

UnknownUnit = Literal["refuse", "ignore", "serve"]

_THIS_DEVICE = {0, 0xFF}  # a server that is reached by its IP address alone needs no unit


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
