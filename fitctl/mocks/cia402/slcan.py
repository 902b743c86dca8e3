"""An SLCAN (LAWICEL) adapter on TCP: CAN frames as lines of ASCII, several clients on one bus.

Source: LAWICEL CANUSB and CAN232 manuals. Commands end in CR; the answer is CR (or a value and CR) for
yes, BEL for no. A frame that is received comes as the same line as one that is sent.

Known limitations: no listen-only (``L``), no time stamps (``Z``), no acceptance filters (``M``, ``m``), no
bit-timing registers (``s``): all answer BEL. The bus has no arbitration, no bit time and no errors.
Invented constants: version and serial number; what a client may leave unread (`UNREAD_LIMIT_BYTES`).
"""

from __future__ import annotations

import asyncio
import re
import socket
from collections.abc import Callable
from typing import NamedTuple, cast

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

_FRAME = re.compile(
    rb"(?:[tr]([0-7][0-9A-Fa-f]{2})|[TR]([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)"
)


class CanFrame(NamedTuple):
    """One classic CAN frame.

    Attributes
    ----------
    can_id : int
        11 bits, or 29 if `extended`.
    data : bytes
        Up to eight; empty in a remote frame.
    extended : bool
        29-bit identifier.
    remote_length : int or None
        None for a data frame; the length asked for by a remote frame.
    """

    can_id: int
    data: bytes
    extended: bool = False
    remote_length: int | None = None


def encode_frame(frame: CanFrame) -> bytes:
    """A frame as a line, CR included."""
    can_id = b"%08X" % frame.can_id if frame.extended else b"%03X" % frame.can_id
    if frame.remote_length is not None:
        return (b"R" if frame.extended else b"r") + can_id + b"%d\r" % frame.remote_length
    kind = b"T" if frame.extended else b"t"
    return b"%b%b%d%b\r" % (kind, can_id, len(frame.data), frame.data.hex().upper().encode())


def decode_frame(line: bytes) -> CanFrame:
    """A line, without its CR, as a frame.

    Raises
    ------
    ValueError
        If it is not exactly one frame: wrong digits, or data that do not fit the length.
    """
    match = _FRAME.fullmatch(line)
    if match is None:
        msg = f"not an SLCAN frame: {line!r}"
        raise ValueError(msg)
    standard, extended, length_digit, digits = match.groups()
    length = int(length_digit)
    remote = line[:1] in {b"r", b"R"}
    if len(digits) != (0 if remote else 2 * length):
        msg = f"length {length} does not fit the data of {line!r}"
        raise ValueError(msg)
    return CanFrame(
        int(extended or standard, 16),
        bytes.fromhex(digits.decode()),
        extended is not None,
        length if remote else None,
    )


class _Client(asyncio.Protocol):
    """One TCP connection: an adapter of its own on the shared bus."""

    def __init__(self, adapter: SlcanAdapter) -> None:
        self._adapter = adapter
        self._unfinished = b""
        self._answers = bytearray()
        self._collecting = False
        self._bitrate: int | None = None
        self._flags = 0
        self.transport: asyncio.Transport | None = None
        self.is_open = False

    @property
    def on_bus(self) -> bool:
        """Open at the bit rate of the bus; at another one nothing can be heard."""
        return self.is_open and self._bitrate == self._adapter.bitrate

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast("asyncio.Transport", transport)
        transport.get_extra_info("socket").setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._adapter.clients.add(self)

    def connection_lost(self, exc: Exception | None) -> None:
        self.transport = None
        self._adapter.clients.discard(self)

    def data_received(self, data: bytes) -> None:
        # What one segment brings is answered in one segment: RPDO and SYNC often come together.
        self._collecting = True
        *lines, self._unfinished = (self._unfinished + data).split(b"\r")
        for line in lines:
            self._command(line)
        if len(self._unfinished) > LONGEST_LINE_BYTES:
            self._unfinished = b""
            self.send(BELL)
        self._collecting = False
        self._flush()

    def deliver(self, line: bytes) -> None:
        """Pass on a frame of the bus, unless this client has stopped reading."""
        if self.transport and self.transport.get_write_buffer_size() > UNREAD_LIMIT_BYTES:
            self._flags |= FLAG_RECEIVE_FULL
        else:
            self.send(line)

    def send(self, answer: bytes) -> None:
        """Answer, at once or with the rest of this segment's answers."""
        self._answers += answer
        if not self._collecting:
            self._flush()

    def _flush(self) -> None:
        if self._answers and self.transport:
            self.transport.write(bytes(self._answers))
        self._answers.clear()

    def _command(self, line: bytes) -> None:
        kind = line[:1]
        if kind in b"tTrR" and kind:
            self._transmit(kind, line)
        elif line in BITRATES and not self.is_open:
            self._bitrate = BITRATES[line]
            self.send(OK)
        elif line == b"O" and not self.is_open and self._bitrate is not None:
            self.is_open = True
            self.send(OK)
        elif line == b"C" and self.is_open:
            self.is_open = False
            self.send(OK)
        elif line == b"V":
            self.send(VERSION + OK)
        elif line == b"N":
            self.send(SERIAL_NUMBER + OK)
        elif line == b"F" and self.is_open:
            flags = self._flags | (0 if self.on_bus else FLAG_BUS_ERROR)
            self._flags = 0
            self.send(b"F%02X" % flags + OK)
        else:
            # An empty line is how clients clear a half-typed command; it is no error.
            self.send(BELL if line else OK)

    def _transmit(self, kind: bytes, line: bytes) -> None:
        try:
            frame = decode_frame(line)
        except ValueError:
            self.send(BELL)
            return
        if not self.is_open:
            self.send(BELL)
            return
        self.send(b"z\r" if kind in b"tr" else b"Z\r")
        if self.on_bus:
            self._adapter.from_client(self, frame)


class SlcanAdapter:
    """The TCP server and the bus behind it.

    Parameters
    ----------
    bitrate : int
        Of the bus; a client that opens at another one hears nothing.
    received : callable
        Called with each :class:`CanFrame` that a client puts on the bus.
    """

    def __init__(self, bitrate: int, received: Callable[[CanFrame], None]) -> None:
        self.bitrate = bitrate
        self.clients: set[_Client] = set()
        self._received = received
        self._server: asyncio.Server | None = None

    async def start(self, port: int) -> int:
        """Listen on 127.0.0.1; returns the port, which is a free one if `port` is 0."""
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(lambda: _Client(self), "127.0.0.1", port)
        return int(self._server.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Stop listening and drop every client."""
        if self._server is None:
            return
        self._server.close()
        self.drop_clients()
        await self._server.wait_closed()
        self._server = None

    def drop_clients(self) -> None:
        """Cut every connection, as a pulled cable would; clients may connect again."""
        for client in list(self.clients):
            if client.transport:
                client.transport.abort()

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame with an 11-bit identifier on the bus, from the drive."""
        line = encode_frame(CanFrame(can_id, data))
        for client in self.clients:
            if client.on_bus:
                client.deliver(line)

    def from_client(self, sender: _Client, frame: CanFrame) -> None:
        """Put a client's frame on the bus: the other clients hear it, and so does the drive."""
        if len(self.clients) > 1:
            line = encode_frame(frame)
            for client in self.clients:
                if client is not sender and client.on_bus:
                    client.deliver(line)
        self._received(frame)
