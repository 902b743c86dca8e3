"""The Modbus/TCP connection to the I/O station: requests out, answers in, matched by their number.

A servo goes on after one period, and takes a late answer when it comes.
"""

from __future__ import annotations

import select
import socket
import time

from pymodbus.pdu import ModbusPDU

from fitctl.config import BalAnalogDevice
from fitctl.drivers.amplifiers import DEVICE
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceIdentity, DeviceProtocolError, DeviceUnreachable
from fitctl.drivers.modbus import (
    ANSWER_BYTES_MAX,
    TCP,
    Answer,
    decode_identity,
    encode_identify,
    pop_answer,
)


class ModbusLink:
    """One connection; closed after anything that is no Modbus message.

    Parameters
    ----------
    device : BalAnalogDevice

    Raises
    ------
    DeviceUnreachable
        If nobody listens there.
    """

    def __init__(self, device: BalAnalogDevice) -> None:
        self._device = device
        self._endpoint = Endpoint(DEVICE, device.endpoint)
        self._pending = bytearray()
        self._transaction = 0
        try:
            self._socket = socket.create_connection(
                (device.host, device.port), device.response_timeout_s
            )
        except (OSError, UnicodeError) as error:  # UnicodeError: a host that is no name at all
            raise self._endpoint.error(
                DeviceUnreachable,
                "a Modbus I/O station",
                str(error),
                "check its power and cable, and siderostat.device.host and .port",
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, request: ModbusPDU) -> int:
        """Send a request; returns the number that its answer will have.

        Raises
        ------
        DeviceUnreachable
        """
        self._transaction = self._transaction + 1 & 0xFFFF
        request.transaction_id, request.dev_id = self._transaction, self._device.device_id
        try:
            self._socket.sendall(TCP.buildFrame(request))
        except OSError as error:
            raise self._broken(str(error)) from error
        return self._transaction

    def receive(self, deadline_s: float) -> Answer | None:
        """The next answer; None when none is complete by `deadline_s`.

        Raises
        ------
        DeviceUnreachable, DeviceProtocolError
        """
        while True:
            try:
                answer = pop_answer(self._pending)
            except ValueError as error:
                raise self.nonsense("a Modbus header", str(error)) from None
            if answer is not None:
                return answer
            try:
                left_s = max(0.0, deadline_s - time.monotonic())
                if not select.select([self._socket], [], [], left_s)[0]:
                    return None
                data = self._socket.recv(ANSWER_BYTES_MAX)
            except (OSError, ValueError) as error:  # ValueError: closed before
                raise self._broken(str(error)) from error
            if not data:
                raise self._broken("closed by the station")
            self._pending += data

    def ask(self, request: ModbusPDU) -> bytes:
        """The answer's PDU to a request; empty when none comes within `response_timeout_s`.

        Raises
        ------
        DeviceUnreachable, DeviceProtocolError
        """
        number = self.send(request)
        deadline_s = time.monotonic() + self._device.response_timeout_s
        while (answer := self.receive(deadline_s)) is not None:
            if answer.transaction == number:
                return answer.pdu
        return b""

    def identify(self) -> DeviceIdentity:
        """Who the station is; many cannot say.

        Raises
        ------
        DeviceUnreachable, DeviceProtocolError
        """
        maker, model, firmware = decode_identity(self.ask(encode_identify()))
        return DeviceIdentity(maker or "unknown", model or "Modbus I/O", "", firmware)

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        self._socket.close()

    def nonsense(self, expected: str, got: str) -> DeviceProtocolError:
        """The error for an answer that cannot be; the link is closed."""
        self.close()
        hint = "check that siderostat.device.host and .port lead to the I/O station, then recover"
        return self._endpoint.error(DeviceProtocolError, expected, got, hint)

    def _broken(self, got: str) -> DeviceUnreachable:
        self.close()
        return self._endpoint.error(
            DeviceUnreachable,
            "a connection",
            f"a broken one ({got})",
            "check the I/O station's power and cable, then recover",
        )
