"""The D/A driver: one Modbus write of three registers sets the mirror's three stacks."""

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
    rtu_silence_s,
)

if TYPE_CHECKING:
    from pymodbus.client import ModbusSerialClient, ModbusTcpClient
    from pymodbus.pdu import ModbusPDU

    Client = ModbusTcpClient | ModbusSerialClient

_NAME = "D/A"
_EQUAL_READINGS = 3
_SHOWN_BYTES = 32

# Its log lines would say on stderr what the exceptions here already say.
logging.getLogger("pymodbus").addHandler(logging.NullHandler())


class ModbusDac:
    """Three D/A channels by Modbus/TCP or RTU; a :class:`~fitctl.drivers.interface.MirrorDac`.

    A request is sent once and never repeated: a repeated write would move the mirror late. A broken
    link is not mended inside a request either; :meth:`open` is the only way back. One request takes
    at most twice `response_timeout_s`, and that only if the answer dribbles in; over RTU, where a late
    answer looks like the right one, the request after an unanswered one first waits that time once more
    for what is late, and throws it away.

    Parameters
    ----------
    dac : ModbusDacDevice
        Where the station is, and what its registers mean.
    """

    def __init__(self, dac: ModbusDacDevice) -> None:
        self._dac = dac
        self._endpoint = dac.endpoint
        self._client: Client | None = None
        is_rtu = dac.transport == "rtu"
        self._silence_s = rtu_silence_s(dac.baud_rate) if is_rtu else 0.0
        self._late_s = dac.response_timeout_s if is_rtu else 0.0
        self._line_free_s = 0.0
        self._heard = b""

    def open(self) -> DeviceIdentity:
        """Connect, and read the three registers to see that they exist; outputs stay as they are.

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        self.close()
        client = self._make_client()
        try:
            got = "" if client.connect() else "no connection"
        except (OSError, ValueError) as error:  # ValueError: a host that is no name at all
            got = str(error)
        if got:
            raise DeviceUnreachable(
                _NAME,
                self._endpoint,
                "a Modbus station",
                got,
                f"check its power, its cable, and {self._where} in the rig file",
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

        Modbus/TCP has no check of its own, so that a bit turned on the way inside a station or gateway
        would go unseen; a value counts when it is read three times in a row.

        Returns
        -------
        float array, shape (3,)

        Raises
        ------
        DeviceUnreachable, DeviceTimeout, DeviceRefused, DeviceProtocolError
        """
        readings = [self.read_counts() for _ in range(_EQUAL_READINGS)]
        if any(reading != readings[0] for reading in readings):
            raise self._nonsense(f"the same counts {_EQUAL_READINGS} times", str(readings))
        dac = self._dac
        try:
            return np.array(decode_counts(readings[0], dac.full_scale_v, dac.bits))
        except ValueError as error:
            raise self._nonsense(f"{CHANNELS} registers of {dac.bits} bits", str(error)) from None

    def close(self) -> None:
        """Disconnect; outputs stay as they are, until the station's own watchdog acts."""
        if self._client is not None:
            self._client.close()
            self._client = None

    def _make_client(self) -> Client:
        # Importing pymodbus takes 120 ms, and most commands never need it.
        from pymodbus.client import ModbusSerialClient, ModbusTcpClient

        dac = self._dac
        if dac.transport == "rtu":
            data_bits, parity, stop_bits = dac.serial_format
            return ModbusSerialClient(
                dac.serial_port,
                baudrate=dac.baud_rate,
                bytesize=int(data_bits),
                parity=parity,
                stopbits=int(stop_bits),
                timeout=dac.response_timeout_s,
                retries=0,
                trace_packet=self._hear,
            )
        return ModbusTcpClient(
            dac.host,
            port=dac.port,
            timeout=dac.response_timeout_s,
            retries=0,
            trace_packet=self._hear,
        )

    @property
    def _where(self) -> str:
        """The keys of the rig file that say where the station is."""
        rtu = "dac.serial_port, dac.baud_rate and dac.serial_format"
        return rtu if self._dac.transport == "rtu" else "dac.host and dac.port"

    def _hear(self, sending: bool, data: bytes) -> bytes:
        """Keep what came since the last request; pymodbus has one exception for silence and garbage."""
        self._heard = b"" if sending else data
        return data

    def read_counts(self) -> list[int]:
        """What one request gives, as it came; raises as :meth:`read_v`, which asks for more than one."""
        dac = self._dac
        answer = self._ask(
            READ_HOLDING_REGISTERS,
            lambda client: client.read_holding_registers(
                dac.first_register, count=CHANNELS, device_id=dac.device_id
            ),
        )
        return list(answer.registers)

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
            return DeviceIdentity("unknown", "Modbus D/A", "", "")
        fields = getattr(answer, "information", {})
        texts = [_text(fields.get(number, b"")) for number in range(3)]
        return DeviceIdentity(maker=texts[0], model=texts[1], serial="", firmware=texts[2])

    def _ask(self, function_code: int, request: Callable[[Client], ModbusPDU]) -> ModbusPDU:
        """Send one request and check that its answer is one to `function_code`."""
        from pymodbus.exceptions import ConnectionException, ModbusException

        client = self._client
        # Asked without a socket, pymodbus would connect by itself, and wait for that.
        if client is None or not client.connected:
            raise DeviceUnreachable(
                _NAME, self._endpoint, "an open connection", "none", "open it again"
            )
        limit_s = self._dac.response_timeout_s
        expected = f"an answer to function {function_code}"
        time.sleep(max(0.0, self._line_free_s - time.monotonic()))
        quiet_s = self._late_s
        try:
            answer = request(client)
            quiet_s = self._silence_s
        except (ConnectionException, OSError) as error:
            self.close()
            got = f"a broken connection ({error.__class__.__name__})"
            hint = "check its power and its cable, then recover"
            raise DeviceUnreachable(_NAME, self._endpoint, expected, got, hint) from error
        except ModbusException as error:
            if self._heard:
                shown = self._heard[:_SHOWN_BYTES].hex(" ")
                raise self._nonsense(expected, f"{len(self._heard)} bytes: {shown}") from error
            raise DeviceTimeout(
                _NAME,
                self._endpoint,
                f"{expected} within {limit_s:g} s",
                "none",
                f"check dac.device_id, {self._where}, and that no other master keeps it busy",
            ) from error
        finally:
            self._line_free_s = time.monotonic() + quiet_s
        # An exception has the function's code with the highest bit set.
        if answer.function_code & 0x7F != function_code:
            raise self._nonsense(expected, f"one to function {answer.function_code & 0x7F}")
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
        return answer

    def _nonsense(self, expected: str, got: str) -> DeviceProtocolError:
        """An answer that cannot be; the connection goes, because the next one would be out of step."""
        self.close()
        hint = f"check that {self._where} lead to the D/A, and that nobody else talks on its line"
        return DeviceProtocolError(_NAME, self._endpoint, expected, got, hint)


def _text(value: object) -> str:
    return value.decode("ascii", "replace") if isinstance(value, bytes) else ""
