"""Modbus/TCP on 127.0.0.1, as in MODBUS Messaging on TCP/IP Implementation Guide V1.0b."""

from __future__ import annotations

import asyncio
import struct
from collections.abc import Iterator
from typing import Literal, NamedTuple, cast

from fitctl.drivers.modbus_dac.protocol import NO_SUCH_DEVICE, PDU_BYTES_MAX
from fitctl.mocks.faults import Faults, Wire
from fitctl.mocks.modbus.pdu import DataModel, answer, exception

UnknownUnit = Literal["refuse", "ignore", "serve"]

_HEADER = struct.Struct(">HHHB")  # transaction, protocol, length from the unit on, unit
_THIS_DEVICE = {0, 0xFF}  # a server that is reached by its IP address alone needs no unit


class Adu(NamedTuple):
    """One message, taken out of its frame."""

    transaction: int
    unit: int
    pdu: bytes


class OutOfStep(ValueError):
    """What came is not the header of a message, so nobody knows where the next one begins."""


def take_messages(pending: bytearray) -> Iterator[Adu]:
    """Take the whole messages off the front of `pending`; those of other protocols are thrown away.

    Raises
    ------
    OutOfStep
        If a length cannot be.
    """
    while len(pending) >= _HEADER.size:
        transaction, protocol, length, unit = _HEADER.unpack_from(pending)
        if not 2 <= length <= 1 + PDU_BYTES_MAX:
            msg = f"a length of {length}"
            raise OutOfStep(msg)
        end = _HEADER.size - 1 + length
        if len(pending) < end:
            return
        pdu = bytes(pending[_HEADER.size : end])
        del pending[:end]
        if protocol == 0:
            yield Adu(transaction, unit, pdu)


def frame(message: Adu) -> bytes:
    """A message in its frame."""
    head = _HEADER.pack(message.transaction, 0, 1 + len(message.pdu), message.unit)
    return head + message.pdu


class ModbusTcpServer:
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
    port : int
        Where to listen; 0 for any free port.
    """

    def __init__(
        self,
        model: DataModel,
        faults: Faults,
        *,
        unit: int,
        unknown_unit: UnknownUnit,
        port: int,
    ) -> None:
        self.links: set[_Link] = set()
        self.faults = faults
        self._model = model
        self._units = range(256) if unknown_unit == "serve" else {unit, *_THIS_DEVICE}
        self._ignores = unknown_unit == "ignore"
        self._port = port
        self._listener: asyncio.Server | None = None
        faults.on_change(self._cut_links)

    async def start(self) -> int:
        """Listen; returns the port.

        Raises
        ------
        OSError
            If the port is taken.
        """
        loop = asyncio.get_running_loop()
        self._listener = await loop.create_server(lambda: _Link(self), "127.0.0.1", self._port)
        port: int = self._listener.sockets[0].getsockname()[1]
        return port

    async def stop(self) -> None:
        """Disconnect everyone and stop listening; safe to call twice."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._abort_links()
        await asyncio.sleep(0)  # transports close their sockets on the loop's next turn

    def respond(self, request: Adu) -> bytes:
        """The framed answer to a request; empty where it gets none."""
        if request.unit in self._units:
            pdu = answer(request.pdu, self._model)
        elif self._ignores:
            return b""
        else:
            pdu = exception(request.pdu[0], NO_SUCH_DEVICE)
        return frame(request._replace(pdu=pdu))

    def _cut_links(self, kind: str) -> None:
        if self.faults.away:
            self._abort_links()

    def _abort_links(self) -> None:
        for link in list(self.links):
            link.transport.abort()


class _Link(asyncio.Protocol):
    """One client."""

    transport: asyncio.Transport

    def __init__(self, server: ModbusTcpServer) -> None:
        self._server = server
        self._pending = bytearray()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._wire = Wire(self._server.faults, self.transport.write)
        self._server.links.add(self)
        if self._server.faults.away:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        if self._wire.dead:
            self._pending.clear()
            return
        self._pending += data
        try:
            for request in take_messages(self._pending):
                if framed := self._server.respond(request):
                    self._wire.send(framed)
        except OutOfStep:
            self.transport.abort()

    # Who sends and never reads is not read from either, so that nothing piles up.
    def pause_writing(self) -> None:
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        self.transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        self._wire.close()
        self._server.links.discard(self)
