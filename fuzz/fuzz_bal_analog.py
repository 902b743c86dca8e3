"""Coverage-guided fuzzing of what parses the analogue I/O station's wire on the driver's side.

The mock's side is the Modbus server of all mocks: see fuzz_modbus_dac.py.
"""

from __future__ import annotations

from fitctl.drivers.bal_analog.protocol import (
    READ_WRITE_MULTIPLE_REGISTERS,
    decode_registers,
    unwrap,
)
from fitctl.drivers.modbus import READ_HOLDING_REGISTERS, decode_identity, frame, pop_message


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Any bytes are messages, the start of one, or an error."""
    pending = bytearray(data)
    try:
        while (message := pop_message(pending)) is not None:
            sent = bytearray(frame(*message[:3]))
            assert pop_message(sent) == message._replace(protocol=0)
            decode_identity(message.pdu)
            _read(message.pdu)
    except ValueError:
        return


def _read(pdu: bytes) -> None:
    for function_code in (READ_HOLDING_REGISTERS, READ_WRITE_MULTIPLE_REGISTERS):
        try:
            for register in decode_registers(pdu, function_code):
                assert unwrap(register, 1_000_000) & 0xFFFF == register
        except ValueError:
            continue


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
