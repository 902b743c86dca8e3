"""Modbus frames, on TCP and on a serial line, and the request for a station's identity.

Frames are those of MODBUS Messaging on TCP/IP V1.0b and of MODBUS over Serial Line V1.02 (RTU); function
2B/0E is that of the MODBUS Application Protocol Specification V1.1b3. Pure codecs: bytes in, values out.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

PDU_BYTES_MAX = 253
READ_HOLDING_REGISTERS = 3
WRITE_MULTIPLE_REGISTERS = 16
READ_DEVICE_IDENTIFICATION = 43
EXCEPTION_FLAG = 0x80

_HEADER = struct.Struct(">HHHB")  # transaction, protocol, length from the unit on, unit
_MEI_IDENTIFICATION = 0x0E
_BASIC_STREAM = 1
_OBJECTS = 3
_CRC_BYTES = 2


class Message(NamedTuple):
    """One message without its TCP frame; `protocol` is 0 for Modbus."""

    transaction: int
    unit: int
    pdu: bytes
    protocol: int = 0


def frame(transaction: int, unit: int, pdu: bytes) -> bytes:
    """A PDU in its TCP frame."""
    return _HEADER.pack(transaction, 0, 1 + len(pdu), unit) + pdu


def pop_message(pending: bytearray) -> Message | None:
    """Remove the first whole TCP message from `pending`; None while there is none.

    Raises
    ------
    ValueError
        If no message can be that long, so that nobody knows where the next one begins.
    """
    if len(pending) < _HEADER.size:
        return None
    transaction, protocol, length, unit = _HEADER.unpack_from(pending)
    if not 2 <= length <= 1 + PDU_BYTES_MAX:
        msg = f"protocol {protocol}, length {length}"
        raise ValueError(msg)
    end = _HEADER.size - 1 + length
    if len(pending) < end:
        return None
    pdu = bytes(pending[_HEADER.size : end])
    del pending[:end]
    return Message(transaction, unit, pdu, protocol)


def _crc_of_byte(crc: int) -> int:
    for _ in range(8):
        crc = crc >> 1 ^ (0xA001 if crc & 1 else 0)
    return crc


_CRC = [_crc_of_byte(byte) for byte in range(256)]


def crc16(data: bytes) -> bytes:
    """The check of an RTU frame, low byte first (MODBUS over Serial Line V1.02, section 2.5.1.2)."""
    crc = 0xFFFF
    for byte in data:
        crc = crc >> 8 ^ _CRC[(crc ^ byte) & 0xFF]
    return crc.to_bytes(_CRC_BYTES, "little")


def rtu_frame(unit: int, pdu: bytes) -> bytes:
    """A PDU in its RTU frame."""
    message = bytes([unit]) + pdu
    return message + crc16(message)


def take_rtu_answer(pending: bytearray, unit: int) -> bytes | None:
    """Remove the first whole RTU answer of a unit, and all before it, from `pending`; None while there is none.

    An RTU frame does not say how long it is: its function code does, and its check confirms that.

    Parameters
    ----------
    pending : bytearray
        What came so far, perhaps with noise before the answer.
    unit : int

    Returns
    -------
    bytes or None
        The answer's PDU.
    """
    for begin in range(len(pending)):
        if pending[begin] != unit:
            continue
        size = _answer_bytes(pending[begin + 1 :])
        end = begin + 1 + size + _CRC_BYTES
        message = bytes(pending[begin : end - _CRC_BYTES])
        if size and end <= len(pending) and crc16(message) == pending[end - _CRC_BYTES : end]:
            del pending[:end]
            return message[1:]
    return None


def _answer_bytes(pdu: bytes | bytearray) -> int:
    """How long the answer is that begins so; 0 if that cannot be known yet, or at all."""
    function_code = pdu[0] if pdu else 0
    size = 0
    if function_code & EXCEPTION_FLAG:
        size = 2
    elif function_code == WRITE_MULTIPLE_REGISTERS:
        size = 5
    elif function_code == READ_HOLDING_REGISTERS and len(pdu) > 1:
        size = 2 + pdu[1]
    elif function_code == READ_DEVICE_IDENTIFICATION and len(pdu) > 6:
        size = 7
        for _ in range(pdu[6]):
            if size + 1 >= len(pdu):
                return 0
            size += 2 + pdu[size + 1]
    return size


def encode_identify() -> bytes:
    """The request for a station's basic identification."""
    return bytes([READ_DEVICE_IDENTIFICATION, _MEI_IDENTIFICATION, _BASIC_STREAM, 0])


def decode_identity(pdu: bytes) -> list[str]:
    """Vendor, product and revision; empty where the answer does not have them."""
    texts = [""] * _OBJECTS
    if pdu[:2] != bytes([READ_DEVICE_IDENTIFICATION, _MEI_IDENTIFICATION]):
        return texts
    rest = pdu[7:]
    while len(rest) >= 2 and len(rest) >= 2 + rest[1]:
        number, size = rest[0], rest[1]
        if number < _OBJECTS:
            texts[number] = rest[2 : 2 + size].decode("ascii", "replace")
        rest = rest[2 + size :]
    return texts
