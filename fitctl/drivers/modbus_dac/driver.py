"""The D/A driver: one Modbus write of three registers sets the mirror's three stacks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from pymodbus.pdu import ModbusPDU, ReadHoldingRegistersRequest
from pymodbus.pdu.register_message import (
    WriteMultipleRegistersRequest,
    WriteMultipleRegistersResponse,
)

from fitctl.config import ModbusDacDevice
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceIdentity,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.modbus import (
    decode_exception,
    decode_identity,
    decode_registers,
    encode_identify,
    encode_pdu,
)
from fitctl.drivers.modbus_dac.link import Link, NonsenseError, RtuLink, TcpLink
from fitctl.drivers.modbus_dac.protocol import (
    CHANNELS,
    EXCEPTIONS,
    decode_counts,
    encode_volts,
)

_NAME = "D/A"
_EQUAL_READINGS = 3
_MOST_READINGS = 6


class ModbusDac:
    """Three D/A channels by Modbus/TCP or RTU; a :class:`~fitctl.drivers.interface.MirrorDac`.

    A request is sent once and never repeated: a repeated write would move the mirror late. A broken
    link is not mended inside a request either; :meth:`open` is the only way back. One request takes
    at most twice `response_timeout_s`, and that only if the answer comes in pieces; over RTU, where a late
    answer looks like the right one, the request after an unanswered one first waits that time once more
    for what is late, and throws it away.

    Parameters
    ----------
    dac : ModbusDacDevice
        Where the station is, and what its registers mean.
    """

    def __init__(self, dac: ModbusDacDevice) -> None:
        self._dac = dac
        self._endpoint = Endpoint(_NAME, dac.endpoint)
        self._link: Link | None = None
        self._written = encode_pdu(
            WriteMultipleRegistersResponse(address=dac.first_register, count=CHANNELS)
        )
        self._unconfirmed: ModbusPDU | None = None

    def open(self) -> DeviceIdentity:
        """Connect, and read the three registers to see that they exist; outputs stay as they are.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        try:
            self._link = (RtuLink if self._dac.transport == "rtu" else TcpLink)(self._dac)
        except (OSError, ValueError) as error:  # ValueError: a host that is no name at all
            raise self._endpoint.error(
                DeviceUnreachable,
                "a Modbus station",
                str(error),
                f"check its power, its cable, and {self._where} in the rig file",
            ) from error
        try:
            self.read_v()
            return self._identify()
        except DeviceError:
            self.close()
            raise

    def send_v(self, volts: NDArray[np.float64]) -> None:
        """Send one write of three registers, which sets all three channels; :meth:`confirm` is next.

        Parameters
        ----------
        volts : float array, shape (3,)
            From 0 to full scale, stack 1 first.

        Raises
        ------
        ValueError
            If a voltage is out of range; nothing is sent.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
            If an earlier write was never confirmed, also for its reasons; then nothing is sent.
        """
        dac = self._dac
        counts = encode_volts(volts.tolist(), dac.full_scale_v, dac.bits)
        self.confirm()
        self._send(WriteMultipleRegistersRequest(address=dac.first_register, registers=counts))

    def confirm(self) -> None:
        """Wait for the answer to the last :meth:`send_v`, no longer than `response_timeout_s`.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        if self._unconfirmed is None:
            return
        answer = self._receive(self._unconfirmed)
        if answer != self._written:
            raise self._nonsense(
                f"{CHANNELS} registers written from {self._dac.first_register} on", answer.hex(" ")
            )

    def read_v(self) -> NDArray[np.float64]:
        """Read what the channels are set to.

        Modbus/TCP has no check of its own, so that a bit turned on the way inside a station or gateway
        would go unseen, and over RTU an answer may be an earlier one come twice; a value counts when it is
        read three times in a row.

        Returns
        -------
        float array, shape (3,)

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        readings = [self.read_counts()]
        while readings[-_EQUAL_READINGS:] != [readings[-1]] * _EQUAL_READINGS:
            if len(readings) == _MOST_READINGS:
                raise self._nonsense(f"the same counts {_EQUAL_READINGS} times", str(readings))
            readings.append(self.read_counts())
        dac = self._dac
        try:
            return np.array(decode_counts(readings[-1], dac.full_scale_v, dac.bits))
        except ValueError as error:
            raise self._nonsense(f"{CHANNELS} registers of {dac.bits} bits", str(error)) from None

    def read_counts(self) -> list[int]:
        """Read the registers once; raises as :meth:`read_v`, which reads more than once."""
        request = ReadHoldingRegistersRequest(address=self._dac.first_register, count=CHANNELS)
        answer = self._ask(request)
        try:
            return decode_registers(answer, request.function_code, CHANNELS)
        except ValueError as error:
            raise self._nonsense(f"{CHANNELS} registers", str(error)) from None

    def close(self) -> None:
        """Disconnect; outputs stay as they are, until the station's own watchdog acts."""
        link, self._link, self._unconfirmed = self._link, None, None
        if link is not None:
            link.close()

    @property
    def _where(self) -> str:
        """The keys of the rig file that say where the station is."""
        rtu = "dac.serial_port, dac.baud_rate and dac.serial_format"
        return rtu if self._dac.transport == "rtu" else "dac.host and dac.port"

    def _identify(self) -> DeviceIdentity:
        """Who answers, by Read Device Identification (2B/0E), which many stations do not have."""
        try:
            answer = self._ask(encode_identify())
        except (DeviceRefused, DeviceTimeout):
            return DeviceIdentity("unknown", "Modbus D/A", "", "")
        maker, model, firmware = decode_identity(answer)
        return DeviceIdentity(maker, model, "", firmware)

    def _ask(self, request: ModbusPDU) -> bytes:
        self.confirm()
        self._send(request)
        return self._receive(request)

    def _send(self, request: ModbusPDU) -> None:
        if self._link is None:
            raise self._endpoint.not_open()
        try:
            self._link.send(request)
        except OSError as error:
            raise self._broken(error) from error
        self._unconfirmed = request

    def _receive(self, request: ModbusPDU) -> bytes:
        """The answer's PDU to the request that was just sent, if it is one to its function and no refusal."""
        self._unconfirmed = None
        function_code = request.function_code
        expected = f"an answer to function {function_code}"
        if self._link is None:
            raise self._endpoint.not_open()
        try:
            answer = self._link.receive()
        except NonsenseError as error:
            raise self._nonsense(expected, str(error)) from None
        except OSError as error:
            raise self._broken(error) from error
        if answer is None:
            raise self._endpoint.error(
                DeviceTimeout,
                f"{expected} within {self._dac.response_timeout_s:g} s",
                "none",
                f"check dac.device_id, {self._where}, and that no other master keeps it busy",
            )
        if answer[0] == function_code:
            return answer
        code = decode_exception(answer, function_code)
        if code is None:
            raise self._nonsense(expected, answer[:32].hex(" "))
        name, hint = EXCEPTIONS.get(code, ("an unknown exception", "see the station's manual"))
        raise self._endpoint.error(
            DeviceRefused,
            f"function {function_code} to be carried out",
            f"exception {code:02X}, {name}",
            hint,
        )

    def _broken(self, error: OSError) -> DeviceUnreachable:
        self.close()
        return self._endpoint.error(
            DeviceUnreachable,
            "an answer",
            f"a broken connection ({error})",
            "check its power and its cable, then recover",
        )

    def _nonsense(self, expected: str, got: str) -> DeviceProtocolError:
        """An answer that cannot be; the connection goes, because the next one would be out of step."""
        self.close()
        hint = f"check that {self._where} lead to the D/A, and that nothing else talks on its line"
        return self._endpoint.error(DeviceProtocolError, expected, got, hint)
