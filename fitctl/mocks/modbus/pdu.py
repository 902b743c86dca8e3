"""What a Modbus server answers: a request PDU in, an answer PDU out, nothing else.

Checks are made in the order of the state diagrams of the MODBUS Application Protocol Specification
V1.1b3, section 6: function (exception 01), quantities and lengths (03), addresses (02), doing it (04).
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Container, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from fitctl.drivers.modbus_dac import protocol

COILS = "coils"
DISCRETE_INPUTS = "discrete inputs"
HOLDING_REGISTERS = "holding registers"
INPUT_REGISTERS = "input registers"

_MEI_IDENTIFICATION = 0x0E
_BASIC_STREAM_AND_SINGLE = 0x81  # conformity level: the three basic objects, both ways to ask
_SINGLE_OBJECT = 4
_COIL_VALUES = {0x0000: 0, 0xFF00: 1}


class DeviceFailure(Exception):
    """The device cannot do what was asked, though the request is right: exception 04."""


class _Refusal(Exception):
    def __init__(self, exception_code: int) -> None:
        super().__init__(exception_code)
        self.exception_code = exception_code


@dataclass(frozen=True, slots=True)
class DataModel:
    """What a device shows to Modbus.

    Attributes
    ----------
    addresses : mapping
        By table (`COILS`, `DISCRETE_INPUTS`, `HOLDING_REGISTERS`, `INPUT_REGISTERS`), the addresses that
        exist in it, counted from 0; often a range. Functions on a table that is not here are unknown.
    read : callable
        Gets table, first address and count; gives as many values, bits as 0 or 1, registers unsigned.
    write : callable
        Gets table, first address and values. Only existing addresses are asked for, by both; each may
        raise `DeviceFailure`.
    identity : sequence of bytes
        Vendor name, product code, revision; together at most 230 bytes.
    """

    addresses: Mapping[str, Container[int]]
    read: Callable[[str, int, int], Sequence[int]]
    write: Callable[[str, int, Sequence[int]], None]
    identity: Sequence[bytes]


def answer(request: bytes, model: DataModel) -> bytes:
    """The answer PDU to a request PDU of at least one byte, an exception where it must be one."""
    code, body = request[0], request[1:]
    handler, table = _FUNCTIONS.get(code, (None, ""))
    if handler is None or (table and table not in model.addresses):
        return exception(code, protocol.ILLEGAL_FUNCTION)
    try:
        return bytes([code]) + handler(model, table, body)
    except _Refusal as refusal:
        return exception(code, refusal.exception_code)
    except DeviceFailure:
        return exception(code, protocol.DEVICE_FAILURE)


def exception(function_code: int, exception_code: int) -> bytes:
    """An exception PDU."""
    return bytes([function_code | 0x80, exception_code])


def _read_bits(model: DataModel, table: str, body: bytes) -> bytes:
    address, count = _fields(">HH", body)
    _check(1 <= count <= 2000, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, address, count)
    bits = model.read(table, address, count)
    packed = sum(bit << place for place, bit in enumerate(bits))
    return _counted(packed.to_bytes((count + 7) // 8, "little"))


def _read_registers(model: DataModel, table: str, body: bytes) -> bytes:
    address, count = _fields(">HH", body)
    _check(1 <= count <= 125, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, address, count)
    return _counted(_registers(model.read(table, address, count)))


def _write_coil(model: DataModel, table: str, body: bytes) -> bytes:
    address, value = _fields(">HH", body)
    _check(value in _COIL_VALUES, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, address, 1)
    model.write(table, address, [_COIL_VALUES[value]])
    return body


def _write_register(model: DataModel, table: str, body: bytes) -> bytes:
    address, value = _fields(">HH", body)
    _check_addresses(model, table, address, 1)
    model.write(table, address, [value])
    return body


def _write_coils(model: DataModel, table: str, body: bytes) -> bytes:
    address, count, byte_count = _fields(">HHB", body[:5])
    packed = body[5:]
    _check(1 <= count <= 1968, protocol.ILLEGAL_VALUE)
    _check(byte_count == len(packed) == (count + 7) // 8, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, address, count)
    bits = int.from_bytes(packed, "little")
    model.write(table, address, [bits >> place & 1 for place in range(count)])
    return body[:4]


def _write_registers(model: DataModel, table: str, body: bytes) -> bytes:
    address, count, byte_count = _fields(">HHB", body[:5])
    _check(1 <= count <= 123, protocol.ILLEGAL_VALUE)
    _check(byte_count == len(body[5:]) == 2 * count, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, address, count)
    model.write(table, address, struct.unpack(f">{count}H", body[5:]))
    return body[:4]


def _read_write_registers(model: DataModel, table: str, body: bytes) -> bytes:
    """Function 23: writes first, then reads."""
    read_at, read_count, write_at, write_count, byte_count = _fields(">HHHHB", body[:9])
    _check(1 <= read_count <= 125 and 1 <= write_count <= 121, protocol.ILLEGAL_VALUE)
    _check(byte_count == len(body[9:]) == 2 * write_count, protocol.ILLEGAL_VALUE)
    _check_addresses(model, table, read_at, read_count)
    _check_addresses(model, table, write_at, write_count)
    model.write(table, write_at, struct.unpack(f">{write_count}H", body[9:]))
    return _counted(_registers(model.read(table, read_at, read_count)))


def _identify(model: DataModel, table: str, body: bytes) -> bytes:
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


_FUNCTIONS: Mapping[int, tuple[Callable[[DataModel, str, bytes], bytes] | None, str]] = {
    protocol.READ_COILS: (_read_bits, COILS),
    protocol.READ_DISCRETE_INPUTS: (_read_bits, DISCRETE_INPUTS),
    protocol.READ_HOLDING_REGISTERS: (_read_registers, HOLDING_REGISTERS),
    protocol.READ_INPUT_REGISTERS: (_read_registers, INPUT_REGISTERS),
    protocol.WRITE_SINGLE_COIL: (_write_coil, COILS),
    protocol.WRITE_SINGLE_REGISTER: (_write_register, HOLDING_REGISTERS),
    protocol.WRITE_MULTIPLE_COILS: (_write_coils, COILS),
    protocol.WRITE_MULTIPLE_REGISTERS: (_write_registers, HOLDING_REGISTERS),
    protocol.READ_WRITE_MULTIPLE_REGISTERS: (_read_write_registers, HOLDING_REGISTERS),
    protocol.READ_DEVICE_IDENTIFICATION: (_identify, ""),
}

BROADCAST_FUNCTIONS = {
    protocol.WRITE_SINGLE_COIL,
    protocol.WRITE_SINGLE_REGISTER,
    protocol.WRITE_MULTIPLE_COILS,
    protocol.WRITE_MULTIPLE_REGISTERS,
}
"""What may be asked of all devices on a serial line at once; nobody answers that."""


def _fields(layout: str, body: bytes) -> tuple[Any, ...]:
    try:
        return struct.unpack(layout, body)
    except struct.error:  # too short or too long: its implied length is wrong
        raise _Refusal(protocol.ILLEGAL_VALUE) from None


def _check(is_right: bool, exception_code: int) -> None:
    if not is_right:
        raise _Refusal(exception_code)


def _check_addresses(model: DataModel, table: str, address: int, count: int) -> None:
    exist = model.addresses[table]
    wanted = range(address, address + count)
    _check(all(one in exist for one in wanted), protocol.ILLEGAL_ADDRESS)


def _registers(values: Sequence[int]) -> bytes:
    return struct.pack(f">{len(values)}H", *values)


def _counted(data: bytes) -> bytes:
    return bytes([len(data)]) + data
