"""The control channel: GVCP commands with answers, retries and PENDING_ACK."""

from __future__ import annotations

import ipaddress
import itertools
import select
import socket
import threading
import time

from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Command, MalformedPacketError, Register
from fitctl.drivers.interface import (
    DeviceIdentity,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

DEVICE = "camera"
ATTEMPTS = 3
PENDING_LIMIT_S = 5.0  # a device that asks for more time than this for one command counts as silent
_MAX_ANSWER_BYTES = 2048


class ControlChannel:
    """One UDP socket to a camera's GVCP port. May be used from several threads: commands queue.

    Parameters
    ----------
    address : str
        The camera's IPv4 address; a host's name would be looked up for longer than any time limit.
    port : int
        Its GVCP port.
    timeout_s : float
        Time for one command, all attempts together. A camera that asks for more with PENDING_ACK gets
        up to `PENDING_LIMIT_S` besides, all attempts together.

    Raises
    ------
    DeviceUnreachable
        If the address is none, or the host has no way to it.
    """

    def __init__(self, address: str, port: int, timeout_s: float) -> None:
        self.endpoint = Endpoint(DEVICE, f"{address}:{port}")
        self.answered_s = time.monotonic()
        _check_address(address, self.endpoint)
        self._timeout_s = timeout_s
        self._lock = threading.Lock()
        self._counter = itertools.count()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.connect((address, port))
        except OSError as error:
            self._socket.close()
            raise self._unreachable(error) from error
        self._poll = select.poll()
        self._poll.register(self._socket, select.POLLIN)

    @property
    def local_address(self) -> str:
        """The host's address on the way to the camera."""
        return str(self._socket.getsockname()[0])

    def close(self) -> None:
        """Close the socket; safe to call twice."""
        with self._lock:
            self._socket.close()

    def read_register(self, address: int) -> int:
        """Read one 32-bit register."""
        payload = self.exchange(Command.READREG, protocol.encode_words(address))
        if len(payload) != 4:
            raise self._protocol_error("one register", f"{len(payload)} bytes")
        return protocol.decode_words(payload)[0]

    def write_register(self, address: int, value: int) -> None:
        """Write one 32-bit register."""
        self.exchange(Command.WRITEREG, protocol.encode_words(address, value))

    def read_memory(self, address: int, length: int) -> bytes:
        """Read `length` bytes, in as many commands as it takes."""
        data = bytearray()
        end = address + length
        for start in range(address, end, protocol.MEMORY_CHUNK_BYTES):
            count = min(-(-(end - start) // 4) * 4, protocol.MEMORY_CHUNK_BYTES)
            payload = self.exchange(Command.READMEM, protocol.encode_readmem(start, count))
            if len(payload) != 4 + count:
                raise self._protocol_error(f"{count} bytes of memory", f"{len(payload) - 4}")
            data += payload[4:]
        return bytes(data[:length])

    def write_memory(self, address: int, data: bytes) -> None:
        """Write `data`, in as many commands as it takes; its length is a multiple of 4."""
        for offset in range(0, len(data), protocol.MEMORY_CHUNK_BYTES):
            chunk = data[offset : offset + protocol.MEMORY_CHUNK_BYTES]
            self.exchange(Command.WRITEMEM, protocol.encode_words(address + offset) + chunk)

    def read_text(self, register: protocol.TextRegister) -> str:
        """Read a string register."""
        return text_of(self.read_memory(*register))

    def read_identity(self) -> DeviceIdentity:
        """Read the camera's maker, model, serial number and version."""
        return DeviceIdentity(
            maker=self.read_text(protocol.MAKER),
            model=self.read_text(protocol.MODEL),
            serial=self.read_text(protocol.SERIAL_NUMBER),
            firmware=self.read_text(protocol.DEVICE_VERSION),
        )

    def request_resend(self, request: protocol.Resend) -> None:
        """Ask for stream packets again; there is no answer, and no other command delays this.

        Raises
        ------
        DeviceUnreachable
            If the host learned that nothing listens at the endpoint any more.
        """
        payload = protocol.encode_resend(request)
        self._send(protocol.encode_command(Command.PACKETRESEND, self._next_id(), payload, flags=0))

    def release_unheard(self) -> None:
        """Give up control of a camera that may no longer be heard: no answer is waited for."""
        payload = protocol.encode_words(Register.CONTROL_PRIVILEGE, 0)
        self._send(protocol.encode_command(Command.WRITEREG, self._next_id(), payload, flags=0))

    def exchange(self, command: Command, payload: bytes) -> bytes:
        """Send a command and return the payload of its answer.

        Raises
        ------
        DeviceUnreachable
            If nothing listens at the endpoint.
        DeviceTimeout
            If no answer came to any attempt.
        DeviceRefused
            If the answer is an error status.
        DeviceProtocolError
            If the answer belongs to another command.
        """
        with self._lock:
            answer = self._answer(command, payload)
        what = f"{command.name} 0x{payload[:4].hex().upper()}"
        if protocol.is_error(answer.status):
            raise self.endpoint.error(
                DeviceRefused,
                f"{what} to succeed",
                protocol.status_name(answer.status),
                "the camera does not have this register or does not allow it now",
            )
        if answer.command != command + 1:
            raise self._protocol_error(
                f"acknowledge 0x{command + 1:04X} of {what}", f"0x{answer.command:04X}"
            )
        return answer.payload

    def _answer(self, command: Command, payload: bytes) -> protocol.AnswerPacket:
        request_id = self._next_id()
        packet = protocol.encode_command(command, request_id, payload)
        attempt_s = self._timeout_s / ATTEMPTS
        latest_s = time.monotonic() + PENDING_LIMIT_S
        for _attempt in range(ATTEMPTS):
            latest_s += attempt_s
            self._send(packet)
            answer = self._receive(command, request_id, payload, attempt_s, latest_s)
            if answer is not None:
                self.answered_s = time.monotonic()
                return answer
        raise self.endpoint.error(
            DeviceTimeout,
            f"an answer to {command.name} within {self._timeout_s:g} s",
            f"none to {ATTEMPTS} attempts",
            "check power, cable and camera.device.address in the rig file",
        )

    def _receive(
        self, command: Command, request_id: int, payload: bytes, timeout_s: float, latest_s: float
    ) -> protocol.AnswerPacket | None:
        """The answer to one attempt; late answers to earlier commands are passed over."""
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0:
            if not self._poll.poll(left_s * 1000):
                continue
            try:
                answer = protocol.decode_answer(self._socket.recv(_MAX_ANSWER_BYTES))
            except BlockingIOError:
                continue
            except OSError as error:
                raise self._unreachable(error) from error
            except MalformedPacketError as error:
                raise self._protocol_error("a GVCP answer", str(error)) from error
            if answer.request_id != request_id or _is_of_other_memory(answer, command, payload):
                continue
            if answer.command != protocol.PENDING_ACK:
                return answer
            more_s = self._pending_s(answer.payload)
            deadline_s = min(time.monotonic() + more_s + timeout_s, latest_s)
        return None

    def _pending_s(self, payload: bytes) -> float:
        try:
            return protocol.decode_pending_s(payload)
        except MalformedPacketError as error:
            raise self._protocol_error("a PENDING_ACK", str(error)) from error

    def _send(self, packet: bytes) -> None:
        try:
            self._socket.send(packet)
        except BlockingIOError:
            pass  # as if the network had lost it: the next attempt sends it again
        except OSError as error:
            raise self._unreachable(error) from error

    def _next_id(self) -> int:
        return next(self._counter) % 0xFFFF + 1

    def _unreachable(self, error: OSError) -> DeviceUnreachable:
        return self.endpoint.error(
            DeviceUnreachable,
            "a GigE Vision camera",
            str(error),
            "check power, cable and camera.device in the rig file; for a mock rig, start the mocks",
        )

    def _protocol_error(self, expected: str, got: str) -> DeviceProtocolError:
        return self.endpoint.error(
            DeviceProtocolError, expected, got, "is this a GigE Vision camera?"
        )


def text_of(data: bytes) -> str:
    """The text in a string register."""
    return data.split(b"\0", 1)[0].decode("utf-8", "replace").strip()


def _check_address(address: str, endpoint: Endpoint) -> None:
    try:
        ipaddress.IPv4Address(address)
    except ValueError as error:
        raise endpoint.error(
            DeviceUnreachable,
            "an IPv4 address such as 192.168.1.10",
            repr(address),
            "correct camera.device.address in the rig file",
        ) from error


def _is_of_other_memory(answer: protocol.AnswerPacket, command: Command, payload: bytes) -> bool:
    """Whether this is the answer to an earlier READMEM, whose id has come round again."""
    return (
        command == Command.READMEM
        and answer.command == Command.READMEM + 1
        and not protocol.is_error(answer.status)
        and len(answer.payload) >= 4
        and answer.payload[:4] != payload[:4]
    )
