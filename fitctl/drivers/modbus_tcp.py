"""A Modbus/TCP connection on which nobody waits: requests out, answers in, matched by their number.

What is called every period or every frame goes on without an answer, and reads a late one when it comes.
"""

from __future__ import annotations

import select
import socket
import struct
import time

from pymodbus.pdu import ModbusPDU

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

# So many answers more than requests, since the last one; with still more, a caller would read without end.
_MOST_UNASKED = 100
_SO_TIMESTAMPNS = 35  # of Linux; not in Python's socket module
_TIMESPEC = struct.Struct("@ll")
_STAMP_BYTES = socket.CMSG_SPACE(_TIMESPEC.size)


class ModbusLink:
    """One connection; closed after anything that is no Modbus message.

    Parameters
    ----------
    endpoint : Endpoint
    host, port : str, int
    unit : int
    timeout_s : float
        Limit of connecting and of :meth:`ask`.
    station : str
        What errors call the device at the other end, such as ``"the I/O station"``.
    keys : str
        The table of the rig file that has `host` and `port`.

    Attributes
    ----------
    arrived_s : float
        Host's monotonic time at which the kernel received what was read last; at which it was read where the
        kernel has no stamp of it, as in the first milliseconds after the first socket that wants one.

    Raises
    ------
    DeviceUnreachable
        If nobody listens there.
    """

    def __init__(
        self,
        endpoint: Endpoint,
        host: str,
        port: int,
        *,
        unit: int,
        timeout_s: float,
        station: str,
        keys: str,
    ) -> None:
        self.arrived_s = 0.0
        self._endpoint = endpoint
        self._unit = unit
        self._timeout_s = timeout_s
        self._station = station
        self._keys = keys
        self._pending = bytearray()
        self._transaction = 0
        self._owed = 0  # answers to requests sent that have not come; negative where too many have
        try:
            self._socket = socket.create_connection((host, port), timeout_s)
        except (OSError, UnicodeError) as error:  # UnicodeError: a host that is no name at all
            raise endpoint.error(
                DeviceUnreachable,
                f"{station} to accept a connection",
                str(error),
                f"check its power and cable, and {keys}.host and .port",
            ) from error
        self._socket.setblocking(False)
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)

    def send(self, request: ModbusPDU) -> int:
        """Send a request without waiting; returns the number that its answer will have.

        Raises
        ------
        DeviceUnreachable
            Also when the station has read nothing for so long that no request fits into the buffers.
        """
        self._transaction = self._transaction + 1 & 0xFFFF
        request.transaction_id, request.dev_id = self._transaction, self._unit
        try:
            self._socket.sendall(TCP.buildFrame(request))
        except OSError as error:
            raise self._broken(str(error)) from error
        self._owed = max(self._owed, 0) + 1  # what came twice before counts no more
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
                self._owed -= 1
                if self._owed < -_MOST_UNASKED:
                    raise self.nonsense("one answer to a request", "more, without end")
                return answer
            try:
                data = self._read()
            except BlockingIOError:
                left_s = deadline_s - time.monotonic()
                if left_s <= 0 or not select.select([self._socket], [], [], left_s)[0]:
                    return None
                continue
            except OSError as error:
                raise self._broken(str(error)) from error
            if not data:
                raise self._broken("closed by the station")
            self._pending += data

    def ask(self, request: ModbusPDU) -> bytes:
        """The answer's PDU to a request; empty when none comes within the time limit.

        Raises
        ------
        DeviceUnreachable, DeviceProtocolError
        """
        number = self.send(request)
        deadline_s = time.monotonic() + self._timeout_s
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
        hint = f"check that {self._keys}.host and .port lead to {self._station}, then recover"
        return self._endpoint.error(DeviceProtocolError, expected, got, hint)

    def _read(self) -> bytes:
        data, ancillary, _, _ = self._socket.recvmsg(ANSWER_BYTES_MAX, _STAMP_BYTES)
        self.arrived_s = time.monotonic()
        for level, kind, stamp in ancillary:
            if (level, kind) == (socket.SOL_SOCKET, _SO_TIMESTAMPNS):
                seconds, nanoseconds = _TIMESPEC.unpack(stamp)
                waited_ns = time.time_ns() - (1_000_000_000 * seconds + nanoseconds)
                self.arrived_s -= max(0, waited_ns) * 1e-9
        return data

    def _broken(self, got: str) -> DeviceUnreachable:
        self.close()
        return self._endpoint.error(
            DeviceUnreachable,
            "a connection",
            f"a broken one ({got})",
            f"check the power and the cable of {self._station}, then recover",
        )
