"""The mock camera's control side: who has control, and what each command and register does."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Camera, GigeMock
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Command, MalformedPacketError, Register, Status
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.gige.acquisition import Acquisition
from fitctl.mocks.gige.datagrams import Address, ControlSocket, listen
from fitctl.mocks.gige.memory import MAC, OWN_ADDRESS, RegisterError
from fitctl.mocks.gige.picture import PICTURE_FAULTS, Sensor
from fitctl.mocks.gige.registers import CameraClock, Registers
from fitctl.mocks.gige.stream import STREAM_FAULTS, Stream
from fitctl.mocks.timers import Watchdog

FAULTS = dict(WIRE_FAULTS) | STREAM_FAULTS | PICTURE_FAULTS


class GigeCameraMock:
    """A GigE Vision 1.2 camera of one stream channel, on 127.0.0.1 only.

    Known limitations: Mono8, Mono12 (unpacked) and Mono16 only; no events, actions, message channel,
    PENDING_ACK, chunk data, binning, automatic exposure, several frames by one start, or extended ids;
    FORCEIP can ask for no other address than it has; format, exposure, gain and trigger are
    locked while it runs; the don't-fragment flag is kept and has no effect; without an inter-packet
    delay a frame is sent in one go; the image is that of one instant, not blurred by the exposure; the
    stream goes to loopback addresses only, and broadcasts are heard on the loopback interface only;
    what a client has set is lost when it restarts, its user-defined name too; the same write twice in
    a row, id and all, is taken for one whose answer was lost.

    Invented constants: names and serial number; 125 MHz clock, 20 ppm fast, 1000 s after its reset;
    the temperature; before a client sets it: 25 Hz, 5 ms; at most 2000 Hz and 24 dB; a size of 8 px
    at least; eight frames kept for resending, and as many that may wait to be sent; registers from
    0xA000 on; the place of the hot pixel.

    Faults of the wire concern both its sockets. What is corrupted does not arrive: UDP has a checksum.
    Frozen or disconnected it goes on exposing, and loses its controller when the heartbeat lapses.

    Parameters
    ----------
    camera : Camera
        Sensor size, bias, noise and frame delay; rate and exposure are for the client to set.
    settings : GigeMock
    render : callable
        ``render(mid_exposure_s)``: the uint16 image, shape (height_px, width_px), of that host
        monotonic time.
    port : int
        GVCP port; 0 for any free one.
    smears : bool
        The image is of the whole exposure, and asked for once it has ended.
    """

    def __init__(
        self,
        camera: Camera,
        settings: GigeMock,
        render: Callable[[float], NDArray[np.uint16]],
        *,
        port: int,
        smears: bool = False,
    ) -> None:
        self.faults = Faults(FAULTS)
        self._camera = camera
        self._settings = settings
        self._render = render
        self._port = port
        self._smears = smears
        self._sensor = Sensor(camera, self.faults)
        self._clock = CameraClock(runs=settings.clock)
        self._controller: Address | None = None
        self._heartbeat = Watchdog(self._release_control)
        self._last: tuple[bytes, Address, bytes] | None = None
        self._control: ControlSocket | None = None
        self._started: tuple[Stream, Acquisition, Registers] | None = None
        self._commands: dict[int, Callable[[bytes, Address], bytes | None]] = {
            Command.DISCOVERY: self._discovery,
            Command.FORCEIP: self._force_ip,
            Command.PACKETRESEND: self._resend,
            Command.READREG: self._read_registers,
            Command.WRITEREG: self._write_registers,
            Command.READMEM: self._read_memory,
            Command.WRITEMEM: self._write_memory,
        }
        self.faults.on_change(self._power)

    @property
    def acquisition(self) -> Acquisition:
        """What it has exposed and sent, and how late; exists once started."""
        return self._parts()[1]

    async def start(self) -> int:
        """Listen; returns the GVCP port."""
        stream = Stream(self.faults, resends=self._settings.resends)
        acquisition = Acquisition(
            self._expose,
            self._clock.ticks,
            self._camera.frame_delay_s,
            stream,
            seen_at=1.0 if self._smears else 0.5,
            true_rate_hz=self._settings.true_frame_rate_hz,
        )
        self._started = stream, acquisition, self._registers(stream, acquisition)
        try:
            self._control = await listen(self.answer, self.faults, self._port)
        except OSError:
            await self.stop()
            raise
        return self._control.port

    async def stop(self) -> None:
        """Stop streaming and listening; safe to call twice."""
        if self._started is not None:
            self._release_control()
            stream, acquisition, _ = self._started
            acquisition.stop()
            stream.close()
            self._started = None
        if self._control is not None:
            await self._control.close()
            self._control = None

    def answer(self, packet: bytes, sender: Address) -> bytes | None:
        """What the camera answers to one GVCP datagram; None for silence."""
        if self._last is not None and (packet, sender) == self._last[:2]:
            return self._last[2]  # it was done; the answer was lost
        try:
            command = protocol.decode_command(packet)
        except MalformedPacketError:
            return None  # not GVCP: a camera does not answer noise
        if command.command % 2:
            return None  # an acknowledge
        try:
            payload = self._execute(command.command, command.payload, sender)
        except MalformedPacketError:
            status, payload = Status.INVALID_HEADER, b""
        except RegisterError as error:
            status, payload = error.status, error.payload
        else:
            status = Status.SUCCESS
        if sender == self._controller:
            self._refresh_heartbeat()
        if payload is None or not command.flags & protocol.FLAG_ACKNOWLEDGE:
            return None
        reply = protocol.encode_answer(command.command + 1, command.request_id, payload, status)
        writes = command.command in {Command.WRITEREG, Command.WRITEMEM}
        self._last = (packet, sender, reply) if writes else None
        return reply

    def _execute(self, command: int, payload: bytes, sender: Address) -> bytes | None:
        if len(payload) > protocol.PAYLOAD_BYTES_MAX:
            msg = f"a command of {len(payload)} bytes, more than {protocol.PAYLOAD_BYTES_MAX}"
            raise MalformedPacketError(msg)
        if command not in self._commands:
            raise RegisterError(Status.NOT_IMPLEMENTED)
        return self._commands[command](payload, sender)

    def _discovery(self, _payload: bytes, _sender: Address) -> bytes:
        return self._parts()[2].head(protocol.DISCOVERY_BYTES)

    def _force_ip(self, payload: bytes, _sender: Address) -> bytes | None:
        """Whom it is not for stays silent; the address cannot be changed."""
        mac, address = protocol.decode_forceip(payload)
        if mac != MAC:
            return None
        if address != OWN_ADDRESS:
            raise RegisterError(Status.ACCESS_DENIED)
        return b""

    def _resend(self, payload: bytes, sender: Address) -> bytes:
        request = protocol.decode_resend(payload)
        if not self._settings.resends:
            raise RegisterError(Status.NOT_IMPLEMENTED)
        # Some controllers ask from their stream's port, Aravis for one.
        ours = self._controller is not None and sender[0] == self._controller[0]
        if ours and self.acquisition.running:
            self._parts()[0].resend(request)
        return b""

    def _read_memory(self, payload: bytes, sender: Address) -> bytes:
        address, count = protocol.decode_readmem(payload)
        if not 0 < count <= protocol.MEMORY_BYTES_MAX:
            raise RegisterError(Status.INVALID_PARAMETER)
        return payload[:4] + self._read(address, count, sender)

    def _read_registers(self, payload: bytes, sender: Address) -> bytes:
        values = b""
        for address in _words(payload, 1):
            try:
                values += self._read(address, 4, sender)
            except RegisterError as error:
                raise RegisterError(error.status, values) from None
        return values

    def _write_registers(self, payload: bytes, sender: Address) -> bytes:
        words = _words(payload, 2)
        pairs = list(zip(words[::2], words[1::2], strict=True))
        for index, (address, value) in enumerate(pairs):
            try:
                self._write(address, protocol.encode_words(value), sender)
            except RegisterError as error:
                raise RegisterError(error.status, protocol.encode_written(index)) from None
        return protocol.encode_written(len(pairs))

    def _write_memory(self, payload: bytes, sender: Address) -> bytes:
        (address,) = _words(payload[:4], 1)
        data = payload[4:]
        try:
            if not data:
                raise RegisterError(Status.INVALID_PARAMETER)
            self._write(address, data, sender)
        except RegisterError as error:
            raise RegisterError(error.status, protocol.encode_written(0)) from None
        return protocol.encode_written(len(data))

    def _read(self, address: int, length: int, sender: Address) -> bytes:
        registers = self._parts()[2]
        exclusive = registers.privilege() & protocol.CONTROL_EXCLUSIVE
        if exclusive and sender != self._controller and address != Register.CONTROL_PRIVILEGE:
            raise RegisterError(Status.ACCESS_DENIED)
        return registers.read(address, length)

    def _write(self, address: int, data: bytes, sender: Address) -> None:
        registers = self._parts()[2]
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
            self._parts()[2].set_privilege(privilege)
        elif self._controller is not None:
            self._release_control()

    def _release_control(self) -> None:
        self._controller = None
        self._parts()[2].set_privilege(0)
        self._heartbeat.stop()

    def _refresh_heartbeat(self) -> None:
        heartbeat_s = self._parts()[2].heartbeat_s
        if heartbeat_s != self._heartbeat.timeout_s:
            self._heartbeat.set_timeout(heartbeat_s)
        self._heartbeat.feed()

    def _expose(self, mid_exposure_s: float) -> NDArray[np.uint16]:
        return self._sensor.expose(self._render(mid_exposure_s), mid_exposure_s)

    def _registers(self, stream: Stream, acquisition: Acquisition) -> Registers:
        return Registers(self._camera, self._settings, self._clock, acquisition, stream)

    def _power(self, kind: str) -> None:
        """Gone without power, and as new with it."""
        if kind != "reboot" or self._started is None:
            return
        self._release_control()
        self._last = None
        self._clock.reset(time.monotonic())
        stream, acquisition, _ = self._started
        self._started = stream, acquisition, self._registers(stream, acquisition)

    def _parts(self) -> tuple[Stream, Acquisition, Registers]:
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
