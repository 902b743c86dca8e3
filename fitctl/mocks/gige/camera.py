"""The mock camera's control side: who has control, and what each command and register does."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Command, MalformedPacketError, Register, Status
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.gige.acquisition import Acquisition
from fitctl.mocks.gige.memory import RegisterError
from fitctl.mocks.gige.registers import CameraClock, Registers

FAULTS = dict(WIRE_FAULTS)
Address = tuple[str, int]


class GigeCameraMock:
    """A GigE Vision 1.2 camera of one stream channel, on 127.0.0.1 only.

    Known limitations: Mono16 only; continuous acquisition only; no events, actions, message channel,
    FORCEIP, PENDING_ACK, chunk data or extended ids; the inter-packet delay register has no effect;
    the don't-fragment flag is kept and has no effect; a frame is sent in one go; the image is that of
    one instant, not blurred by the exposure; the stream goes to loopback addresses only; a broadcast
    DISCOVERY does not reach a socket that is bound to 127.0.0.1, one sent to 127.0.0.1 does.

    Invented constants: names and serial number; 125 MHz clock, 20 ppm fast, 1000 s after its reset;
    the temperature; before a client sets it: 25 Hz, 5 ms; at most 2000 Hz; a size of 8 px at least;
    eight frames kept for resending; registers from 0xA000 on.

    Parameters
    ----------
    camera : Camera
        Sensor size and frame delay; rate and exposure are for the client to set.
    render : callable
        ``render(mid_exposure_s)``: the uint16 image, shape (height_px, width_px), of that host
        monotonic time.
    port : int
        GVCP port; 0 for any free one.
    """

    def __init__(
        self, camera: Camera, render: Callable[[float], NDArray[np.uint16]], *, port: int
    ) -> None:
        self.faults = Faults(FAULTS)
        self._camera = camera
        self._render = render
        self._port = port
        self._clock = CameraClock()
        self._controller: Address | None = None
        self._lapse_s = 0.0
        self._lapse_timer: asyncio.TimerHandle | None = None
        self._endpoint: _Endpoint | None = None
        self._started: tuple[Acquisition, Registers] | None = None

    @property
    def acquisition(self) -> Acquisition:
        """The stream: counts, lateness and the packet-loss hook; exists once started."""
        return self._parts()[0]

    async def start(self) -> int:
        """Listen; returns the GVCP port."""
        acquisition = Acquisition(self._render, self._clock.ticks, self._camera.frame_delay_s)
        self._started = (acquisition, Registers(self._camera, self._clock, acquisition))
        loop = asyncio.get_running_loop()
        try:
            _, self._endpoint = await loop.create_datagram_endpoint(
                lambda: _Endpoint(self.answer), local_addr=("127.0.0.1", self._port)
            )
        except OSError:
            await self.stop()
            raise
        return self._endpoint.port

    async def stop(self) -> None:
        """Stop streaming and listening; safe to call twice."""
        if self._started is not None:
            self._release_control()
            self._started[0].close()
            self._started = None
        if self._endpoint is not None:
            await self._endpoint.close()
            self._endpoint = None

    def answer(self, packet: bytes, sender: Address) -> bytes | None:
        """What the camera answers to one GVCP datagram; None for silence."""
        try:
            command = protocol.decode_command(packet)
        except MalformedPacketError:
            return None  # not GVCP: a camera does not answer noise
        try:
            payload = self._execute(command.command, command.payload, sender)
        except MalformedPacketError:
            status, payload = Status.INVALID_HEADER, b""
        except RegisterError as error:
            status, payload = error.status, b""
        else:
            status = Status.SUCCESS
        if sender == self._controller:
            self._refresh_heartbeat()
        if not command.flags & protocol.FLAG_ACKNOWLEDGE:
            return None
        return protocol.encode_answer(command.command + 1, command.request_id, payload, status)

    def _execute(self, command: int, payload: bytes, sender: Address) -> bytes:
        acquisition, registers = self._parts()
        if command == Command.DISCOVERY:
            return registers.discovery()
        if command == Command.READREG:
            return b"".join(self._read(address, 4, sender) for address in _words(payload, 1))
        if command == Command.WRITEREG:
            words = _words(payload, 2)
            for address, value in zip(words[::2], words[1::2], strict=True):
                self._write(address, protocol.encode_words(value), sender)
            return protocol.encode_written(len(words) // 2)
        if command == Command.READMEM:
            address, count = protocol.decode_readmem(payload)
            if not 0 < count <= protocol.MEMORY_CHUNK_BYTES:
                raise RegisterError(Status.INVALID_PARAMETER)
            return protocol.encode_words(address) + self._read(address, count, sender)
        if command == Command.WRITEMEM:
            (address,) = _words(payload[:4], 1)
            self._write(address, payload[4:], sender)
            return protocol.encode_written(len(payload) - 4)
        if command == Command.PACKETRESEND:
            if sender == self._controller:
                acquisition.resend(protocol.decode_resend(payload))
            return b""
        raise RegisterError(Status.NOT_IMPLEMENTED)

    def _read(self, address: int, length: int, sender: Address) -> bytes:
        _, registers = self._parts()
        exclusive = registers.privilege() & protocol.CONTROL_EXCLUSIVE
        if exclusive and sender != self._controller and address != Register.CONTROL_PRIVILEGE:
            raise RegisterError(Status.ACCESS_DENIED)
        return registers.read(address, length)

    def _write(self, address: int, data: bytes, sender: Address) -> None:
        _, registers = self._parts()
        registers.check_writable(address, len(data))
        if address == Register.CONTROL_PRIVILEGE:
            self._set_control(int.from_bytes(data, "big"), sender)
        elif sender != self._controller:
            raise RegisterError(Status.ACCESS_DENIED)
        else:
            registers.write(address, data)

    def _set_control(self, value: int, sender: Address) -> None:
        if self._controller not in {None, sender}:
            raise RegisterError(Status.ACCESS_DENIED)
        privilege = value & (protocol.CONTROL | protocol.CONTROL_EXCLUSIVE)
        if privilege:
            self._controller = sender
            self._parts()[1].set_privilege(privilege)
        elif self._controller is not None:
            self._release_control()

    def _release_control(self) -> None:
        self._controller = None
        self._parts()[1].set_privilege(0)
        if self._lapse_timer is not None:
            self._lapse_timer.cancel()
            self._lapse_timer = None

    def _refresh_heartbeat(self) -> None:
        loop = asyncio.get_running_loop()
        self._lapse_s = loop.time() + self._parts()[1].heartbeat_s
        if self._lapse_timer is not None and self._lapse_timer.when() > self._lapse_s:
            self._lapse_timer.cancel()  # the time limit was made shorter
            self._lapse_timer = None
        if self._lapse_timer is None:
            self._lapse_timer = loop.call_at(self._lapse_s, self._check_lapse)

    def _check_lapse(self) -> None:
        """One timer for all refreshes: it goes on to the newest time, or control has lapsed."""
        loop = asyncio.get_running_loop()
        if loop.time() < self._lapse_s:
            self._lapse_timer = loop.call_at(self._lapse_s, self._check_lapse)
        else:
            self._release_control()

    def _parts(self) -> tuple[Acquisition, Registers]:
        if self._started is None:
            msg = "start() the mock camera first"
            raise RuntimeError(msg)
        return self._started


def _words(payload: bytes, group: int) -> tuple[int, ...]:
    """One or more groups of words. Raises MalformedPacketError."""
    words = protocol.decode_words(payload)
    if not words or len(words) % group:
        msg = f"{len(words)} words where groups of {group} belong"
        raise MalformedPacketError(msg)
    return words


class _Endpoint(asyncio.DatagramProtocol):
    """The GVCP socket."""

    def __init__(self, answer: Callable[[bytes, Address], bytes | None]) -> None:
        self._answer = answer
        self._transport: asyncio.DatagramTransport | None = None
        self._closed = asyncio.get_running_loop().create_future()
        self.port = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._transport = cast("asyncio.DatagramTransport", transport)
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Address) -> None:
        reply = self._answer(data, addr)
        if reply is not None and self._transport is not None:
            self._transport.sendto(reply, addr)

    def connection_lost(self, exc: Exception | None) -> None:
        self._closed.set_result(None)

    async def close(self) -> None:
        if self._transport is not None:
            self._transport.close()
            await self._closed
