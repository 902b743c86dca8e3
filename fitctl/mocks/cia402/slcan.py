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
import re
from collections.abc import Callable
from typing import NamedTuple, cast

from fitctl.mocks.faults import Faults, Wire
from fitctl.mocks.tcp import Link, TcpServer

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


def encode_frame(frame: CanFrame, stamp: bytes = b"") -> bytes:
    """A frame as a line, CR included; `stamp` is the time of its receipt where that is wanted."""
    can_id = b"%08X" % frame.can_id if frame.extended else b"%03X" % frame.can_id
    if frame.remote_length is not None:
        kind = b"R" if frame.extended else b"r"
        return b"%b%b%d%b\r" % (kind, can_id, frame.remote_length, stamp)
    kind = b"T" if frame.extended else b"t"
    digits = frame.data.hex().upper().encode()
    return b"%b%b%d%b%b\r" % (kind, can_id, len(frame.data), digits, stamp)


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


class _Client(Link):
    """One TCP connection: an adapter of its own on the shared bus."""

    def __init__(self, adapter: SlcanAdapter) -> None:
        super().__init__(adapter)
        self._adapter = adapter
        self._unfinished = b""
        self._answers = bytearray()
        self._collecting = False
        self._bitrate: int | None = None
        self._stamps = False
        self._listens_only = False
        self._flags = 0
        self.is_open = False

    @property
    def on_bus(self) -> bool:
        """Open at the bit rate of the bus; at another one nothing can be heard."""
        return self.is_open and self._bitrate == self._adapter.bitrate

    # ------------------------------------------------------------ the connection
    def data_received(self, data: bytes) -> None:
        if self.wire.dead:
            self._unfinished = b""
            return
        # What one segment brings is answered in one segment: RPDO and SYNC often come together.
        self._collecting = True
        *lines, self._unfinished = (self._unfinished + data).split(b"\r")
        for line in lines:
            self._command(line)
        if len(self._unfinished) > LONGEST_LINE_BYTES:
            self._unfinished = b""
            self.wire.send(BELL)
        self._collecting = False
        self.write(b"")

    def deliver(self, frame: CanFrame, line: bytes) -> None:
        """Pass on a frame of the bus, unless this client has stopped reading."""
        if self.transport.get_write_buffer_size() > UNREAD_LIMIT_BYTES:
            self._flags |= FLAG_RECEIVE_FULL
        elif self._stamps:
            milliseconds = int(asyncio.get_running_loop().time() * 1e3) % _STAMP_MS
            self.wire.send(encode_frame(frame, b"%04X" % milliseconds))
        else:
            self.wire.send(line)

    def write(self, data: bytes) -> None:
        """Send at once, or with the rest of this segment's answers."""
        self._answers += data
        if self._answers and not self._collecting:
            super().write(bytes(self._answers))
            self._answers.clear()

    def pause_writing(self) -> None:
        """Go on reading: frames that do not fit are dropped, and the status flags say so."""

    # ------------------------------------------------------------ the commands
    def _command(self, line: bytes) -> None:
        if not line:
            # An empty line is how clients clear a half-typed command; it is no error.
            self.wire.send(OK)
        elif line[:1] in b"tTrR":
            self._transmit(line)
        else:
            answer = _COMMANDS.get(line[:1], _refuse)(self, line)
            self.wire.send(BELL if answer is None else answer + OK)

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
            self.wire.send(BELL)
            return
        if not self.is_open or self._listens_only:
            self.wire.send(BELL)
            return
        self.wire.send(b"Z\r" if frame.extended else b"z\r")
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


class SlcanAdapter(TcpServer):
    """The TCP server and the bus behind it.

    Parameters
    ----------
    bitrate : int
        Of the bus; a client that opens at another one hears nothing.
    faults : Faults
        With `WIRE_FAULTS` among its kinds.
    received : callable, optional
        Called with each :class:`CanFrame` that a client puts on the bus; others by :meth:`attach`.

    Attributes
    ----------
    severed : bool
        The CAN cable between the adapter and all drives is cut.
    """

    def __init__(
        self, bitrate: int, faults: Faults, received: Callable[[CanFrame], None] | None = None
    ) -> None:
        super().__init__(faults, lambda: _Client(self))
        self.bitrate = bitrate
        self.severed = False
        self._receivers = [] if received is None else [received]

    def attach(self, received: Callable[[CanFrame], None]) -> None:
        """Put one more drive on the bus; `received` is called as the constructor's."""
        self._receivers.append(received)

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame with an 11-bit identifier on the bus, from a drive."""
        if not self.severed:
            self._deliver(CanFrame(can_id, data), None)

    def send_line(self, line: bytes) -> None:
        """Put a frame's line on the bus, from a drive whose faults may have spoilt it."""
        try:
            frame = decode_frame(line.removesuffix(b"\r"))
        except ValueError:
            return  # a controller throws a frame with a wrong check sum away
        self.send(frame.can_id, frame.data)

    def from_client(self, sender: _Client, frame: CanFrame) -> None:
        """Put a client's frame on the bus: the other clients hear it, and so do the drives."""
        if len(self.links) > 1:
            self._deliver(frame, sender)
        if not self.severed:
            for received in self._receivers:
                received(frame)

    def _deliver(self, frame: CanFrame, sender: _Client | None) -> None:
        line = encode_frame(frame)
        for client in cast(set[_Client], self.links):
            if client is not sender and client.on_bus:
                client.deliver(frame, line)


class SharedBus:
    """One drive's place on a bus with other drives, which do not hear it; the drive's faults are its own.

    Where an adapter with one drive cuts connections (``disconnect``, ``reboot``, ``freeze``), the drive is
    silent here and hears nothing: the adapter and the other drives go on.

    Parameters
    ----------
    adapter : SlcanAdapter
    faults : Faults
        Of the drive.
    received : callable
        Called with each frame that the drive hears.

    Attributes
    ----------
    severed : bool
        The drive's own cable is cut.
    """

    def __init__(
        self, adapter: SlcanAdapter, faults: Faults, received: Callable[[CanFrame], None]
    ) -> None:
        self.severed = False
        self._wire = Wire(faults, adapter.send_line)
        self._received = received
        adapter.attach(self._hear)

    def send(self, can_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        if not self.severed:
            self._wire.send(encode_frame(CanFrame(can_id, data)))

    def _hear(self, frame: CanFrame) -> None:
        if not (self.severed or self._wire.dead):
            self._received(frame)

    async def start(self, port: int) -> int:
        """Be there; the adapter listens by itself at `port`."""
        return port

    async def stop(self) -> None:
        """Forget what is still to be sent."""
        self._wire.close()
