"""The connection to a T7: its registers as values, with errors that say what it refused."""

from __future__ import annotations

import math
from typing import NamedTuple

from pymodbus.pdu import ModbusPDU, ReadHoldingRegistersRequest
from pymodbus.pdu.register_message import (
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from fitctl.config import LabJackT7Device
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceIdentity,
    DeviceMismatch,
    DeviceRefused,
    DeviceTimeout,
)
from fitctl.drivers.labjack_t7 import protocol
from fitctl.drivers.labjack_t7.protocol import Register
from fitctl.drivers.modbus import Answer, decode_exception, decode_registers, encode_pdu
from fitctl.drivers.modbus_tcp import ModbusLink

DEVICE = "LabJack T7"
"""What errors call the device."""
KEYS = "sensor.device"
"""The table of the rig file that says where it is and how its inputs are set."""

_UNIT = 1
_READ = ReadHoldingRegistersRequest.function_code
_DIODE_REGISTERS = protocol.AIN_REGISTERS * protocol.DIODES
_SETTINGS_REGISTERS = sum(register.count for register in protocol.AIN_ALL)


class Facts(NamedTuple):
    """What a station reports of itself.

    Attributes
    ----------
    product : float
        7 is a T7.
    firmware : float
    serial_number : int
    pro : bool
        It has the high-resolution converter.
    """

    product: float
    firmware: float
    serial_number: int
    pro: bool

    @property
    def identity(self) -> DeviceIdentity:
        """Who answered."""
        model = f"T{self.product:g}" + ("-Pro" if self.pro else "")
        return DeviceIdentity("LabJack", model, str(self.serial_number), f"{self.firmware:.4f}")


class T7Link(ModbusLink):
    """One connection to a T7.

    Parameters
    ----------
    device : LabJackT7Device

    Raises
    ------
    DeviceUnreachable
        If nobody listens there.
    """

    def __init__(self, device: LabJackT7Device) -> None:
        super().__init__(
            Endpoint(DEVICE, device.endpoint),
            device.host,
            device.port,
            unit=_UNIT,
            timeout_s=device.response_timeout_s,
            station="the T7",
            keys=KEYS,
        )

    def read_facts(self) -> Facts:
        """What the station reports of itself.

        Raises
        ------
        DeviceError
            If it does not answer, or has no such registers: then it is no LabJack.
        """
        installed = int(self.read(protocol.HARDWARE_INSTALLED))
        return Facts(
            product=self.read(protocol.PRODUCT_ID),
            firmware=self.read(protocol.FIRMWARE_VERSION),
            serial_number=int(self.read(protocol.SERIAL_NUMBER)),
            pro=bool(installed & protocol.HIGH_RESOLUTION),
        )

    def read(self, register: Register) -> float:
        """The value of a register, which must be a finite number.

        Raises
        ------
        DeviceError
        """
        request = ReadHoldingRegistersRequest(address=register.address, count=register.count)
        registers = self._decode(self._ask(request), register.count)
        value = protocol.decode(register, registers)
        if not math.isfinite(value):
            raise self.nonsense(f"a number in register {register.address}", f"{value:g}")
        return value

    def set(self, register: Register, value: float) -> None:
        """Write a register and read it back.

        Raises
        ------
        DeviceError
        """
        registers = protocol.encode(register, value)
        written = WriteMultipleRegistersResponse(address=register.address, count=register.count)
        answer = self._ask(
            WriteMultipleRegistersRequest(address=register.address, registers=registers)
        )
        if answer != encode_pdu(written):
            expected = f"{register.count} registers written from {register.address} on"
            raise self.nonsense(expected, answer[:32].hex(" "))
        wanted, got = protocol.decode(register, registers), self.read(register)
        if got != wanted:
            raise self._endpoint.error(
                DeviceMismatch,
                f"register {register.address} to read {wanted:g}, as written",
                f"{got:g}",
                "see whether another client sets the T7's inputs, then recover",
            )

    def read_inputs(self) -> list[float]:
        """The voltages of AIN0 to AIN3, V; any FLOAT32.

        Raises
        ------
        DeviceError
        """
        return protocol.decode_inputs(self._decode(self._ask(_inputs_request()), _DIODE_REGISTERS))

    def request_inputs(self) -> int:
        """Ask for the voltages of AIN0 to AIN3 without waiting; returns the number that the answer will have.

        Raises
        ------
        DeviceUnreachable
        """
        return self.send(_inputs_request())

    def request_settings(self) -> int:
        """Ask for the settings of all inputs without waiting; returns the number that the answer will have.

        Raises
        ------
        DeviceUnreachable
        """
        return self.send(
            ReadHoldingRegistersRequest(
                address=protocol.AIN_ALL[0].address, count=_SETTINGS_REGISTERS
            )
        )

    def decode_inputs(self, answer: Answer) -> list[float]:
        """The voltages in the answer to :meth:`request_inputs`, V; any FLOAT32.

        Raises
        ------
        DeviceRefused, DeviceProtocolError
        """
        return protocol.decode_inputs(self._registers(answer, _DIODE_REGISTERS))

    def decode_settings(self, answer: Answer) -> dict[Register, float]:
        """The values in the answer to :meth:`request_settings`, by their registers.

        Raises
        ------
        DeviceRefused, DeviceProtocolError
        """
        registers = self._registers(answer, _SETTINGS_REGISTERS)
        first = protocol.AIN_ALL[0].address
        return {
            each: protocol.decode(each, registers[each.address - first :][: each.count])
            for each in protocol.AIN_ALL
        }

    def _registers(self, answer: Answer, count: int) -> list[int]:
        """The registers in the answer to a reading that was requested without waiting."""
        if answer.unit != _UNIT:
            raise self.nonsense(f"an answer of unit {_UNIT}", f"unit {answer.unit}")
        code = None if answer.pdu[0] == _READ else decode_exception(answer.pdu, _READ)
        if code is not None:
            raise self._refused(_READ, code)
        return self._decode(answer.pdu, count)

    def silent(self) -> DeviceTimeout:
        """The error for an answer that does not come."""
        return self._endpoint.error(
            DeviceTimeout,
            f"an answer within {self._timeout_s:g} s",
            "none",
            "check the T7's power and network, and how long its inputs take"
            f" ({KEYS}.resolution_index and .settling_us); then recover",
        )

    def _ask(self, request: ModbusPDU) -> bytes:
        """The PDU of the answer to a request, which is no refusal."""
        answer = self.ask(request)
        if not answer:
            raise self.silent()
        code = decode_exception(answer, request.function_code)
        if code is not None:
            raise self._refused(request.function_code, code, self._last_error())
        return answer

    def _last_error(self) -> str:
        """What the T7 says of the refusal that has just come; empty if it is no LabJack, which cannot."""
        register = protocol.LAST_ERR_DETAIL
        pdu = self.ask(ReadHoldingRegistersRequest(address=register.address, count=register.count))
        try:
            number = int(protocol.decode(register, decode_registers(pdu, _READ, register.count)))
        except ValueError:
            return ""
        return f" (LabJack error {protocol.ERRORS.get(number, number)})" if number else ""

    def _decode(self, pdu: bytes, count: int) -> list[int]:
        try:
            return decode_registers(pdu, _READ, count)
        except ValueError as error:
            raise self.nonsense(f"{count} registers", str(error)) from None

    def _refused(self, function_code: int, code: int, detail: str = "") -> DeviceRefused:
        name = protocol.EXCEPTIONS.get(code, "an unknown exception")
        return self._endpoint.error(
            DeviceRefused,
            f"function {function_code} to be carried out",
            f"exception {code:02X}, {name}{detail}",
            f"check that {KEYS}.host and .port lead to a T7, and its inputs' settings",
        )


def _inputs_request() -> ReadHoldingRegistersRequest:
    return ReadHoldingRegistersRequest(address=protocol.ain(0).address, count=_DIODE_REGISTERS)
