"""Coverage-guided fuzzing of what parses the Ensemble's wire, on both sides: driver and mock.

The first byte chooses the side, the rest is what comes over the line.
"""

from __future__ import annotations

from fitctl.drivers.ensemble.protocol import (
    EOS,
    Parameter,
    Reply,
    format_bits,
    parse_bits,
    parse_number,
)
from fitctl.mocks.ensemble.axis import HOME_OFFSET, HOME_RAMP_RATE, HOME_SPEED, Axis
from fitctl.mocks.ensemble.commands import Interpreter
from fitctl.mocks.ensemble.controller import LineSplitter

_PARAMETERS = {
    Parameter.COUNTS_PER_UNIT: 4000.0,
    Parameter.POSITION_ERROR_THRESHOLD: 0.25,
    Parameter.SOFTWARE_LIMIT_LOW: -12.5,
    Parameter.SOFTWARE_LIMIT_HIGH: 12.5,
    Parameter.DEFAULT_RAMP_RATE: 10.0,
    Parameter.FAULT_MASK: 0x30,
    Parameter.FAULT_MASK_DISABLE: 0,
    Parameter.FAULT_MASK_DECEL: 0x30,
    Parameter.ABORT_DECEL_RATE: 1000.0,
    HOME_SPEED: 1.0,
    HOME_OFFSET: 0.0,
    HOME_RAMP_RATE: 10.0,
}
_PERIOD_S = 0.002


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Any bytes leave both sides alive, and what the mock says the driver can read."""
    if not data:
        return
    if data[0] % 2:
        _driver_reads(data[1:].decode("ascii", "replace"))
    else:
        _mock_takes(data[1:])


def _driver_reads(text: str) -> None:
    try:
        bits = parse_bits(text)
    except ValueError:
        pass
    else:
        assert parse_bits(format_bits(bits)) == bits
    try:
        parse_number(text)
    except ValueError:
        return


def _mock_takes(data: bytes) -> None:
    tables = [dict(_PARAMETERS), dict(_PARAMETERS)]
    axes = [Axis(table) for table in tables]
    interpreter = Interpreter(axes, tables, ["X", "Y"])
    for line in LineSplitter().feed(data + EOS):
        reply, value = interpreter.answer(line.decode("ascii", "replace"))
        if reply is Reply.DONE and value not in {"", "X", "Y"}:
            parse_number(value)
        for axis in axes:
            axis.step(axis.feedback + axis.motor_velocity * _PERIOD_S, _PERIOD_S)
            parse_bits(format_bits(axis.status))


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
