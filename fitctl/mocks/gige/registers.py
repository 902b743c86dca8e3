"""What the camera's registers do when they are written."""

from __future__ import annotations

import socket
import struct
import time
from collections.abc import Callable

from fitctl.config import Camera
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Register, Status
from fitctl.mocks.gige.acquisition import Acquisition, StreamSettings
from fitctl.mocks.gige.memory import DOUBLES, Feature, Memory, RegisterError

TICKS_PER_S = 125_000_000
CLOCK_ERROR = 20e-6
UPTIME_AT_START_S = 1000.0
TEMPERATURE_C = 31.5
HEARTBEAT_DEFAULT_MS = 3000
HEARTBEAT_MIN_MS = 500
PACKET_SIZES_BYTES = range(576, 9001, 4)
FRAME_RATES_HZ = (1.0, 2000.0)
EXPOSURE_MIN_US = 1.0
SIZE_MIN_PX = 8
_ROUNDING = 1 + 1e-9  # a period of 1 / rate and back is not exact

_WORDS_AT_START = {
    Register.VERSION: 0x0001_0002,
    Register.DEVICE_MODE: 0x8000_0001,  # big-endian, UTF-8
    Register.MAC_HIGH: 0x0000_0200,  # locally administered
    Register.MAC_LOW: 0x0000_0001,
    Register.IP_CONFIGURATION_OPTIONS: 0x0000_0006,
    Register.IP_CONFIGURATION: 0x0000_0006,
    Register.IP_ADDRESS: 0x7F00_0001,
    Register.SUBNET_MASK: 0xFF00_0000,
    Register.NETWORK_INTERFACES: 1,
    Register.STREAM_CHANNELS: 1,
    Register.GVCP_CAPABILITY: protocol.CAPABILITY_CONCATENATION
    | protocol.CAPABILITY_WRITEMEM
    | protocol.CAPABILITY_PACKETRESEND
    | protocol.CAPABILITY_SERIAL_NUMBER
    | protocol.CAPABILITY_USER_NAME,
    Register.HEARTBEAT_TIMEOUT_MS: HEARTBEAT_DEFAULT_MS,
    Register.TICK_FREQUENCY_LOW: TICKS_PER_S,
    Register.STREAM_PACKET_SIZE: 576,
    Feature.PIXEL_FORMAT: protocol.PIXEL_FORMAT_MONO16,
}
_DOUBLES_AT_START = {
    Feature.EXPOSURE_TIME_US: 5000.0,
    Feature.FRAME_RATE_HZ: 25.0,
    Feature.TEMPERATURE_C: TEMPERATURE_C,
}
_TEXTS = {
    protocol.MAKER: "FIT",
    protocol.MODEL: "MockCamera",
    protocol.DEVICE_VERSION: "1.0",
    protocol.MAKER_INFORMATION: "mock of a GigE Vision camera",
    protocol.SERIAL_NUMBER: "FIT01",
}
_LOCKED_WHILE_RUNNING = frozenset(
    {
        Register.STREAM_PACKET_SIZE,
        Register.STREAM_DESTINATION,
        Feature.WIDTH,
        Feature.HEIGHT,
        Feature.OFFSET_X,
        Feature.OFFSET_Y,
        Feature.PIXEL_FORMAT,
        Feature.EXPOSURE_TIME_US,
        Feature.FRAME_RATE_HZ,
    }
)


class CameraClock:
    """The camera's own clock: a little fast, and with an origin of its own."""

    def __init__(self) -> None:
        self._reset_s = time.monotonic() - UPTIME_AT_START_S

    def ticks(self, host_s: float) -> int:
        """What the clock shows at a host monotonic time."""
        return round((host_s - self._reset_s) * (1 + CLOCK_ERROR) * TICKS_PER_S)

    def reset(self, host_s: float) -> None:
        """Start again from 0."""
        self._reset_s = host_s


class Registers:
    """Registers with their effects. Who may write is not decided here.

    Parameters
    ----------
    camera : Camera
        Its size is the sensor's.
    clock : CameraClock
        The clock behind the timestamp registers.
    acquisition : Acquisition
        Started, stopped and set through registers.
    """

    def __init__(self, camera: Camera, clock: CameraClock, acquisition: Acquisition) -> None:
        self._memory = Memory()
        self._clock = clock
        self._acquisition = acquisition
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
            Feature.PIXEL_FORMAT: self._set_pixel_format,
            Feature.ACQUISITION_START: self._start_acquisition,
            Feature.ACQUISITION_STOP: self._stop_acquisition,
        }
        for word, value in _WORDS_AT_START.items():
            self._memory.set_word(word, value)
        for double, number in _DOUBLES_AT_START.items():
            self._memory.set_double(double, number)
        for register, text in _TEXTS.items():
            self._memory.set_text(register, text)
        for feature in (Feature.WIDTH, Feature.WIDTH_MAX):
            self._memory.set_word(feature, camera.width_px)
        for feature in (Feature.HEIGHT, Feature.HEIGHT_MAX):
            self._memory.set_word(feature, camera.height_px)
        self._memory.set_word(Feature.PAYLOAD_SIZE, 2 * camera.width_px * camera.height_px)
        self._memory.set_word(Register.STREAM_SOURCE_PORT, acquisition.source_port)

    @property
    def heartbeat_s(self) -> float:
        """How long control lasts without a sign of life from its holder."""
        return self._memory.word(Register.HEARTBEAT_TIMEOUT_MS) / 1000

    def privilege(self) -> int:
        """The control privilege register."""
        return self._memory.word(Register.CONTROL_PRIVILEGE)

    def set_privilege(self, value: int) -> None:
        """Set the control privilege; without any, nothing streams and the stream channel is closed."""
        self._memory.set_word(Register.CONTROL_PRIVILEGE, value)
        if not value:
            self._memory.set_word(Register.STREAM_PORT, 0)
            self._memory.set_word(Feature.TL_PARAMS_LOCKED, 0)
            self._acquisition.stop()

    def discovery(self) -> bytes:
        """The answer to DISCOVERY."""
        return self._memory.head(protocol.DISCOVERY_BYTES)

    def read(self, address: int, length: int) -> bytes:
        """Read as a client does. Raises RegisterError."""
        return self._memory.read(address, length)

    def check_writable(self, address: int, length: int) -> None:
        """Raise RegisterError if no client may ever write there, or not now."""
        self._memory.check_writable(address, length)
        if self._acquisition.running and address in _LOCKED_WHILE_RUNNING:
            raise RegisterError(Status.ACCESS_DENIED)

    def write(self, address: int, data: bytes) -> None:
        """Write as a client with control does. Raises RegisterError."""
        self.check_writable(address, len(data))
        if address in DOUBLES:
            self._set_timing(address, data)
            return
        for offset, value in enumerate(protocol.decode_words(data)):
            self._write_word(address + 4 * offset, value)

    def _write_word(self, address: int, value: int) -> None:
        before = self._memory.word(address)
        self._memory.set_word(address, value)
        try:
            if address in self._actions:
                self._actions[address](value)
        except RegisterError:
            self._memory.set_word(address, before)
            raise

    def _set_heartbeat(self, value: int) -> None:
        self._memory.set_word(Register.HEARTBEAT_TIMEOUT_MS, max(value, HEARTBEAT_MIN_MS))

    def _control_timestamp(self, value: int) -> None:
        now_s = time.monotonic()
        if value & protocol.TIMESTAMP_LATCH:
            ticks = self._clock.ticks(now_s)
            self._memory.set_word(Register.TIMESTAMP_HIGH, ticks >> 32)
            self._memory.set_word(Register.TIMESTAMP_LOW, ticks & 0xFFFFFFFF)
        if value & protocol.TIMESTAMP_RESET:
            self._clock.reset(now_s)
        self._memory.set_word(Register.TIMESTAMP_CONTROL, 0)

    def _set_packet_size(self, value: int) -> None:
        size = value & protocol.PACKET_SIZE_MASK
        if size not in PACKET_SIZES_BYTES:
            raise RegisterError(Status.INVALID_PARAMETER)
        self._memory.set_word(
            Register.STREAM_PACKET_SIZE, value & ~protocol.PACKET_SIZE_FIRE_TEST & 0xFFFFFFFF
        )
        if value & protocol.PACKET_SIZE_FIRE_TEST:
            self._acquisition.send_test_packet(self._destination(), size)

    def _set_destination(self, value: int) -> None:
        if value >> 24 != 127:
            raise RegisterError(Status.INVALID_PARAMETER)

    def _set_size(self, _value: int) -> None:
        width, height, offset_x, offset_y = (
            self._memory.word(feature)
            for feature in (Feature.WIDTH, Feature.HEIGHT, Feature.OFFSET_X, Feature.OFFSET_Y)
        )
        fits = width + offset_x <= self._width_max_px
        fits &= height + offset_y <= self._height_max_px
        if not fits or min(width, height) < SIZE_MIN_PX:
            raise RegisterError(Status.INVALID_PARAMETER)
        self._memory.set_word(Feature.PAYLOAD_SIZE, 2 * width * height)

    def _set_pixel_format(self, value: int) -> None:
        if value != protocol.PIXEL_FORMAT_MONO16:
            raise RegisterError(Status.INVALID_PARAMETER)

    def _set_timing(self, address: int, data: bytes) -> None:
        """Exposure and frame rate: neither may outgrow the other."""
        if len(data) != 8:
            raise RegisterError(Status.INVALID_PARAMETER)
        (value,) = struct.unpack(">d", data)
        period_us = 1e6 / self._memory.double(Feature.FRAME_RATE_HZ)
        exposure_us = self._memory.double(Feature.EXPOSURE_TIME_US)
        if address == Feature.EXPOSURE_TIME_US:
            allowed = EXPOSURE_MIN_US <= value <= period_us * _ROUNDING
        else:
            low_hz, high_hz = FRAME_RATES_HZ
            allowed = low_hz <= value <= high_hz and value * exposure_us <= 1e6 * _ROUNDING
        if not allowed:
            raise RegisterError(Status.INVALID_PARAMETER)
        self._memory.set_double(address, value)

    def _start_acquisition(self, _value: int) -> None:
        memory = self._memory
        if self._acquisition.running:
            return
        self._acquisition.start(
            StreamSettings(
                destination=self._destination(),
                packet_size_bytes=memory.word(Register.STREAM_PACKET_SIZE)
                & protocol.PACKET_SIZE_MASK,
                width_px=memory.word(Feature.WIDTH),
                height_px=memory.word(Feature.HEIGHT),
                offset_x_px=memory.word(Feature.OFFSET_X),
                offset_y_px=memory.word(Feature.OFFSET_Y),
                exposure_s=memory.double(Feature.EXPOSURE_TIME_US) / 1e6,
                frame_rate_hz=memory.double(Feature.FRAME_RATE_HZ),
            )
        )

    def _stop_acquisition(self, _value: int) -> None:
        self._acquisition.stop()

    def _destination(self) -> tuple[str, int]:
        host = socket.inet_ntoa(
            protocol.encode_words(self._memory.word(Register.STREAM_DESTINATION))
        )
        return host, self._memory.word(Register.STREAM_PORT) & 0xFFFF
