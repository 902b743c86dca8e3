"""A LabJack T7's registers as both sides see them: addresses, types, and what its refusals mean.

Addresses, types, defaults and error numbers are those of LabJack's Modbus map, `ljm_constants.json` of the
repository ljm_constants (2025.12.18); functions and word order those of "Protocol Details [Direct Modbus
TCP]" on support.labjack.com; converter times and noise those of the T-Series Datasheet, appendix A-3-1.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

READ_HOLDING_REGISTERS = 3
READ_INPUT_REGISTERS = 4
WRITE_SINGLE_REGISTER = 6
WRITE_MULTIPLE_REGISTERS = 16
FUNCTIONS = frozenset(
    {
        READ_HOLDING_REGISTERS,
        READ_INPUT_REGISTERS,
        WRITE_SINGLE_REGISTER,
        WRITE_MULTIPLE_REGISTERS,
    }
)
"""Of the standard's functions; any of them reads or writes any address."""

ILLEGAL_FUNCTION = 0x01
ILLEGAL_ADDRESS = 0x02
ILLEGAL_VALUE = 0x03
DEVICE_FAILURE = 0x04
EXCEPTIONS = {
    ILLEGAL_FUNCTION: "illegal function",
    ILLEGAL_ADDRESS: "illegal data address, or a register that can only be read",
    ILLEGAL_VALUE: "illegal data value",
    DEVICE_FAILURE: "device failure",
    0x05: "acknowledge: it needs longer",
    0x06: "device busy",
    0x08: "memory parity error",
    0x0A: "gateway path unavailable",
    0x0B: "gateway target does not respond",
}


@dataclass(frozen=True, slots=True)
class Register:
    """A value at one or two consecutive 16-bit registers, the more significant one first."""

    address: int
    kind: Literal["UINT16", "UINT32", "FLOAT32"]

    @property
    def count(self) -> int:
        """How many 16-bit registers it takes."""
        return 1 if self.kind == "UINT16" else 2


INPUTS = 14  # AIN0 to AIN13 of the device itself
DIODES = 4  # AIN0 to AIN3, on its screw terminals
AIN_REGISTERS = 2  # of one input
AIN_ALL_RANGE = Register(43900, "FLOAT32")
AIN_ALL_NEGATIVE_CH = Register(43902, "UINT16")
AIN_ALL_RESOLUTION_INDEX = Register(43903, "UINT16")
AIN_ALL_SETTLING_US = Register(43904, "FLOAT32")
AIN_ALL = (AIN_ALL_RANGE, AIN_ALL_NEGATIVE_CH, AIN_ALL_RESOLUTION_INDEX, AIN_ALL_SETTLING_US)
"""Settings of all inputs at once, one after the other in the map."""
LAST_ERR_DETAIL = Register(55000, "UINT16")
PRODUCT_ID = Register(60000, "FLOAT32")
HARDWARE_VERSION = Register(60002, "FLOAT32")
FIRMWARE_VERSION = Register(60004, "FLOAT32")
HARDWARE_INSTALLED = Register(60010, "UINT32")
SERIAL_NUMBER = Register(60028, "UINT32")

T7 = 7.0  # PRODUCT_ID
HIGH_RESOLUTION = 1  # bit of HARDWARE_INSTALLED: a T7-Pro
SINGLE_ENDED = 199  # as negative channel
NOT_ALL_EQUAL = -9999.0  # what a FLOAT32 AIN_ALL register reads where inputs differ
NOT_ALL_EQUAL_UINT16 = 0xFFFF
UNEQUAL = (NOT_ALL_EQUAL, NOT_ALL_EQUAL_UINT16)
SETTLING_MAX_US = 50_000.0

ERRORS = {
    2313: "MODBUS_INVALID_NUM_REGISTERS: the count does not fit the registers' types",
    2315: "MODBUS_NUM_REGS_MUST_BE_EVEN: half of a 32-bit value",
    2370: "AIN_RANGE_INVALID",
    2371: "AIN_SETTLING_INVALID",
    2373: "AIN_NEGATIVE_CHANNEL_INVALID",
    2375: "AIN_RESOLUTION_INVALID: 9 to 12 need a T7-Pro",
    2460: "POWER_ANALOG_OFF: the analog inputs are switched off (POWER_AIN)",
}
"""What LAST_ERR_DETAIL can say about analog inputs."""
MUST_BE_EVEN = 2315
RANGE_INVALID, SETTLING_INVALID, NEGATIVE_INVALID, RESOLUTION_INVALID = 2370, 2371, 2373, 2375


class Converter(NamedTuple):
    """What a resolution index means in the range of 10 V; noise is RMS."""

    noise_v: float
    sample_s: float


CONVERTER = {
    1: Converter(316e-6, 0.04e-3),
    2: Converter(223e-6, 0.04e-3),
    3: Converter(158e-6, 0.1e-3),
    4: Converter(112e-6, 0.1e-3),
    5: Converter(84.6e-6, 0.2e-3),
    6: Converter(64.1e-6, 0.3e-3),
    7: Converter(45.3e-6, 0.6e-3),
    8: Converter(36.8e-6, 1.1e-3),
    9: Converter(26.0e-6, 3.5e-3),
    10: Converter(14.0e-6, 13.4e-3),
    11: Converter(8.02e-6, 66.2e-3),
    12: Converter(7.48e-6, 159e-3),
}
FIRST_PRO_INDEX = 9
DEFAULT_INDEX, DEFAULT_PRO_INDEX = 8, 9  # what index 0 stands for
LOW_OF_RANGE, HIGH_OF_RANGE = -1.05, 1.01  # typical ends of what an input can read, over its range
BEYOND_RANGE = 1.15  # over its range: readings are valid up to 11.5 V at an input


def encode(register: Register, value: float) -> list[int]:
    """The 16-bit registers of a value.

    Raises
    ------
    ValueError
        If the register's type has no such value.
    """
    try:
        data = struct.pack(
            _LAYOUTS[register.kind], value if register.kind == "FLOAT32" else int(value)
        )
    except (struct.error, OverflowError) as error:
        msg = f"{value!r} is no {register.kind}"
        raise ValueError(msg) from error
    return list(struct.unpack(f">{register.count}H", data))


def decode(register: Register, registers: Sequence[int]) -> float:
    """The value in a register's 16-bit registers; FLOAT32 may be NaN or infinite.

    Raises
    ------
    ValueError
        If there are not as many as the register has.
    """
    if len(registers) != register.count:
        msg = f"a {register.kind} has {register.count} registers, got {len(registers)}"
        raise ValueError(msg)
    data = struct.pack(f">{register.count}H", *registers)
    return struct.unpack(_LAYOUTS[register.kind], data)[0]


def as_float32(value: float) -> float:
    """The FLOAT32 nearest to a value."""
    return struct.unpack(">f", struct.pack(">f", value))[0]


def ain(number: int) -> Register:
    """The voltage of an input."""
    return Register(AIN_REGISTERS * number, "FLOAT32")


def decode_inputs(registers: Sequence[int]) -> list[float]:
    """The voltages in the registers of consecutive inputs, V; each may be NaN or infinite.

    Raises
    ------
    ValueError
        If the last input has only one register.
    """
    if len(registers) % AIN_REGISTERS:
        msg = f"inputs have {AIN_REGISTERS} registers each, got {len(registers)}"
        raise ValueError(msg)
    data = struct.pack(f">{len(registers)}H", *registers)
    return list(struct.unpack(f">{len(registers) // AIN_REGISTERS}f", data))


def converter(resolution_index: int, *, pro: bool) -> Converter:
    """Noise and time of one conversion at a resolution index, where 0 is the device's default."""
    return CONVERTER[resolution_index or (DEFAULT_PRO_INDEX if pro else DEFAULT_INDEX)]


_LAYOUTS = {"UINT16": ">H", "UINT32": ">I", "FLOAT32": ">f"}
