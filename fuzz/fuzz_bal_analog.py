"""Coverage-guided fuzzing of what parses the analogue I/O station's wire on the driver's side.

The mock's side is the Modbus server of all mocks: see fuzz_modbus_dac.py.
"""

from __future__ import annotations

from fitctl.drivers.bal_analog.protocol import REGISTERS, unwrap
from fitctl.drivers.modbus import decode_exception, decode_identity, decode_registers, pop_answer
from fitctl.mocks.modbus.tcp import frame

_READ, _READ_WRITE = 3, 23


def TestOneInput(data: bytes) -> None:  # noqa: N802 - atheris wants this name
    """Any bytes are answers, the start of one, or an error."""
    pending = bytearray(data)
    try:
        while (answer := pop_answer(pending)) is not None:
            assert pop_answer(bytearray(frame(*answer))) == answer
            decode_identity(answer.pdu)
            decode_exception(answer.pdu, _READ_WRITE)
            _read(answer.pdu)
    except ValueError:
        return


def _read(pdu: bytes) -> None:
    for function_code in (_READ, _READ_WRITE):
        try:
            for register in decode_registers(pdu, function_code, REGISTERS):
                assert unwrap(register, 1_000_000) & 0xFFFF == register
        except ValueError:
            continue


if __name__ == "__main__":
    from harness import fuzz

    fuzz(TestOneInput)
