"""The camera's register space: what exists, what may be written, what it holds."""

from __future__ import annotations

import struct
from enum import IntEnum
from pathlib import Path

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Register, Status, TextRegister

XML_ADDRESS = 0x0010_0000
_SPACE_BYTES = 0xB000


class Feature(IntEnum):
    """The camera's own registers, as its GenICam description tells clients."""

    WIDTH = 0xA000
    HEIGHT = 0xA004
    OFFSET_X = 0xA008
    OFFSET_Y = 0xA00C
    PIXEL_FORMAT = 0xA010
    PAYLOAD_SIZE = 0xA014
    ACQUISITION_START = 0xA01C
    ACQUISITION_STOP = 0xA020
    TL_PARAMS_LOCKED = 0xA024
    WIDTH_MAX = 0xA028
    HEIGHT_MAX = 0xA02C
    EXPOSURE_TIME_US = 0xA030  # float64
    FRAME_RATE_HZ = 0xA038  # float64
    TEMPERATURE_C = 0xA040  # float64


DOUBLES = frozenset({Feature.EXPOSURE_TIME_US, Feature.FRAME_RATE_HZ, Feature.TEMPERATURE_C})
_TEXTS = (
    protocol.MAKER,
    protocol.MODEL,
    protocol.DEVICE_VERSION,
    protocol.MAKER_INFORMATION,
    protocol.SERIAL_NUMBER,
    protocol.USER_NAME,
    TextRegister(Register.XML_URL_1, protocol.XML_URL_BYTES),
    TextRegister(Register.XML_URL_2, protocol.XML_URL_BYTES),
)
_WRITABLE_WORDS = frozenset(
    {
        Register.HEARTBEAT_TIMEOUT_MS,
        Register.TIMESTAMP_CONTROL,
        Register.CONTROL_PRIVILEGE,
        Register.STREAM_PORT,
        Register.STREAM_PACKET_SIZE,
        Register.STREAM_PACKET_DELAY,
        Register.STREAM_DESTINATION,
        Feature.WIDTH,
        Feature.HEIGHT,
        Feature.OFFSET_X,
        Feature.OFFSET_Y,
        Feature.PIXEL_FORMAT,
        Feature.ACQUISITION_START,
        Feature.ACQUISITION_STOP,
        Feature.TL_PARAMS_LOCKED,
    }
)


class RegisterError(Exception):
    """A register access that the camera answers with an error status."""

    def __init__(self, status: Status) -> None:
        super().__init__(status.name)
        self.status = status


class Memory:
    """Bytes by address. A word that no register covers does not exist."""

    def __init__(self) -> None:
        self._bytes = bytearray(_SPACE_BYTES)
        self._xml = Path(__file__).with_name("fit_camera.xml").read_bytes()
        self._xml += b"\0" * (-len(self._xml) % 4)
        self._exists: set[int] = {int(address) for address in (*Register, *Feature)}
        self._exists |= {address + 4 for address in DOUBLES}
        for address, length in _TEXTS:
            self._exists.update(range(address, address + length, 4))
        user_name = protocol.USER_NAME
        self._writable: set[int] = {int(address) for address in _WRITABLE_WORDS}
        self._writable |= set(range(user_name.address, user_name.address + user_name.length, 4))
        self._writable |= {
            address + half
            for address in (Feature.EXPOSURE_TIME_US, Feature.FRAME_RATE_HZ)
            for half in (0, 4)
        }
        url = protocol.encode_xml_url(
            protocol.XmlLocation("fit_camera.xml", XML_ADDRESS, len(self._xml))
        )
        self.set_text(TextRegister(Register.XML_URL_1, protocol.XML_URL_BYTES), url)

    def read(self, address: int, length: int) -> bytes:
        """Read as a client does. Raises RegisterError."""
        self._check_alignment(address, length)
        offset = address - XML_ADDRESS
        if offset >= 0 and offset + length <= len(self._xml):
            return self._xml[offset : offset + length]
        if not self._exists.issuperset(range(address, address + length, 4)):
            raise RegisterError(Status.INVALID_ADDRESS)
        return bytes(self._bytes[address : address + length])

    def check_writable(self, address: int, length: int) -> None:
        """Raise RegisterError unless a client may write there."""
        self.read(address, length)  # must exist
        if not self._writable.issuperset(range(address, address + length, 4)):
            raise RegisterError(Status.WRITE_PROTECT)

    def head(self, length: int) -> bytes:
        """The first bytes of the space, which the answer to DISCOVERY repeats."""
        return bytes(self._bytes[:length])

    def word(self, address: int) -> int:
        """One 32-bit register."""
        return int.from_bytes(self._bytes[address : address + 4], "big")

    def set_word(self, address: int, value: int) -> None:
        """Set one 32-bit register."""
        self._bytes[address : address + 4] = value.to_bytes(4, "big")

    def double(self, address: int) -> float:
        """One 64-bit floating-point register."""
        return float(struct.unpack_from(">d", self._bytes, address)[0])

    def set_double(self, address: int, value: float) -> None:
        """Set one 64-bit floating-point register."""
        struct.pack_into(">d", self._bytes, address, value)

    def set_text(self, register: TextRegister, text: str) -> None:
        """Set a string, which keeps at least one zero byte at its end."""
        data = text.encode()[: register.length - 1].ljust(register.length, b"\0")
        self._bytes[register.address : register.address + register.length] = data

    def _check_alignment(self, address: int, length: int) -> None:
        if address % 4 or length % 4:
            raise RegisterError(Status.BAD_ALIGNMENT)
