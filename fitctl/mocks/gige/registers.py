"""What the camera's registers do when they are written."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable

from fitctl.config import Camera, GigeMock
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Register, Status
from fitctl.mocks.gige.acquisition import Acquisition, AcquisitionSettings
from fitctl.mocks.gige.memory import (
    DOUBLES,
    LOCKED_WHILE_RUNNING,
    SINGLE_FRAME,
    TICKS_PER_S,
    Feature,
    Memory,
    RegisterError,
)
from fitctl.mocks.gige.stream import Stream, StreamSettings

CLOCK_ERROR = 20e-6
UPTIME_AT_START_S = 1000.0
HEARTBEAT_MIN_MS = 500
PACKET_SIZES_BYTES = range(576, 9001, 4)
FRAME_RATES_HZ = (1.0, 2000.0)
GAINS_DB = (0.0, 24.0)
EXPOSURE_MIN_US = 1.0
SIZE_MIN_PX = 8
_ROUNDING = 1 + 1e-9  # a period of 1 / rate and back is not exact

_FORMAT_OF_CODE = {one.code: one for one in protocol.PIXEL_FORMATS.values()}


class CameraClock:
    """The camera's own clock: a little fast, and with an origin of its own; or none, which shows 0."""

    def __init__(self, *, runs: bool) -> None:
        self._rate_hz = (1 + CLOCK_ERROR) * TICKS_PER_S if runs else 0.0
        self._reset_s = time.monotonic() - UPTIME_AT_START_S

    def ticks(self, host_s: float) -> int:
        """What the clock shows at a host monotonic time."""
        return max(0, round((host_s - self._reset_s) * self._rate_hz))

    def reset(self, host_s: float) -> None:
        """Start again from 0."""
        self._reset_s = host_s


class Registers(Memory):
    """The register space with the effects of writing. Who may write is not decided here.

    Parameters
    ----------
    camera : Camera
        Its size is the sensor's.
    clock : CameraClock
        The clock behind the timestamp registers.
    acquisition : Acquisition
        Started, stopped, triggered and set through registers.
    stream : Stream
        Asked for test packets.
    """

    def __init__(
        self,
        camera: Camera,
        settings: GigeMock,
        clock: CameraClock,
        acquisition: Acquisition,
        stream: Stream,
    ) -> None:
        super().__init__(settings)
        self._clock = clock
        self._acquisition = acquisition
        self._stream = stream
        self._formats = {
            code: one
            for code, one in _FORMAT_OF_CODE.items()
            if one is protocol.PIXEL_FORMATS["Mono8"] or not settings.mono8_only
        }
        self._width_max_px = camera.width_px
        self._height_max_px = camera.height_px
        self._actions: dict[int, Callable[[int], None]] = {
            Register.HEARTBEAT_TIMEOUT_MS: self._set_heartbeat,
            Register.TIMESTAMP_CONTROL: self._control_timestamp,
            Register.STREAM_PACKET_SIZE: self._set_packet_size,
            Register.STREAM_DESTINATION: self._set_destination,
            Feature.WIDTH: self._set_size,
            Feature.HEIGHT: self._set_size,
            Feature.OFFSET_X: self._set_size,
            Feature.OFFSET_Y: self._set_size,
            Feature.PIXEL_FORMAT: self._set_size,
            Feature.ACQUISITION_MODE: _check_switch,
            Feature.TRIGGER_MODE: _check_switch,
            Feature.ACQUISITION_START: self._start_acquisition,
            Feature.ACQUISITION_STOP: lambda _: acquisition.stop(),
            Feature.TRIGGER_SOFTWARE: lambda _: acquisition.trigger(),
        }
        for feature in (Feature.WIDTH, Feature.WIDTH_MAX):
            self.set_word(feature, camera.width_px)
        for feature in (Feature.HEIGHT, Feature.HEIGHT_MAX):
            self.set_word(feature, camera.height_px)
        left_px = settings.offset_at_start_px
        for size, offset in (
            (Feature.WIDTH, Feature.OFFSET_X),
            (Feature.HEIGHT, Feature.OFFSET_Y),
        ):
            self.set_word(offset, left_px)
            self.set_word(size, self.word(size) - left_px)
        self.set_word(Register.STREAM_SOURCE_PORT, stream.source_port)
        self._set_size()

    @property
    def heartbeat_s(self) -> float:
        """How long control lasts without a sign of life from its holder."""
        return self.word(Register.HEARTBEAT_TIMEOUT_MS) / 1000

    def privilege(self) -> int:
        """The control privilege register."""
        return self.word(Register.CONTROL_PRIVILEGE)

    def set_privilege(self, value: int) -> None:
        """Set the control privilege; without any, nothing streams and the stream channel is closed."""
        self.set_word(Register.CONTROL_PRIVILEGE, value)
        if not value:
            self.set_word(Register.STREAM_PORT, 0)
            self.set_word(Feature.TL_PARAMS_LOCKED, 0)
            self._acquisition.stop()

    def check_writable(self, address: int, length: int) -> None:
        """Raise RegisterError if no client may ever write there, or not now."""
        super().check_writable(address, length)
        written = range(address, address + length, 4)
        if self._acquisition.running and not LOCKED_WHILE_RUNNING.isdisjoint(written):
            raise RegisterError(Status.ACCESS_DENIED)

    def write(self, address: int, data: bytes) -> None:
        """Write as a client with control does. Raises RegisterError."""
        self.check_writable(address, len(data))
        if address in DOUBLES:
            self._set_double(address, data)
            return
        for offset, value in enumerate(protocol.decode_words(data)):
            self._write_word(address + 4 * offset, value)

    def _write_word(self, address: int, value: int) -> None:
        if not DOUBLES.isdisjoint({address, address - 4}):
            raise RegisterError(Status.INVALID_PARAMETER)  # half a number
        before = self.word(address)
        self.set_word(address, value)
        try:
            if address in self._actions:
                self._actions[address](value)
        except RegisterError:
            self.set_word(address, before)
            raise

    def _set_heartbeat(self, value: int) -> None:
        self.set_word(Register.HEARTBEAT_TIMEOUT_MS, max(value, HEARTBEAT_MIN_MS))

    def _control_timestamp(self, value: int) -> None:
        now_s = time.monotonic()
        if value & protocol.TIMESTAMP_LATCH:
            ticks = self._clock.ticks(now_s)
            self.set_word(Register.TIMESTAMP_HIGH, ticks >> 32)
            self.set_word(Register.TIMESTAMP_LOW, ticks & 0xFFFFFFFF)
        if value & protocol.TIMESTAMP_RESET:
            self._clock.reset(now_s)
        self.set_word(Register.TIMESTAMP_CONTROL, 0)

    def _set_packet_size(self, value: int) -> None:
        size = value & protocol.PACKET_SIZE_MASK
        if size not in PACKET_SIZES_BYTES:
            raise RegisterError(Status.INVALID_PARAMETER)
        self.set_word(
            Register.STREAM_PACKET_SIZE, value & ~protocol.PACKET_SIZE_FIRE_TEST & 0xFFFFFFFF
        )
        if value & protocol.PACKET_SIZE_FIRE_TEST:
            self._stream.send_test_packet(self._destination(), size)

    def _set_destination(self, value: int) -> None:
        if value >> 24 != 127:
            raise RegisterError(Status.INVALID_PARAMETER)

    def _set_size(self, _value: int = 0) -> None:
        width, height, offset_x, offset_y = (
            self.word(feature)
            for feature in (Feature.WIDTH, Feature.HEIGHT, Feature.OFFSET_X, Feature.OFFSET_Y)
        )
        pixel_format = self._formats.get(self.word(Feature.PIXEL_FORMAT))
        fits = width + offset_x <= self._width_max_px
        fits &= height + offset_y <= self._height_max_px
        if not fits or min(width, height) < SIZE_MIN_PX or pixel_format is None:
            raise RegisterError(Status.INVALID_PARAMETER)
        self.set_word(Feature.PAYLOAD_SIZE, pixel_format.bytes * width * height)

    def _set_double(self, address: int, data: bytes) -> None:
        """Exposure and frame rate: neither may outgrow the other."""
        if len(data) != 8:
            raise RegisterError(Status.INVALID_PARAMETER)  # half a number, or more than one
        (value,) = struct.unpack(">d", data)
        low, high = {
            Feature.EXPOSURE_TIME_US: (
                EXPOSURE_MIN_US,
                1e6 / self.double(Feature.FRAME_RATE_HZ) * _ROUNDING,
            ),
            Feature.FRAME_RATE_HZ: (
                FRAME_RATES_HZ[0],
                min(
                    FRAME_RATES_HZ[1],
                    1e6 / self.double(Feature.EXPOSURE_TIME_US) * _ROUNDING,
                ),
            ),
            Feature.GAIN_DB: GAINS_DB,
        }[Feature(address)]
        if not low <= value <= high:
            raise RegisterError(Status.INVALID_PARAMETER)
        self.set_double(address, value)
        if address == Feature.FRAME_RATE_HZ:
            self._acquisition.set_rate(value)

    def _start_acquisition(self, _value: int) -> None:
        if self._acquisition.running:
            return
        size = self.word(Register.STREAM_PACKET_SIZE) & protocol.PACKET_SIZE_MASK
        self._acquisition.start(
            AcquisitionSettings(
                exposure_s=self.double(Feature.EXPOSURE_TIME_US) / 1e6,
                frame_rate_hz=self.double(Feature.FRAME_RATE_HZ),
                gain_db=self.double(Feature.GAIN_DB),
                single_frame=self.word(Feature.ACQUISITION_MODE) == SINGLE_FRAME,
                triggered=bool(self.word(Feature.TRIGGER_MODE)),
            ),
            StreamSettings(
                destination=self._destination(),
                packet_size_bytes=size,
                packet_gap_s=self.word(Register.STREAM_PACKET_DELAY) / TICKS_PER_S,
                pixel_format=_FORMAT_OF_CODE[self.word(Feature.PIXEL_FORMAT)],
                width_px=self.word(Feature.WIDTH),
                height_px=self.word(Feature.HEIGHT),
                offset_x_px=self.word(Feature.OFFSET_X),
                offset_y_px=self.word(Feature.OFFSET_Y),
            ),
        )

    def _destination(self) -> tuple[str, int]:
        host = socket.inet_ntoa(protocol.encode_words(self.word(Register.STREAM_DESTINATION)))
        return host, self.word(Register.STREAM_PORT) & 0xFFFF


def _check_switch(value: int) -> None:
    if value not in {0, 1}:
        raise RegisterError(Status.INVALID_PARAMETER)
