"""The wire to a Modbus station, TCP or RTU: one request out, its answer in, whatever else comes.

A request and its answer are two system calls over TCP. An answer to an earlier request (late, repeated, or
in the wrong order) is thrown away: over TCP by its transaction number; over RTU, which has none, by its
function code, and if it comes before the next request is sent.
"""

from __future__ import annotations

import socket
import struct
import time
from typing import Protocol

import serial
from pymodbus.pdu import ModbusPDU

from fitctl.config import ModbusDacDevice
from fitctl.drivers.modbus import ANSWER_BYTES_MAX, RTU, TCP, pop_answer, pop_rtu_answer
from fitctl.drivers.modbus_dac.protocol import rtu_silence_s

_RECEIVE_BYTES = 4096
_EXCEPTION_FLAG = 0x80


class NonsenseError(Exception):
    """What came is no Modbus answer; its text says what came."""


class Link(Protocol):
    """One wire to one station. All errors of the wire itself are :class:`OSError`."""

    def send(self, request: ModbusPDU) -> None:
        """Send a request; whatever came before it is no answer to it."""
        ...

    def receive(self) -> bytes | None:
        """The PDU of the answer to the last request; None when none came within `response_timeout_s`.

        Takes at most twice that time, and only if the answer comes in pieces. Raises NonsenseError when
        something else came.
        """
        ...

    def close(self) -> None:
        """Disconnect; safe to call twice."""
        ...


class TcpLink:
    """Modbus/TCP.

    Parameters
    ----------
    dac : ModbusDacDevice

    Raises
    ------
    OSError, UnicodeError
        If nobody listens there, or the host is no name at all.
    """

    def __init__(self, dac: ModbusDacDevice) -> None:
        self._unit = dac.device_id
        self._timeout_s = dac.response_timeout_s
        self._transaction = 0
        self._pending = bytearray()
        self._socket = socket.create_connection((dac.host, dac.port), dac.response_timeout_s)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        limit_receiving(self._socket, dac.response_timeout_s)

    def send(self, request: ModbusPDU) -> None:
        """Send a request under a new transaction number."""
        self._transaction = self._transaction + 1 & 0xFFFF
        request.transaction_id, request.dev_id = self._transaction, self._unit
        self._socket.sendall(TCP.buildFrame(request))

    def receive(self) -> bytes | None:
        """The answer with the request's number; answers with other numbers are thrown away."""
        deadline_s = 0.0
        while True:
            try:
                data = self._socket.recv(_RECEIVE_BYTES)
            except BlockingIOError:  # the time limit
                if self._pending:
                    raise NonsenseError(_shown(self._pending)) from None
                return None
            if not data:
                raise ConnectionResetError("closed by the station")
            self._pending += data
            try:
                while (answer := pop_answer(self._pending)) is not None:
                    if answer.transaction == self._transaction:
                        if answer.unit != self._unit:
                            raise NonsenseError(f"an answer of unit {answer.unit}")
                        return answer.pdu
            except ValueError as error:
                raise NonsenseError(str(error)) from None
            # An answer that comes whole never gets here: the kernel has kept its time limit.
            now_s = time.monotonic()
            deadline_s = deadline_s or now_s + self._timeout_s
            if now_s > deadline_s:
                return None

    def close(self) -> None:
        """Disconnect."""
        self._socket.close()


class RtuLink:
    """Modbus RTU on a serial port, or on one behind a terminal server (``socket://host:port``).

    Parameters
    ----------
    dac : ModbusDacDevice

    Raises
    ------
    OSError, ValueError
        If there is no such port, or it cannot be set so.
    """

    def __init__(self, dac: ModbusDacDevice) -> None:
        self._unit = dac.device_id
        self._timeout_s = dac.response_timeout_s
        self._silence_s = rtu_silence_s(dac.baud_rate)
        self._free_s = 0.0
        self._function_code = 0
        data_bits, parity, stop_bits = dac.serial_format
        self._port = serial.serial_for_url(
            dac.serial_port,
            baudrate=dac.baud_rate,
            bytesize=int(data_bits),
            parity=parity,
            stopbits=int(stop_bits),
            timeout=dac.response_timeout_s,
            write_timeout=dac.response_timeout_s,
            exclusive=True,
        )

    def send(self, request: ModbusPDU) -> None:
        """Send a request once the line has been silent for long enough."""
        wait_s = self._free_s - time.monotonic()
        if wait_s > 0:
            time.sleep(wait_s)
        self._port.read(self._port.in_waiting)  # late, or twice: no answer to what follows
        self._function_code = request.function_code
        request.dev_id = self._unit
        self._port.write(RTU.buildFrame(request))

    def receive(self) -> bytes | None:
        """The first answer of our unit to the request's function that passes its check."""
        pending, heard = bytearray(), bytearray()
        deadline_s = time.monotonic() + self._timeout_s
        self._free_s = deadline_s + self._timeout_s  # without an answer, wait for a late one first
        while time.monotonic() < deadline_s:
            data = self._port.read(max(1, self._port.in_waiting))
            pending += data
            heard += data
            while (pdu := pop_rtu_answer(pending, self._unit)) is not None:
                if pdu[0] & ~_EXCEPTION_FLAG == self._function_code:
                    self._free_s = time.monotonic() + self._silence_s
                    return pdu
            del pending[:-ANSWER_BYTES_MAX]
        if heard:
            raise NonsenseError(_shown(heard))
        return None

    def close(self) -> None:
        """Close the port."""
        self._port.close()


def limit_receiving(link: socket.socket, limit_s: float) -> None:
    """Have the kernel end a wait for data after `limit_s`: without a poll before each receive."""
    link.settimeout(None)
    seconds = int(limit_s)
    limit = struct.pack("@ll", seconds, max(1, round(1e6 * (limit_s - seconds))))
    link.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
    link.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)


def _shown(data: bytes | bytearray) -> str:
    return f"{len(data)} bytes: {bytes(data[:32]).hex(' ')}"
