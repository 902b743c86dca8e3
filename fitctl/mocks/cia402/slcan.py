"""An SLCAN (LAWICEL) adapter on TCP: CAN frames as lines of ASCII, several clients on one bus.

Source: LAWICEL CANUSB and CAN232 manuals. Commands end in CR; the answer is CR (or a value and CR) for
yes, BEL for no. A frame that is received comes as the same line as one that is sent.

Known limitations: no acceptance filters (``M``, ``m``), no bit-timing registers (``s``), no polling
(``P``, ``A``, ``X``): all answer BEL. Each connection is an adapter of its own, whose settings are gone
when it closes. The bus has no arbitration, no bit time, and no errors but those of faults.
Invented constants: version and serial number; what a client may leave unread (`UNREAD_LIMIT_BYTES`).
"""

from __future__ import annotations

import asyncio
import socket
from collections.abc import Callable
from typing import cast

from fitctl.mocks.cia402.slcan_frames import CanFrame, decode_frame, encode_frame
from fitctl.mocks.faults import Faults, Wire

OK = b"\r"
BELL = b"\a"
VERSION = b"V1013"
SERIAL_NUMBER = b"NFIT1"
BITRATES = {
    b"S0": 10000,
    b"S1": 20000,
    b"S2": 50000,
    b"S3": 100000,
    b"S4": 125000,
    b"S5": 250000,
    b"S6": 500000,
    b"S7": 800000,
    b"S8": 1000000,
}
FLAG_RECEIVE_FULL = 0x01
FLAG_BUS_ERROR = 0x80
LONGEST_LINE_BYTES = 32
UNREAD_LIMIT_BYTES = 65536
_STAMP_MS = 60000


class _Client(asyncio.Protocol):
    """One TCP connection: an adapter of its own on the shared bus."""

    def __init__(self, adapter: SlcanAdapter) -> None:
        self._adapter = adapter
        self._unfinished = b""
        self._answers = bytearray()
        self._collecting = False
        self._bitrate: int | None = None
        self._stamps = False
        self._listens_only = False
        self._flags = 0
        self._wire = Wire(adapter.faults, self._out)
        self.transport: asyncio.Transport | None = None
        self.is_open = False

    @property
    def on_bus(self) -> bool:
        """Open at the bit rate of the bus; at another one nothing can be heard."""
        return self.is_open and self._bitrate == self._adapter.bitrate

    # ------------------------------------------------------------ the connection
    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._adapter.clients.add(self)
        if self._adapter.faults.away:
            self.transport.abort()

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self._wire.close()
        self._adapter.clients.discard(self)

    def data_received(self, data: bytes) -> None:
        if self._wire.dead:
            self._unfinished = b""
            return
        # What one segment brings is answered in one segment: RPDO and SYNC often come together.
        self._collecting = True
        *lines, self._unfinished = (self._unfinished + data).split(b"\r")
        for line in lines:
            self._command(line)
        if len(self._unfinished) > LONGEST_LINE_BYTES:
            self._unfinished = b""
            self._wire.send(BELL)
        self._collecting = False
        self._flush()

    def deliver(self, frame: CanFrame, line: bytes) -> None:
        """Pass on a frame of the bus, unless this client has stopped reading."""
        if self.transport and self.transport.get_write_buffer_size() > UNREAD_LIMIT_BYTES:
            self._flags |= FLAG_RECEIVE_FULL
        elif self._stamps:
            milliseconds = int(asyncio.get_running_loop().time() * 1e3) % _STAMP_MS
            self._wire.send(encode_frame(frame, b"%04X" % milliseconds))
        else:
            self._wire.send(line)

    def _out(self, answer: bytes) -> None:
        """What the wire lets pass goes at once, or with the rest of this segment's answers."""
        self._answers += answer
        if not self._collecting:
            self._flush()

    def _flush(self) -> None:
        if self._answers and self.transport:
            self.transport.write(bytes(self._answers))
        self._answers.clear()

    # ------------------------------------------------------------ the commands
    def _command(self, line: bytes) -> None:
        if not line:
            # An empty line is how clients clear a half-typed command; it is no error.
            self._wire.send(OK)
        elif line[:1] in b"tTrR":
            self._transmit(line)
        else:
            answer = _COMMANDS.get(line[:1], _refuse)(self, line)
            self._wire.send(BELL if answer is None else answer + OK)

    def _set_bitrate(self, line: bytes) -> bytes | None:
        if line not in BITRATES or self.is_open:
            return None
        self._bitrate = BITRATES[line]
        return b""

    def _set_stamps(self, line: bytes) -> bytes | None:
        if line not in {b"Z0", b"Z1"} or self.is_open:
            return None
        self._stamps = line == b"Z1"
        return b""

    def _open(self, line: bytes) -> bytes | None:
        if line not in {b"O", b"L"} or self.is_open or self._bitrate is None:
            return None
        self.is_open = True
        self._listens_only = line == b"L"
        return b""

    def _close(self, line: bytes) -> bytes | None:
        if line != b"C" or not self.is_open:
            return None
        self.is_open = False
        return b""

    def _status(self, line: bytes) -> bytes | None:
        if line != b"F" or not self.is_open:
            return None
        no_bus = self._adapter.severed or not self.on_bus
        flags = self._flags | (FLAG_BUS_ERROR if no_bus else 0)
        self._flags = 0
        return b"F%02X" % flags

    def _version(self, line: bytes) -> bytes | None:
        return {b"V": VERSION, b"N": SERIAL_NUMBER}.get(line)

    def _transmit(self, line: bytes) -> None:
        try:
            frame = decode_frame(line)
        except ValueError:
            self._wire.send(BELL)
            return
        if not self.is_open or self._listens_only:
            self._wire.send(BELL)
            return
        self._wire.send(b"Z\r" if frame.extended else b"z\r")
        if self.on_bus:
            self._adapter.from_client(self, frame)


def _refuse(_client: _Client, _line: bytes) -> None:
    return None


_COMMANDS: dict[bytes, Callable[[_Client, bytes], bytes | None]] = {
    b"S": _Client._set_bitrate,
    b"Z": _Client._set_stamps,
    b"O": _Client._open,
    b"L": _Client._open,
    b"C": _Client._close,
    b"F": _Client._status,
    b"V": _Client._version,
    b"N": _Client._version,
}
"""Each takes its line and gives what stands before the CR of a yes, or None for a no."""


class SlcanAdapter:
    """The TCP server and the bus behind it.

    Parameters
    ----------
    bitrate : int
        Of the bus; a client that opens at another one hears nothing.
    faults : Faults
        With `WIRE_FAULTS` among its kinds.
    received : callable
        Called with each :class:`CanFrame` that a client puts on the bus.

    Attributes
    ----------
    severed : bool
        The CAN cable between the adapter and the drive is cut.
    """

    def __init__(self, bitrate: int, faults: Faults, received: Callable[[CanFrame], None]) -> None:
        self.bitrate = bitrate
        self.faults = faults
        self.clients: set[_Client] = set()
        self.severed = False
        self._received = received
        self._server: asyncio.Server | None = None
        faults.on_change(self._cut_connections)

    async def start(self, port: int) -> int:
        """Listen on 127.0.0.1; returns the port, which is a free one if `port` is 0."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Client(self), "127.0.0.1", port)
        return int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Stop listening and drop every client; safe to call twice."""
        if self._server is None:
            return
        self._server.close()
        self._drop_clients()
        await self._server.wait_closed()
        self._server = None

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame with an 11-bit identifier on the bus, from the drive."""
        if not self.severed:
            self._deliver(CanFrame(can_id, data), None)

    def from_client(self, sender: _Client, frame: CanFrame) -> None:
        """Put a client's frame on the bus: the other clients hear it, and so does the drive."""
        if len(self.clients) > 1:
            self._deliver(frame, sender)
        if not self.severed:
            self._received(frame)

    def _deliver(self, frame: CanFrame, sender: _Client | None) -> None:
        line = encode_frame(frame)
        for client in self.clients:
            if client is not sender and client.on_bus:
                client.deliver(frame, line)

    def _cut_connections(self, _kind: str) -> None:
        if self.faults.away:
            self._drop_clients()

    def _drop_clients(self) -> None:
        for client in list(self.clients):
            if client.transport:
                client.transport.abort()
