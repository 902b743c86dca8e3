"""The D/A converter's registers: volts to counts and back, and what its refusals mean.

Function and exception codes are those of the MODBUS Application Protocol Specification V1.1b3.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

CHANNELS = 3

READ_HOLDING_REGISTERS = 3
READ_INPUT_REGISTERS = 4
WRITE_SINGLE_REGISTER = 6
WRITE_MULTIPLE_REGISTERS = 16
READ_WRITE_MULTIPLE_REGISTERS = 23
READ_DEVICE_IDENTIFICATION = 43

ILLEGAL_FUNCTION = 0x01
ILLEGAL_ADDRESS = 0x02
ILLEGAL_VALUE = 0x03
DEVICE_FAILURE = 0x04
DEVICE_BUSY = 0x06
NO_SUCH_DEVICE = 0x0B

EXCEPTIONS = {
    ILLEGAL_FUNCTION: ("illegal function", "this station cannot write several registers at once"),
    ILLEGAL_ADDRESS: ("illegal data address", "check dac.first_register"),
    ILLEGAL_VALUE: ("illegal data value", "check dac.bits"),
    DEVICE_FAILURE: (
        "device failure",
        "see whether its watchdog has tripped and how it is reset, and check dac.bits and dac.device_id",
    ),
    0x05: ("acknowledge", "the station needs longer than a D/A may; see its manual"),
    DEVICE_BUSY: ("device busy", "see whether another master writes to it"),
    0x08: ("memory parity error", "the station needs service"),
    0x0A: ("gateway path unavailable", "check dac.device_id"),
    NO_SUCH_DEVICE: ("gateway target does not respond", "check dac.device_id"),
}

_SILENT_CHARACTERS = 3.5
_SILENCE_FROM_19200_BAUD_S = 1.75e-3


def rtu_silence_s(baud_rate: int) -> float:
    """The silence between two RTU frames (MODBUS over Serial Line V1.02, section 2.5.1.1)."""
    if baud_rate > 19200:
        return _SILENCE_FROM_19200_BAUD_S
    return _SILENT_CHARACTERS * 11 / baud_rate


def counts_max(bits: int) -> int:
    """The count that stands for full scale."""
    return (1 << bits) - 1


def encode_volts(volts: Sequence[float], full_scale_v: float, bits: int) -> list[int]:
    """Volts to counts, rounded to nearest.

    Parameters
    ----------
    volts : sequence of three floats
        One a channel, stack 1 first.
    full_scale_v : float
        The voltage of the highest count.
    bits : int
        The converter's resolution.

    Raises
    ------
    ValueError
        If there are not three, or one is not a number from 0 to `full_scale_v`; names the channel.
    """
    if len(volts) != CHANNELS:
        msg = f"the D/A has {CHANNELS} channels, got {len(volts)} voltages"
        raise ValueError(msg)
    for channel, value in enumerate(volts, 1):
        if not (math.isfinite(value) and 0 <= value <= full_scale_v):
            msg = f"channel {channel} gives 0 to {full_scale_v:g} V, asked for {value!r} V"
            raise ValueError(msg)
    scale = counts_max(bits) / full_scale_v
    return [round(value * scale) for value in volts]


def decode_counts(counts: Sequence[int], full_scale_v: float, bits: int) -> list[float]:
    """Counts to volts.

    Raises
    ------
    ValueError
        If there are not three, or one is beyond the converter's resolution; names the channel.
    """
    if len(counts) != CHANNELS:
        msg = f"the D/A has {CHANNELS} channels, got {len(counts)} registers"
        raise ValueError(msg)
    highest = counts_max(bits)
    for channel, value in enumerate(counts, 1):
        if not 0 <= value <= highest:
            msg = f"channel {channel} has 0 to {highest} counts, got {value}"
            raise ValueError(msg)
    return [value / highest * full_scale_v for value in counts]
