"""What a Modbus server of registers answers: a request PDU in, an answer PDU out, nothing else.

Checks are made in the order of the state diagrams of the MODBUS Application Protocol Specification
V1.1b3, section 6: function (exception 01), quantities and lengths (03), addresses (02), doing it (04).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fitctl.drivers.modbus_dac import protocol

PDU_BYTES_MAX = 253

_MEI_IDENTIFICATION = 0x0E
_BASIC_STREAM_AND_SINGLE = 0x81  # conformity level: the three basic objects, both ways to ask
_SINGLE_OBJECT = 4


class Refusal(Exception):
    """What was asked is refused with an exception code."""

    def __init__(self, exception_code: int) -> None:
        super().__init__(exception_code)
        self.exception_code = exception_code


class DeviceFailure(Refusal):
    """The device cannot do what was asked, though the request is right: exception 04."""

    def __init__(self) -> None:
        super().__init__(protocol.DEVICE_FAILURE)


HOLDING_FUNCTIONS = frozenset(
    {
        protocol.READ_HOLDING_REGISTERS,
        protocol.WRITE_SINGLE_REGISTER,
        protocol.WRITE_MULTIPLE_REGISTERS,
        protocol.READ_WRITE_MULTIPLE_REGISTERS,
        protocol.READ_DEVICE_IDENTIFICATION,
    }
)
"""What a device of holding registers has, unless it says otherwise."""


@dataclass(frozen=True, slots=True)
class DataModel:
    """What a device shows to Modbus.

    Attributes
    ----------
    addresses : container of int
        The registers that exist, counted from 0; often a range.
    read : callable
        Gets the first address and the count; returns as many unsigned values.
    write : callable
        Gets the first address and the values. Both are called with existing addresses only, and may raise
        `Refusal`.
    identity : sequence of bytes
        Vendor name, product code, revision; together at most 230 bytes.
    functions : container of int
        The function codes that the device has. Reading holding registers and reading input registers is the
        same: one map of addresses.
    """

    addresses: Container[int]
    read: Callable[[int, int], Sequence[int]]
    write: Callable[[int, Sequence[int]], None]
    identity: Sequence[bytes]
    functions: Container[int] = HOLDING_FUNCTIONS


def answer(request: bytes, model: DataModel) -> bytes:
    """The answer PDU to a request PDU of at least one byte, an exception where it must be one."""
    code, body = request[0], request[1:]
    handler = _FUNCTIONS.get(code)
    if handler is None or code not in model.functions:
        return exception(code, protocol.ILLEGAL_FUNCTION)
    try:
        return bytes([code]) + handler(model, body)
    except Refusal as refusal:
        return exception(code, refusal.exception_code)


def exception(function_code: int, exception_code: int) -> bytes:
    """An exception PDU."""
    return bytes([function_code | 0x80, exception_code])


def _read_registers(model: DataModel, body: bytes) -> bytes:
    address, count = _fields(">HH", body)
    _check(1 <= count <= 125, protocol.ILLEGAL_VALUE)
    _check_addresses(model, address, count)
    return _counted(_registers(model.read(address, count)))


def _write_register(model: DataModel, body: bytes) -> bytes:
    address, value = _fields(">HH", body)
    _check_addresses(model, address, 1)
    model.write(address, [value])
    return body


def _write_registers(model: DataModel, body: bytes) -> bytes:
    address, count, byte_count = _fields(">HHB", body[:5])
    _check(1 <= count <= 123, protocol.ILLEGAL_VALUE)
    _check(byte_count == len(body[5:]) == 2 * count, protocol.ILLEGAL_VALUE)
    _check_addresses(model, address, count)
    model.write(address, struct.unpack(f">{count}H", body[5:]))
    return body[:4]


def _read_write_registers(model: DataModel, body: bytes) -> bytes:
    """Function 23: writes first, then reads."""
    read_at, read_count, write_at, write_count, byte_count = _fields(">HHHHB", body[:9])
    _check(1 <= read_count <= 125 and 1 <= write_count <= 121, protocol.ILLEGAL_VALUE)
    _check(byte_count == len(body[9:]) == 2 * write_count, protocol.ILLEGAL_VALUE)
    _check_addresses(model, read_at, read_count)
    _check_addresses(model, write_at, write_count)
    model.write(write_at, struct.unpack(f">{write_count}H", body[9:]))
    return _counted(_registers(model.read(read_at, read_count)))


def _identify(model: DataModel, body: bytes) -> bytes:
    """Read Device Identification: a stream of the basic objects (codes 1 to 3), or one of them (4).

    A client that asks for more than the basic objects gets the basic ones, and one that begins behind
    the last gets them from the first on, as section 6.21 has it.
    """
    _check(body[:1] == bytes([_MEI_IDENTIFICATION]), protocol.ILLEGAL_FUNCTION)
    code, first = _fields(">BB", body[1:])
    _check(1 <= code <= _SINGLE_OBJECT, protocol.ILLEGAL_VALUE)
    exists = first < len(model.identity)
    _check(exists or code != _SINGLE_OBJECT, protocol.ILLEGAL_ADDRESS)
    begin = first if exists else 0
    end = begin + 1 if code == _SINGLE_OBJECT else len(model.identity)
    objects = b"".join(_identity_objects(model.identity, begin, end))
    # Then: nothing follows, so there is no next object; how many there are here.
    head = bytes([_MEI_IDENTIFICATION, code, _BASIC_STREAM_AND_SINGLE, 0, 0, end - begin])
    return head + objects


def _identity_objects(identity: Sequence[bytes], begin: int, end: int) -> Iterator[bytes]:
    for number in range(begin, end):
        yield bytes([number, len(identity[number])]) + identity[number]


_FUNCTIONS: Mapping[int, Callable[[DataModel, bytes], bytes]] = {
    protocol.READ_HOLDING_REGISTERS: _read_registers,
    protocol.READ_INPUT_REGISTERS: _read_registers,
    protocol.WRITE_SINGLE_REGISTER: _write_register,
    protocol.WRITE_MULTIPLE_REGISTERS: _write_registers,
    protocol.READ_WRITE_MULTIPLE_REGISTERS: _read_write_registers,
    protocol.READ_DEVICE_IDENTIFICATION: _identify,
}

BROADCAST_FUNCTIONS = {protocol.WRITE_SINGLE_REGISTER, protocol.WRITE_MULTIPLE_REGISTERS}
"""Requests that may go to all devices on a serial line at once; no device answers them."""


def _fields(layout: str, body: bytes) -> tuple[Any, ...]:
    try:
        return struct.unpack(layout, body)
    except struct.error:  # too short or too long: its implied length is wrong
        raise Refusal(protocol.ILLEGAL_VALUE) from None


def _check(is_right: bool, exception_code: int) -> None:
    if not is_right:
        raise Refusal(exception_code)


def _check_addresses(model: DataModel, address: int, count: int) -> None:
    wanted = range(address, address + count)
    _check(all(one in model.addresses for one in wanted), protocol.ILLEGAL_ADDRESS)


def _registers(values: Sequence[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


def _counted(data: bytes) -> bytes:
    return bytes([len(data)]) + data
