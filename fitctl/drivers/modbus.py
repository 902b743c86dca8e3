"""pymodbus' codecs for the drivers, made strict: they return exact answers and reject everything else.

pymodbus' framers and PDU classes encode requests and decode answers. They are made for pymodbus' own client,
which expects one answer and nothing else: at a header of another protocol `FramerSocket` waits for more data
without end, `FramerRTU` discards all pending bytes after a bad check or a good frame, and the PDU classes
ignore surplus bytes. The functions here pass one frame at a time to the framers and check what they ignore.
"""

from __future__ import annotations

import logging
from typing import NamedTuple

from pymodbus.constants import DeviceInformation
from pymodbus.framer import FramerRTU, FramerSocket
from pymodbus.pdu import DecodePDU, ExceptionResponse, ModbusPDU, ReadDeviceInformationRequest
from pymodbus.pdu.mei_message import ReadDeviceInformationResponse

# Its log lines would repeat on stderr what the drivers' exceptions already report.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())

ANSWER_BYTES_MAX = 260

_DECODER = DecodePDU(is_server=False)
TCP = FramerSocket(_DECODER)
RTU = FramerRTU(_DECODER)

_PROTOCOL_AND_LENGTH = slice(2, 6)  # of a TCP header; the protocol is 0
_LENGTH_MIN, _LENGTH_MAX = 3, 254  # the unit and a PDU of 2 bytes (an exception) to 253
_OBJECTS = 3


class Answer(NamedTuple):
    """One answer without its TCP frame."""

    transaction: int
    unit: int
    pdu: bytes


def pop_answer(pending: bytearray) -> Answer | None:
    """Remove the first whole TCP answer from `pending`; None while there is none.

    Raises
    ------
    ValueError
        If the header is not that of a Modbus answer, so that nobody knows where the next one begins.
    """
    if len(pending) >= _PROTOCOL_AND_LENGTH.stop:
        protocol_and_length = int.from_bytes(pending[_PROTOCOL_AND_LENGTH], "big")
        if not _LENGTH_MIN <= protocol_and_length <= _LENGTH_MAX:
            protocol, length = divmod(protocol_and_length, 1 << 16)
            msg = f"protocol {protocol}, length {length}"
            raise ValueError(msg)
    size, unit, transaction, pdu = TCP.decode(bytes(pending))
    if not size:
        return None
    del pending[:size]
    return Answer(transaction, unit, pdu)


def pop_rtu_answer(pending: bytearray, unit: int) -> bytes | None:
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
    for begin in range(len(pending) - RTU.MIN_SIZE + 1):
        if pending[begin] != unit:
            continue
        data = bytes(pending[begin:])
        answer_class = _DECODER.lookupPduClass(data)
        size = answer_class.calculateRtuFrameSize(data) if answer_class else 0
        *_, pdu = RTU.decode(data[:size])
        if pdu:
            del pending[: begin + size]
            return pdu
    return None


def encode_pdu(message: ModbusPDU) -> bytes:
    """A request or an answer without a frame."""
    return bytes([message.function_code]) + message.encode()


def decode_registers(pdu: bytes, function_code: int, count: int) -> list[int]:
    """The registers in the answer of a function that reads some.

    Raises
    ------
    ValueError
        If it is not that answer, with that many registers and nothing else.
    """
    answer = _DECODER.decode(pdu)
    if (
        answer is None
        or answer.function_code != function_code
        or len(answer.registers) != count
        or encode_pdu(answer) != pdu
    ):
        msg = f"{len(pdu)} bytes: {pdu[:32].hex(' ')}"
        raise ValueError(msg)
    return list(answer.registers)


def decode_exception(pdu: bytes, function_code: int) -> int | None:
    """The exception code with which a station refused a function; None if the PDU is no such refusal."""
    answer = _DECODER.decode(pdu)
    if answer is None or pdu != encode_pdu(ExceptionResponse(function_code, answer.exception_code)):
        return None
    return answer.exception_code


def encode_identify() -> ReadDeviceInformationRequest:
    """The request for a station's basic identification."""
    return ReadDeviceInformationRequest(read_code=DeviceInformation.BASIC)


def decode_identity(pdu: bytes) -> list[str]:
    """Vendor, product and revision; empty where the answer does not have them."""
    answer = _DECODER.decode(pdu)
    if not isinstance(answer, ReadDeviceInformationResponse):
        return [""] * _OBJECTS
    return [_text(answer.information.get(number, b"")) for number in range(_OBJECTS)]


def _text(value: bytes | list[bytes]) -> str:
    """An object of an identification, of which pymodbus makes a list where it comes more than once."""
    last = value[-1] if isinstance(value, list) else value
    return last.decode("ascii", "replace")
