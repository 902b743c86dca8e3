"""The D/A driver: one Modbus/TCP write of three registers sets the mirror's three stacks."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ModbusDacDevice
from fitctl.drivers.interface import (
    DeviceError,
    DeviceIdentity,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.modbus_dac.protocol import (
    CHANNELS,
    EXCEPTIONS,
    READ_DEVICE_IDENTIFICATION,
    READ_HOLDING_REGISTERS,
    WRITE_MULTIPLE_REGISTERS,
    decode_counts,
    encode_volts,
)

if TYPE_CHECKING:
    from pymodbus.client import ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

_NAME = "D/A"


class ModbusDac:
    """Three D/A channels; a :class:`~fitctl.drivers.interface.MirrorDac`.

    A request is sent once and never repeated: a repeated write would move the mirror late. A broken
    link is not mended inside a request either; :meth:`open` is the only way back. One request takes
    at most twice `response_timeout_s`, and that only if the answer dribbles in.

    Parameters
    ----------
    dac : ModbusDacDevice
        Where the station is, and what its registers mean.
    """

    def __init__(self, dac: ModbusDacDevice) -> None:
        self._dac = dac
        self._endpoint = f"{dac.host}:{dac.port}"
        self._client: ModbusTcpClient | None = None

    def open(self) -> DeviceIdentity:
        """Connect, and read the three registers to see that they exist; outputs stay as they are.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        # Importing pymodbus takes 120 ms, and most commands never need it.
        from pymodbus.client import ModbusTcpClient

        # Its own log lines would say on stderr what the exceptions here already say.
        logging.getLogger("pymodbus").addHandler(logging.NullHandler())
        self.close()
        client = ModbusTcpClient(
            self._dac.host,
            port=self._dac.port,
            timeout=self._dac.response_timeout_s,
            retries=0,
        )
        try:
            got = "" if client.connect() else "no connection"
        except (OSError, ValueError) as error:  # ValueError: a host that is no name at all
            got = str(error)
        if got:
            raise DeviceUnreachable(
                _NAME,
                self._endpoint,
                "a Modbus/TCP station",
                got,
                "check its power, its cable, and dac.host and dac.port in the rig file",
            )
        self._client = client
        try:
            self.read_v()
            return self._identify()
        except DeviceError:
            self.close()
            raise

    def write_v(self, volts: NDArray[np.float64]) -> None:
        """Set all three channels by one write of three registers.

        Parameters
        ----------
        volts : float array, shape (3,)
            From 0 to full scale, stack 1 first.

        Raises
        ------
        ValueError
            If a voltage is out of range; nothing is sent.
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        dac = self._dac
        registers = encode_volts(volts.tolist(), dac.full_scale_v, dac.bits)
        answer = self._ask(
            WRITE_MULTIPLE_REGISTERS,
            lambda client: client.write_registers(
                dac.first_register, registers, device_id=dac.device_id
            ),
        )
        if (answer.address, answer.count) != (dac.first_register, CHANNELS):
            raise self._nonsense(
                f"{CHANNELS} registers written from {dac.first_register} on",
                f"{answer.count} from {answer.address} on",
            )

    def read_v(self) -> NDArray[np.float64]:
        """Read what the channels are set to.

        Returns
        -------
        float array, shape (3,)

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        dac = self._dac
        answer = self._ask(
            READ_HOLDING_REGISTERS,
            lambda client: client.read_holding_registers(
                dac.first_register, count=CHANNELS, device_id=dac.device_id
            ),
        )
        try:
            return np.array(decode_counts(answer.registers, dac.full_scale_v, dac.bits))
        except ValueError as error:
            raise self._nonsense(f"{CHANNELS} registers of {dac.bits} bits", str(error)) from None

    def close(self) -> None:
        """Disconnect; outputs stay as they are, until the station's own watchdog acts."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def _identify(self) -> DeviceIdentity:
        """Who answers, by Read Device Identification (2B/0E), which many stations do not have."""
        from pymodbus.constants import DeviceInformation

        try:
            answer = self._ask(
                READ_DEVICE_IDENTIFICATION,
                lambda client: client.read_device_information(
                    read_code=DeviceInformation.BASIC, device_id=self._dac.device_id
                ),
            )
        except (DeviceRefused, DeviceTimeout):
            return DeviceIdentity("unknown", "Modbus/TCP D/A", "", "")
        fields = getattr(answer, "information", {})
        texts = [_text(fields.get(number, b"")) for number in range(3)]
        return DeviceIdentity(maker=texts[0], model=texts[1], serial="", firmware=texts[2])

    def _ask(
        self, function_code: int, request: Callable[[ModbusTcpClient], ModbusPDU]
    ) -> ModbusPDU:
        """Send one request and check that its answer is one to `function_code`."""
        from pymodbus.exceptions import ConnectionException, ModbusException

        client = self._client
        # Asked without a socket, pymodbus would connect by itself, and wait for that.
        if client is None or not client.connected:
            raise DeviceUnreachable(
                _NAME, self._endpoint, "an open connection", "none", "open it again"
            )
        limit_s = self._dac.response_timeout_s
        started_s = time.monotonic()
        try:
            answer = request(client)
        except (ConnectionException, OSError) as error:
            self.close()
            got = f"a broken connection ({error.__class__.__name__})"
            hint = "check its power and its cable, then recover"
            raise DeviceUnreachable(
                _NAME, self._endpoint, f"an answer to function {function_code}", got, hint
            ) from error
        except ModbusException as error:
            # pymodbus has one exception for silence and for garbage; silence takes its full time.
            if time.monotonic() - started_s >= 0.95 * limit_s:
                raise DeviceTimeout(
                    _NAME,
                    self._endpoint,
                    f"an answer to function {function_code} within {limit_s:g} s",
                    "none",
                    "check dac.device_id, and that the station is not busy with another master",
                ) from error
            raise self._nonsense(f"an answer to function {function_code}", str(error)) from error
        if answer.isError():
            code = answer.exception_code
            name, hint = EXCEPTIONS.get(code, ("an unknown exception", "see the station's manual"))
            raise DeviceRefused(
                _NAME,
                self._endpoint,
                f"function {function_code} to be carried out",
                f"exception {code:02X}, {name}",
                hint,
            )
        if answer.function_code != function_code:
            raise self._nonsense(
                f"an answer to function {function_code}", f"one to {answer.function_code}"
            )
        return answer

    def _nonsense(self, expected: str, got: str) -> DeviceProtocolError:
        """An answer that cannot be; the connection goes, because the next one would be out of step."""
        self.close()
        hint = "check that dac.host and dac.port lead to a Modbus/TCP station"
        return DeviceProtocolError(_NAME, self._endpoint, expected, got, hint)


def _text(value: object) -> str:
    return value.decode("ascii", "replace") if isinstance(value, bytes) else ""
