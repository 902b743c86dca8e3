"""The I/O station before the analogue amplifiers as both sides see it: registers and counts.

Function 23 (Read/Write Multiple Registers) of the MODBUS Application Protocol Specification V1.1b3. Outputs are
two analogue channels and a word of digital ones; inputs two counters and a word of digital ones: analogue
before digital, as stations map them.
"""

from __future__ import annotations

import math

REGISTERS = 3
COUNTER_MODULUS = 1 << 16

EXCEPTIONS = {
    0x01: "illegal function: the station does not know function 23",
    0x02: "illegal data address",
    0x03: "illegal data value",
    0x04: "device failure",
    0x06: "device busy",
    0x0A: "gateway path unavailable",
    0x0B: "gateway target does not respond",
}


def velocity_to_counts(
    velocity_rad_s: float, rad_s_per_v: float, full_scale_v: float, full_scale_counts: int
) -> int:
    """The register of a velocity command: two's complement, held within full scale.

    Raises
    ------
    ValueError
        If the velocity is not a finite number.
    """
    if not math.isfinite(velocity_rad_s):
        msg = f"velocity must be a finite number of rad/s, not {velocity_rad_s}"
        raise ValueError(msg)
    part = max(-1.0, min(1.0, velocity_rad_s / rad_s_per_v / full_scale_v))
    return round(part * full_scale_counts) & 0xFFFF


def counts_to_volts(register: int, full_scale_v: float, full_scale_counts: int) -> float:
    """What a station's output gives for a register, held within full scale."""
    counts = signed(register)
    return max(-1.0, min(1.0, counts / full_scale_counts)) * full_scale_v


def signed(register: int) -> int:
    """A register as two's complement."""
    return ((register + 0x8000) & 0xFFFF) - 0x8000


def unwrap(counter: int, near: int) -> int:
    """The count nearest to `near` that a 16-bit counter shows as `counter`."""
    return near + signed(counter - near & 0xFFFF)


def lines(word: int, level: str) -> tuple[bool, bool]:
    """Which of both axes' lines, bits 0 and 1 of a word, are at the level that means yes."""
    if level == "low":
        word = ~word
    return bool(word & 1), bool(word & 2)


def word_of(az: bool, el: bool, level: str) -> int:
    """The word in which both axes' lines are at their level; the other way round of `lines`."""
    word = az | el << 1
    return word if level == "high" else ~word & 0b11
