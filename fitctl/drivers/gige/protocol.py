"""GigE Vision on the wire, version 1.2: packets of GVCP (control) and GVSP (stream), registers, status codes.

Everything is big-endian except pixels, which are little-endian. Sources: the GigE Vision standard as
Wireshark's dissectors and public register headers show it; PFNC for pixel formats.
"""

from __future__ import annotations

import re
import struct
from enum import IntEnum
from typing import Any, NamedTuple


class MalformedPacketError(ValueError):
    """Bytes that are not a packet of the protocol; ``str()`` describes the error."""


# ---------------------------------------------------------------- GVCP
GVCP_PORT = 3956
COMMAND_KEY = 0x42
FLAG_ACKNOWLEDGE = 0x01
FLAG_BROADCAST_ACKNOWLEDGE = 0x10  # of DISCOVERY: the answer may be a broadcast too
PAYLOAD_BYTES_MAX = 540  # what a 576-byte datagram has room for
MEMORY_BYTES_MAX = 536  # of one READMEM or WRITEMEM
MEMORY_CHUNK_BYTES = 512  # what we ask for: some cameras take no more
DISCOVERY_BYTES = 0xF8

_COMMAND = struct.Struct(">BBHHH")  # key, flags, command, payload length, request id
_ANSWER = struct.Struct(">HHHH")  # status, command + 1, payload length, request id
_READMEM = struct.Struct(">IHH")  # address, reserved, count
_RESEND = struct.Struct(">HHII")  # stream channel, block id, first packet, last packet
_WRITTEN = struct.Struct(">HH")  # reserved, how many
_FORCEIP = struct.Struct(">2x6s12x4s32x")  # MAC address, IPv4 address; then subnet mask and gateway


class Command(IntEnum):
    """GVCP commands; the acknowledge of each has the number one higher."""

    DISCOVERY = 0x0002
    FORCEIP = 0x0004
    PACKETRESEND = 0x0040
    READREG = 0x0080
    WRITEREG = 0x0082
    READMEM = 0x0084
    WRITEMEM = 0x0086


PENDING_ACK = 0x0089


class Status(IntEnum):
    """Status codes of answers and stream packets; those from 0x8000 on are errors."""

    SUCCESS = 0x0000
    PACKET_RESEND = 0x0100
    NOT_IMPLEMENTED = 0x8001
    INVALID_PARAMETER = 0x8002
    INVALID_ADDRESS = 0x8003
    WRITE_PROTECT = 0x8004
    BAD_ALIGNMENT = 0x8005
    ACCESS_DENIED = 0x8006
    BUSY = 0x8007
    PACKET_UNAVAILABLE = 0x800C
    INVALID_HEADER = 0x800E


def is_error(status: int) -> bool:
    """Whether a status code, known or not, is an error."""
    return status >= 0x8000


def status_name(status: int) -> str:
    """A status code for people, such as ``"0x8006 ACCESS_DENIED"``."""
    known = status in set(Status)
    return f"0x{status:04X} {Status(status).name}" if known else f"0x{status:04X}"


class CommandPacket(NamedTuple):
    """A GVCP command."""

    flags: int
    command: int
    request_id: int
    payload: bytes


class AnswerPacket(NamedTuple):
    """A GVCP answer; `command` is that of the acknowledge."""

    status: int
    command: int
    request_id: int
    payload: bytes


def encode_command(
    command: int, request_id: int, payload: bytes = b"", flags: int = FLAG_ACKNOWLEDGE
) -> bytes:
    """Write a command; `request_id` is never 0."""
    return _COMMAND.pack(COMMAND_KEY, flags, command, len(payload), request_id) + payload


def decode_command(packet: bytes) -> CommandPacket:
    """Read a command. Raises MalformedPacketError."""
    if len(packet) < _COMMAND.size:
        msg = f"a command of {len(packet)} bytes, shorter than its header"
        raise MalformedPacketError(msg)
    key, flags, command, length, request_id = _COMMAND.unpack_from(packet)
    if key != COMMAND_KEY:
        msg = f"a command that starts with 0x{key:02X}, not 0x{COMMAND_KEY:02X}"
        raise MalformedPacketError(msg)
    return CommandPacket(flags, command, request_id, _payload(packet, length))


def encode_answer(
    command: int, request_id: int, payload: bytes = b"", status: int = Status.SUCCESS
) -> bytes:
    """Write an answer; `command` is that of the acknowledge."""
    return _ANSWER.pack(status, command, len(payload), request_id) + payload


def decode_answer(packet: bytes) -> AnswerPacket:
    """Read an answer. Raises MalformedPacketError."""
    if len(packet) < _ANSWER.size:
        msg = f"an answer of {len(packet)} bytes, shorter than its header"
        raise MalformedPacketError(msg)
    status, command, length, request_id = _ANSWER.unpack_from(packet)
    return AnswerPacket(status, command, request_id, _payload(packet, length))


def _payload(packet: bytes, length: int) -> bytes:
    payload = packet[8:]
    if len(payload) != length:
        msg = f"a payload of {len(payload)} bytes, but its header gives {length}"
        raise MalformedPacketError(msg)
    return payload


def encode_words(*words: int) -> bytes:
    """Write 32-bit words: addresses, values, or pairs of both."""
    return struct.pack(f">{len(words)}I", *words)


def decode_words(payload: bytes) -> tuple[int, ...]:
    """Read 32-bit words. Raises MalformedPacketError."""
    if len(payload) % 4:
        msg = f"{len(payload)} bytes where whole 32-bit words belong"
        raise MalformedPacketError(msg)
    return struct.unpack(f">{len(payload) // 4}I", payload)


def encode_readmem(address: int, count: int) -> bytes:
    """Write the payload of READMEM."""
    return _READMEM.pack(address, 0, count)


def decode_readmem(payload: bytes) -> tuple[int, int]:
    """Read the payload of READMEM: address, count. Raises MalformedPacketError."""
    address, _reserved, count = _unpacked(_READMEM, payload, "READMEM")
    return address, count


def encode_written(count: int) -> bytes:
    """Write the payload of a WRITEREG or WRITEMEM answer: how many registers or bytes."""
    return _WRITTEN.pack(0, count)


def decode_forceip(payload: bytes) -> tuple[bytes, bytes]:
    """Read the payload of FORCEIP: whom it is for, and its new address. Raises MalformedPacketError."""
    mac, address = _unpacked(_FORCEIP, payload, "FORCEIP")
    return mac, address


class Resend(NamedTuple):
    """A request to send packets of one frame again, both ends included."""

    channel: int
    block_id: int
    first: int
    last: int


def encode_resend(request: Resend) -> bytes:
    """Write the payload of PACKETRESEND."""
    return _RESEND.pack(*request)


def decode_resend(payload: bytes) -> Resend:
    """Read the payload of PACKETRESEND. Raises MalformedPacketError."""
    channel, block_id, first, last = _unpacked(_RESEND, payload, "PACKETRESEND")
    return Resend(channel, block_id, first & 0xFFFFFF, last & 0xFFFFFF)


def decode_pending_s(payload: bytes) -> float:
    """How long a PENDING_ACK asks to wait. Raises MalformedPacketError."""
    return float(_unpacked(_WRITTEN, payload, "PENDING_ACK")[1]) / 1000


def _unpacked(layout: struct.Struct, payload: bytes, what: str) -> tuple[Any, ...]:
    if len(payload) != layout.size:
        msg = f"{what} with {len(payload)} bytes, not {layout.size}"
        raise MalformedPacketError(msg)
    return layout.unpack(payload)


# ---------------------------------------------------------------- bootstrap registers
class Register(IntEnum):
    """Addresses of the bootstrap registers that fitctl uses, on either side."""

    VERSION = 0x0000
    DEVICE_MODE = 0x0004
    MAC_HIGH = 0x0008
    MAC_LOW = 0x000C
    IP_CONFIGURATION_OPTIONS = 0x0010
    IP_CONFIGURATION = 0x0014
    IP_ADDRESS = 0x0024
    SUBNET_MASK = 0x0034
    GATEWAY = 0x0044
    XML_URL_1 = 0x0200
    XML_URL_2 = 0x0400
    NETWORK_INTERFACES = 0x0600
    MESSAGE_CHANNELS = 0x0900
    STREAM_CHANNELS = 0x0904
    GVCP_CAPABILITY = 0x0934
    HEARTBEAT_TIMEOUT_MS = 0x0938
    TICK_FREQUENCY_HIGH = 0x093C
    TICK_FREQUENCY_LOW = 0x0940
    TIMESTAMP_CONTROL = 0x0944
    TIMESTAMP_HIGH = 0x0948
    TIMESTAMP_LOW = 0x094C
    CONTROL_PRIVILEGE = 0x0A00
    STREAM_PORT = 0x0D00
    STREAM_PACKET_SIZE = 0x0D04
    STREAM_PACKET_DELAY = 0x0D08
    STREAM_DESTINATION = 0x0D18
    STREAM_SOURCE_PORT = 0x0D1C


class TextRegister(NamedTuple):
    """A string in the bootstrap registers."""

    address: int
    length: int


MAKER = TextRegister(0x0048, 32)
MODEL = TextRegister(0x0068, 32)
DEVICE_VERSION = TextRegister(0x0088, 32)
MAKER_INFORMATION = TextRegister(0x00A8, 48)
SERIAL_NUMBER = TextRegister(0x00D8, 16)
USER_NAME = TextRegister(0x00E8, 16)
XML_URL_BYTES = 512

CONTROL_EXCLUSIVE, CONTROL = 1, 2
TIMESTAMP_RESET, TIMESTAMP_LATCH = 1, 2
PACKET_SIZE_FIRE_TEST = 1 << 31
PACKET_SIZE_DO_NOT_FRAGMENT = 1 << 30
PACKET_SIZE_MASK = 0xFFFF
CAPABILITY_CONCATENATION = 1 << 0
CAPABILITY_WRITEMEM = 1 << 1
CAPABILITY_PACKETRESEND = 1 << 2
CAPABILITY_SERIAL_NUMBER = 1 << 30
CAPABILITY_USER_NAME = 1 << 31


class XmlLocation(NamedTuple):
    """Where in its memory the camera keeps its GenICam description."""

    name: str
    address: int
    length: int


_LOCAL_URL = re.compile(
    r"local:(?:///)?(?P<name>[^;]+);(?P<address>[0-9a-f]+);(?P<length>[0-9a-f]+)(?:\?.*)?",
    re.IGNORECASE,
)


def encode_xml_url(location: XmlLocation) -> str:
    """Write the URL of a description in the camera's memory."""
    return f"Local:{location.name};{location.address:X};{location.length:X}"


def decode_xml_url(url: str) -> XmlLocation:
    """Read such a URL, also with three slashes and a ``?SchemaVersion=``. Raises MalformedPacketError."""
    match = _LOCAL_URL.fullmatch(url.strip())
    if match is None:
        msg = f"{url!r}, not Local:NAME;HEXADDRESS;HEXLENGTH"
        raise MalformedPacketError(msg)
    return XmlLocation(match["name"], int(match["address"], 16), int(match["length"], 16))


# ---------------------------------------------------------------- GVSP
GVSP_HEADER = struct.Struct(">HHI")  # status, block id, format and packet id
PACKET_OVERHEAD_BYTES = 36  # IP 20, UDP 8, GVSP 8: what SCPS counts besides pixels
TEST_PACKET_OVERHEAD_BYTES = 28  # a test packet has no GVSP header
FORMAT_LEADER, FORMAT_TRAILER, FORMAT_PAYLOAD = 1, 2, 3
EXTENDED_ID_FLAG = 0x80
PACKET_ID_MASK = 0xFFFFFF
BLOCK_IDS = 0xFFFF  # 1 to 65535; 0 is never used
PAYLOAD_TYPE_IMAGE = 1

_LEADER = struct.Struct(">HHQIIIIIHH")
_TRAILER = struct.Struct(">HHI")


class PixelFormat(NamedTuple):
    """How a pixel is sent: code of the PFNC, bits that carry its value, bytes (little-endian)."""

    code: int
    bits: int
    bytes: int


PIXEL_FORMATS = {
    "Mono8": PixelFormat(0x01080001, 8, 1),
    "Mono12": PixelFormat(0x01100005, 12, 2),
    "Mono16": PixelFormat(0x01100007, 16, 2),
}


class StreamHeader(NamedTuple):
    """The first eight bytes of every stream packet."""

    status: int
    block_id: int
    format: int
    packet_id: int


class Leader(NamedTuple):
    """Contents of a frame's first packet; the timestamp is the start of exposure."""

    timestamp_ticks: int
    pixel_format: int
    width_px: int
    height_px: int
    offset_x_px: int = 0
    offset_y_px: int = 0


def encode_stream_header(header: StreamHeader) -> bytes:
    """Write the header of a stream packet."""
    return GVSP_HEADER.pack(
        header.status, header.block_id, header.format << 24 | header.packet_id & PACKET_ID_MASK
    )


def decode_stream_header(packet: bytes | memoryview) -> StreamHeader:
    """Read the header of a stream packet. Raises MalformedPacketError."""
    if len(packet) < GVSP_HEADER.size:
        msg = f"a stream packet of {len(packet)} bytes, shorter than its header"
        raise MalformedPacketError(msg)
    status, block_id, word = GVSP_HEADER.unpack_from(packet)
    return StreamHeader(status, block_id, word >> 24, word & PACKET_ID_MASK)


def encode_leader(leader: Leader) -> bytes:
    """Write a leader's payload, for an image without padding."""
    return _LEADER.pack(0, PAYLOAD_TYPE_IMAGE, *leader, 0, 0)


def decode_leader(payload: bytes | memoryview) -> Leader:
    """Read a leader's payload. Raises MalformedPacketError if it is not that of an image."""
    if len(payload) < _LEADER.size:
        msg = f"a leader of {len(payload)} bytes, not {_LEADER.size}"
        raise MalformedPacketError(msg)
    fields = _LEADER.unpack_from(payload)
    if fields[1] != PAYLOAD_TYPE_IMAGE:
        msg = f"a leader of payload type 0x{fields[1]:04X}, not that of an image"
        raise MalformedPacketError(msg)
    return Leader(*fields[2:8])


def encode_trailer(height_px: int) -> bytes:
    """Write a trailer's payload."""
    return _TRAILER.pack(0, PAYLOAD_TYPE_IMAGE, height_px)


def blocks_between(earlier: int, later: int) -> int:
    """How many frames lie from one block id to another, 0 to 65534; ids wrap from 65535 to 1."""
    return (later - earlier) % BLOCK_IDS


def next_block(block_id: int) -> int:
    """The block id after `block_id`; 0 starts a stream."""
    return block_id % BLOCK_IDS + 1


def previous_block(block_id: int) -> int:
    """The block id before `block_id`."""
    return (block_id - 2) % BLOCK_IDS + 1
