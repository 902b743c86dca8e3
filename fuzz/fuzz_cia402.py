"""Fuzz what reads SLCAN and CANopen: the mock's adapter, drive and SDO server, and the driver's link and node.

The first byte chooses who reads the rest. ``python fuzz/fuzz_cia402.py CORPUS`` runs atheris.
"""

from __future__ import annotations

import asyncio
import math
import queue
import socket
import time
from collections.abc import Callable, Iterator
from types import SimpleNamespace
from typing import Any

from can import CanProtocol

from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.cia402.link import BulkSlcanBus, CanLink
from fitctl.drivers.cia402.node import Node
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceError
from fitctl.mocks.cia402.dictionary import SdoServer
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import CanFrame, _Client, decode_frame, encode_frame

_RIG_SIDEROSTAT = load_rig(default_rig_path()).loops["right"].siderostat
_DEVICE = _RIG_SIDEROSTAT.device.model_copy(update={"response_timeout_s": 0.001})
_SIDEROSTAT = _RIG_SIDEROSTAT.model_copy(update={"device": _DEVICE})
_TO_DRIVE = (0x601, 0x601, 0x601, 0x000, 0x080, 0x201, 0x301, 0x401, 0x77F, 0x123)
_FROM_DRIVE = (0x581, 0x581, 0x581, 0x181, 0x281, 0x081, 0x701, 0x123)
_LOOP = asyncio.new_event_loop()


class _Motors:
    """Stand still; are told finite velocities only."""

    def position_rad(self) -> tuple[float, float]:
        return 0.0, 0.0

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        assert math.isfinite(az)
        assert math.isfinite(el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Power is of no matter here."""


class _Transport:
    """Keeps what is sent."""

    def __init__(self) -> None:
        self.sent = b""

    def get_extra_info(self, _name: str) -> Any:
        return SimpleNamespace(setsockopt=lambda *_: None)

    def get_write_buffer_size(self) -> int:
        return 0

    def is_closing(self) -> bool:
        return False

    def write(self, data: bytes) -> None:
        self.sent += data

    def abort(self) -> None:
        """Nothing to close."""


def _frames(data: bytes, identifiers: tuple[int, ...]) -> Iterator[tuple[int, bytes]]:
    """Bytes as CAN frames: one chooses identifier and length, the data follow."""
    while data:
        can_id = identifiers[data[0] % len(identifiers)]
        length = 8 if data[0] >= 128 else data[0] // 16
        yield can_id, data[1 : 1 + length]
        data = data[1 + length :]


def _with_drive(use: Callable[[Cia402DriveMock, _Client], None]) -> None:
    """Let a fresh drive be used by one client; afterwards it can be reset and answers."""

    async def run() -> None:
        mock = Cia402DriveMock(_SIDEROSTAT, _Motors(), port=0)
        mock._reset_communication()
        transport = _Transport()
        client = _Client(mock._adapter)
        client.connection_made(transport)
        client.data_received(b"S8\rO\r")
        try:
            use(mock, client)
            client.data_received(b"\r\rC\rS8\rO\r")
            client.data_received(encode_frame(CanFrame(protocol.NMT_ID, b"\x81\x00")))
            transport.sent = b""
            client.data_received(b"t6018" + b"4000100000000000" + b"\r")
            assert b"t58184300100092" in transport.sent
        finally:
            mock._power_off()
            for event in mock._events:
                event.set_period(0)

    _LOOP.run_until_complete(run())


def read_line(data: bytes) -> None:
    """A line is a frame, which goes out as it came in, or a ValueError."""
    try:
        frame = decode_frame(data)
    except ValueError:
        return
    assert encode_frame(frame)[:-1].upper() == data.upper()


def serve_bytes(data: bytes) -> None:
    """The adapter and the drive behind it live through any bytes."""
    _with_drive(lambda _mock, client: client.data_received(data))


def serve_frames(data: bytes) -> None:
    """The drive lives through any frames."""

    def use(mock: Cia402DriveMock, _client: _Client) -> None:
        mock._receive(CanFrame(protocol.NMT_ID, b"\x01\x00"))
        for can_id, payload in _frames(data, _TO_DRIVE):
            mock._receive(CanFrame(can_id, payload))

    _with_drive(use)


def serve_sdo(data: bytes) -> None:
    """The SDO server answers by eight bytes or not at all."""

    def use(mock: Cia402DriveMock, _client: _Client) -> None:
        server = SdoServer(mock.dictionary)
        for start in range(0, len(data), 8):
            answer = server.answer(data[start : start + 8])
            assert answer is None or len(answer) == 8

    _with_drive(use)


class _Scripted:
    """A link whose far end says these frames, whatever it is told."""

    endpoint = Endpoint("drive", "nowhere")

    def __init__(self, data: bytes) -> None:
        self._frames = _frames(data, _FROM_DRIVE)

    def send(self, *frames: tuple[int, bytes]) -> None:
        for _can_id, data in frames:
            assert len(data) <= 8

    def receive(self, _timeout_s: float) -> tuple[int, bytes] | None:
        return next(self._frames, None)

    def close(self) -> None:
        """Nothing to close."""


def ask_node(data: bytes) -> None:
    """The master's services give values or device errors."""
    node = Node(_Scripted(data), _DEVICE)
    for question in (
        lambda: node.upload(0x1008, 0),
        lambda: node.read(0x6041, 0, "H"),
        lambda: node.write(0x6040, 0, "H", 6),
        lambda: node.text(0x1009),
        node.drain,
    ):
        try:
            question()
        except DeviceError:
            continue


def exchange(data: bytes) -> None:
    """Servo periods give readings of finite numbers, nothing, or device errors."""
    amplifiers = Cia402Amplifiers(_SIDEROSTAT)
    node = Node(_Scripted(data), _DEVICE)
    node.nmt_state = protocol.NmtState.OPERATIONAL
    node.handlers |= {0x181: amplifiers._on_positions, 0x281: amplifiers._on_statuswords}
    amplifiers._link = node
    amplifiers._status.feed(time.monotonic())
    for _ in range(1 + len(data) // 8):
        try:
            reading = amplifiers.exchange((1.0, -1.0))
        except DeviceError:
            continue
        assert reading is None or all(map(math.isfinite, (reading.time_s, *reading.position_rad)))
    amplifiers.close()


def hear_line(data: bytes) -> None:
    """The driver's SLCAN gives frames of at most eight bytes until the line is closed, or device errors."""
    ours, theirs = socket.socketpair()
    with ours, theirs:
        theirs.sendall(data[:4096])
        theirs.shutdown(socket.SHUT_WR)
        bus = object.__new__(BulkSlcanBus)
        bus._buffer = bytearray()
        bus._queue = queue.SimpleQueue()
        bus._batch = None
        bus._is_shutdown = True
        bus._can_protocol = CanProtocol.CAN_20
        bus._descriptor = ours.fileno()
        link = object.__new__(CanLink)
        link.endpoint = Endpoint("drive", "nowhere")
        link._bus = bus
        for _ in range(len(data) + 2):
            try:
                frame = link.receive(0.0)
            except DeviceError:
                continue
            assert frame is None or (0 <= frame[0] < 2**11 and len(frame[1]) <= 8)


_READERS = (read_line, serve_bytes, serve_frames, serve_sdo, ask_node, exchange, hear_line)


def TestOneInput(data: bytes) -> None:  # noqa: N802 - the name that fuzzers call
    """Run one input."""
    if data:
        _READERS[data[0] % len(_READERS)](data[1:])


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
