"""The camera's register space: what exists, what may be written, what it holds."""

from __future__ import annotations

import io
import re
import struct
import zipfile
from enum import IntEnum
from pathlib import Path

from fitctl.config import GigeMock
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import PIXEL_FORMATS, Register, Status, TextRegister

XML_ADDRESS = 0x0010_0000
_SPACE_BYTES = 0xB000


class Feature(IntEnum):
    """The camera's own registers, as in its GenICam description."""

    WIDTH = 0xA000
    HEIGHT = 0xA004
    OFFSET_X = 0xA008
    OFFSET_Y = 0xA00C
    PIXEL_FORMAT = 0xA010
    PAYLOAD_SIZE = 0xA014
    ACQUISITION_MODE = 0xA018
    ACQUISITION_START = 0xA01C
    ACQUISITION_STOP = 0xA020
    TL_PARAMS_LOCKED = 0xA024
    WIDTH_MAX = 0xA028
    HEIGHT_MAX = 0xA02C
    EXPOSURE_TIME_US = 0xA030  # float64
    FRAME_RATE_HZ = 0xA038  # float64
    TEMPERATURE_C = 0xA040  # float64
    GAIN_DB = 0xA048  # float64
    TRIGGER_MODE = 0xA050
    TRIGGER_SOFTWARE = 0xA054


TICKS_PER_S = 125_000_000
HEARTBEAT_DEFAULT_MS = 3000
MAC = bytes.fromhex("020000000001")  # locally administered
OWN_ADDRESS = bytes((127, 0, 0, 1))
SINGLE_FRAME = 1  # of ACQUISITION_MODE; 0 is continuous

_WORDS_AT_START = {
    Register.VERSION: 0x0001_0002,
    Register.DEVICE_MODE: 0x8000_0001,  # big-endian, UTF-8
    Register.MAC_HIGH: int.from_bytes(MAC[:2], "big"),
    Register.MAC_LOW: int.from_bytes(MAC[2:], "big"),
    Register.IP_CONFIGURATION_OPTIONS: 0x0000_0006,
    Register.IP_CONFIGURATION: 0x0000_0006,
    Register.IP_ADDRESS: int.from_bytes(OWN_ADDRESS, "big"),
    Register.SUBNET_MASK: 0xFF00_0000,
    Register.NETWORK_INTERFACES: 1,
    Register.STREAM_CHANNELS: 1,
    Register.GVCP_CAPABILITY: protocol.CAPABILITY_CONCATENATION
    | protocol.CAPABILITY_WRITEMEM
    | protocol.CAPABILITY_SERIAL_NUMBER
    | protocol.CAPABILITY_USER_NAME,
    Register.HEARTBEAT_TIMEOUT_MS: HEARTBEAT_DEFAULT_MS,
    Register.STREAM_PACKET_SIZE: 576,
    Feature.PIXEL_FORMAT: PIXEL_FORMATS["Mono16"].code,
}
_DOUBLES_AT_START = {
    Feature.EXPOSURE_TIME_US: 5000.0,
    Feature.FRAME_RATE_HZ: 25.0,
    Feature.TEMPERATURE_C: 31.5,
    Feature.GAIN_DB: 0.0,
}
DOUBLES = frozenset(_DOUBLES_AT_START)
_TEXTS_AT_START = {
    protocol.MAKER: "FIT",
    protocol.MODEL: "MockCamera",
    protocol.DEVICE_VERSION: "1.1",
    protocol.MAKER_INFORMATION: "mock of a GigE Vision camera",
    protocol.SERIAL_NUMBER: "FIT01",
}
_TEXTS = (
    *_TEXTS_AT_START,
    protocol.USER_NAME,
    TextRegister(Register.XML_URL_1, protocol.XML_URL_BYTES),
    TextRegister(Register.XML_URL_2, protocol.XML_URL_BYTES),
)
LOCKED_WHILE_RUNNING = frozenset(
    {
        Register.STREAM_PACKET_SIZE,
        Register.STREAM_PACKET_DELAY,
        Register.STREAM_DESTINATION,
        Feature.ACQUISITION_MODE,
        Feature.TRIGGER_MODE,
        Feature.GAIN_DB,
        Feature.WIDTH,
        Feature.HEIGHT,
        Feature.OFFSET_X,
        Feature.OFFSET_Y,
        Feature.PIXEL_FORMAT,
        Feature.EXPOSURE_TIME_US,
    }
)
_WRITABLE = LOCKED_WHILE_RUNNING | {
    Feature.FRAME_RATE_HZ,
    Register.HEARTBEAT_TIMEOUT_MS,
    Register.TIMESTAMP_CONTROL,
    Register.CONTROL_PRIVILEGE,
    Register.STREAM_PORT,
    Feature.ACQUISITION_START,
    Feature.ACQUISITION_STOP,
    Feature.TL_PARAMS_LOCKED,
    Feature.TRIGGER_SOFTWARE,
}


class RegisterError(Exception):
    """A command that the camera answers with an error status; `payload` gives how far it got."""

    def __init__(self, status: Status, payload: bytes = b"") -> None:
        super().__init__(status.name)
        self.status = status
        self.payload = payload


class Memory:
    """Bytes by address. A word that no register covers does not exist.

    Parameters
    ----------
    settings : GigeMock
        How the description is kept, and what the camera can do.
    """

    def __init__(self, settings: GigeMock) -> None:
        self._bytes = bytearray(_SPACE_BYTES)
        name, self._xml = _description(settings)
        location = protocol.XmlLocation(name, XML_ADDRESS, len(self._xml))
        self._xml += b"\0" * (-len(self._xml) % 4)
        self._exists: set[int] = {int(address) for address in (*Register, *Feature)}
        self._exists |= {address + 4 for address in DOUBLES}
        for address, length in _TEXTS:
            self._exists.update(range(address, address + length, 4))
        user_name = protocol.USER_NAME
        self._writable: set[int] = {int(address) for address in _WRITABLE}
        self._writable |= {address + 4 for address in DOUBLES & _WRITABLE}
        self._writable |= set(range(user_name.address, user_name.address + user_name.length, 4))
        for word, value in _WORDS_AT_START.items():
            self.set_word(word, value)
        if settings.mono8_only:
            self.set_word(Feature.PIXEL_FORMAT, PIXEL_FORMATS["Mono8"].code)
        for double, number in _DOUBLES_AT_START.items():
            self.set_double(double, number)
        for register, text in _TEXTS_AT_START.items():
            self.set_text(register, text)
        url = protocol.encode_xml_url(location)
        self.set_text(TextRegister(Register.XML_URL_1, protocol.XML_URL_BYTES), url)
        if settings.clock:
            self.set_word(Register.TICK_FREQUENCY_LOW, TICKS_PER_S)
        if settings.resends:
            can = self.word(Register.GVCP_CAPABILITY) | protocol.CAPABILITY_PACKETRESEND
            self.set_word(Register.GVCP_CAPABILITY, can)

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


def _description(settings: GigeMock) -> tuple[str, bytes]:
    """The GenICam description as the camera keeps it: a file's name, and what is in it."""
    xml = Path(__file__).with_name("fit_camera.xml").read_bytes()
    if settings.mono8_only:
        xml = re.sub(rb'\s*<EnumEntry Name="Mono1[26]".*?</EnumEntry>', b"", xml)
    if settings.description == "xml":
        return "fit_camera.xml", xml
    archive = io.BytesIO()
    with zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as writer:
        writer.writestr(zipfile.ZipInfo("fit_camera.xml"), xml, zipfile.ZIP_DEFLATED)
    return "fit_camera.zip", archive.getvalue()
