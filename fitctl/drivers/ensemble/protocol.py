"""The Ensemble's ASCII interface as both sides see it: answers, status words, parameters, numbers.

A command is a line. Its answer begins with one character that reports the result; a value and a newline
follow. Bits and characters as in Aerotech's C headers and in epics-motor/motorAerotech, which
was verified with firmware 4.01. Status words are printed as signed 32-bit integers.
"""

from __future__ import annotations

import math
from enum import Enum, IntEnum, IntFlag

EOS = b"\n"
COMMAND_BYTES_MAX = 1024

PROBE = "NONE"
"""No command at all: the controller answers that it does not understand, so it is there."""


class Reply(Enum):
    """The first character of an answer, as the controller's parameters have it by default."""

    DONE = b"%"
    NOT_UNDERSTOOD = b"!"
    FAULT = b"#"
    TIMEOUT = b"$"


class AxisStatus(IntFlag):
    """Bits of AXISSTATUS that are used here.

    CLOCKWISE is the direction of the active or of the last motion. The three limit inputs are levels at the
    pins, whatever polarity the controller has been given: unconnected ones read high.
    """

    ENABLED = 1 << 0
    HOMED = 1 << 1
    IN_POSITION = 1 << 2
    MOVING = 1 << 3
    ACCELERATING = 1 << 4
    DECELERATING = 1 << 5
    CLOCKWISE = 1 << 9
    HOMING = 1 << 14
    CW_END_OF_TRAVEL = 1 << 22
    CCW_END_OF_TRAVEL = 1 << 23
    HOME_LIMIT = 1 << 24
    EMERGENCY_STOP = 1 << 31


class AxisFault(IntFlag):
    """Bits of AXISFAULT."""

    POSITION_ERROR = 1 << 0
    OVER_CURRENT = 1 << 1
    CW_END_OF_TRAVEL = 1 << 2
    CCW_END_OF_TRAVEL = 1 << 3
    CW_SOFTWARE_LIMIT = 1 << 4
    CCW_SOFTWARE_LIMIT = 1 << 5
    AMPLIFIER = 1 << 6
    POSITION_FEEDBACK = 1 << 7
    VELOCITY_FEEDBACK = 1 << 8
    HALL_SENSOR = 1 << 9
    VELOCITY_COMMAND = 1 << 10
    EMERGENCY_STOP = 1 << 11
    VELOCITY_ERROR = 1 << 12
    EXTERNAL = 1 << 15
    MOTOR_TEMPERATURE = 1 << 17
    AMPLIFIER_TEMPERATURE = 1 << 18
    ENCODER = 1 << 19
    COMMUNICATION_LOST = 1 << 20


class Parameter(IntEnum):
    """Numbers of axis parameters, the same in all headers that are public.

    Except those of the fault masks, which are in the maker's header for the Ensemble alone.
    """

    COUNTS_PER_UNIT = 2
    FAULT_MASK = 26
    FAULT_MASK_DISABLE = 27
    FAULT_MASK_DECEL = 28
    POSITION_ERROR_THRESHOLD = 32
    SOFTWARE_LIMIT_LOW = 37
    SOFTWARE_LIMIT_HIGH = 38
    POSITION_FEEDBACK_TYPE = 47
    DEFAULT_RAMP_RATE = 72
    ABORT_DECEL_RATE = 73


FAULT_MASKS = (Parameter.FAULT_MASK, Parameter.FAULT_MASK_DISABLE, Parameter.FAULT_MASK_DECEL)
SOFTWARE_LIMITS = AxisFault.CW_SOFTWARE_LIMIT | AxisFault.CCW_SOFTWARE_LIMIT


def why_limits_may_not_act(status: int, raised: int, disabling: int, stopping: int) -> str:
    """What may keep an axis from stopping at its software limits; empty if nothing is known.

    Parameters
    ----------
    status : int
        AXISSTATUS. On the maker's newer controllers, no software limit acts before the axis has been homed.
    raised, disabling, stopping : int
        FaultMask, FaultMaskDisable and FaultMaskDecel: which faults are raised, and which of them end a
        motion.
    """
    if not status & AxisStatus.HOMED:
        return "not homed"
    if raised & SOFTWARE_LIMITS != SOFTWARE_LIMITS:
        return f"FaultMask 0x{raised:X} without software limits (0x{SOFTWARE_LIMITS:X})"
    ending = disabling | stopping
    if ending & SOFTWARE_LIMITS != SOFTWARE_LIMITS:
        return f"FaultMaskDecel and FaultMaskDisable 0x{ending:X} without software limits"
    return ""


def fault_text(faults: int) -> str:
    """An AXISFAULT word for people."""
    known = [fault for fault in AxisFault if faults & fault]
    names = [(fault.name or "").lower().replace("_", " ") for fault in known]
    rest = faults & ~sum(known)
    return ", ".join([*names, f"0x{rest:X}"] if rest else names)


def format_bits(bits: int) -> str:
    """A status word as the controller prints it: signed."""
    return str(((bits + 0x8000_0000) & 0xFFFF_FFFF) - 0x8000_0000)


def parse_bits(text: str) -> int:
    """A status word, printed signed or unsigned, from an answer's value; unsigned.

    Raises
    ------
    ValueError
        If it is not an integer of 32 bits.
    """
    bits = int(text)
    if not -0x8000_0000 <= bits <= 0xFFFF_FFFF:
        msg = f"more than 32 bits: {bits}"
        raise ValueError(msg)
    return bits & 0xFFFF_FFFF


def parse_number(text: str) -> float:
    """A number from an answer's value.

    Raises
    ------
    ValueError
        If it is not a finite number.
    """
    number = float(text)
    if not math.isfinite(number):
        msg = f"not a number: {text}"
        raise ValueError(msg)
    return number


def decimals(counts_per_unit: float) -> int:
    """Digits behind the point that a hundredth of an encoder count needs, in the controller's units."""
    return max(1, math.ceil(math.log10(abs(counts_per_unit))) + 2)
