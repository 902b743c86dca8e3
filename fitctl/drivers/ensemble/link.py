"""The line to an Ensemble: one command, one answer, each within the time limit."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from typing import TypeVar

from fitctl.config import EnsembleDevice
from fitctl.drivers.amplifiers import DEVICE
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.ensemble.protocol import COMMAND_BYTES_MAX, EOS, PROBE, Reply
from fitctl.drivers.interface import (
    DeviceIdentity,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

T = TypeVar("T")
_REPLIES = {reply.value: reply for reply in Reply}
_BLANKS = b"\r\n "
_POLL_S = 0.02  # how long one read waits; the time limit is counted above it
_LAST_ANSWERS_S = 0.1  # that they are read, after the last words


class EnsembleLink:
    """A serial port or TCP connection; after anything but an answer it is closed, being out of step.

    Before that `last_words` are sent, whose answers nobody waits for: an axis in free run goes on by itself,
    and a controller that cannot be understood may still hear.

    Through ``socket://``, pyserial itself allows 5 s to connect and takes 0.3 s to close.

    Parameters
    ----------
    device : EnsembleDevice

    Raises
    ------
    DeviceUnreachable
        If there is no such port, or nobody listens there.
    """

    def __init__(self, device: EnsembleDevice) -> None:
        self._device = device
        self._endpoint = Endpoint(DEVICE, device.port)
        self.last_words: tuple[str, ...] = ()
        self._port = self._endpoint.open_serial(
            "an Ensemble controller",
            "check its power and cable, its Ethernet socket's set-up, and siderostat.device.port",
            baud_rate=device.baud_rate,
            poll_s=_POLL_S,
            write_timeout_s=device.response_timeout_s,
        )

    def probe(self) -> DeviceIdentity:
        """See that a controller answers, whatever it was saying before.

        Raises
        ------
        DeviceTimeout, DeviceUnreachable
        """
        deadline_s = self._send(PROBE)
        while self._byte(PROBE, deadline_s) != Reply.NOT_UNDERSTOOD.value:
            pass
        axes = " and ".join(f"@{number}" for number in self._device.axes)
        return DeviceIdentity("Aerotech", f"Ensemble, axes {axes}", "", "")

    def command(self, text: str) -> Reply:
        """Have a command done; returns what became of it.

        Raises
        ------
        DeviceTimeout, DeviceUnreachable, DeviceProtocolError
        """
        return self._reply(text, self._send(text))

    def query(self, text: str) -> str | Reply:
        """Ask for a value; where there is none, returns why.

        A bare acknowledgement before the value is passed over: some firmware sends one.

        Raises
        ------
        DeviceTimeout, DeviceUnreachable, DeviceProtocolError
        """
        deadline_s = self._send(text)
        while True:
            reply = self._reply(text, deadline_s)
            if reply is not Reply.DONE:
                return reply
            value = self._line(text, deadline_s)
            if value:
                return value

    def value(self, text: str, parse: Callable[[str], T]) -> T:
        """Ask for a value and insist on one; `parse` raises ValueError where it is none.

        Raises
        ------
        DeviceTimeout, DeviceUnreachable, DeviceRefused, DeviceProtocolError
        """
        answer = self.query(text)
        if isinstance(answer, Reply):
            raise self.refused(text, answer)
        try:
            return parse(answer)
        except ValueError:
            raise self.nonsense(f"a number in answer to {text}", repr(answer)) from None

    def close(self) -> None:
        """Let go of the port; safe to call twice."""
        self._port.close()

    def refused(self, text: str, reply: Reply) -> DeviceRefused:
        """The error for a command that the controller has not done."""
        got = reply.name.lower().replace("_", " ")
        hint = "check siderostat.device.axes, and the controller's firmware"
        return self._endpoint.error(DeviceRefused, f"{text} to be done", got, hint)

    def nonsense(self, expected: str, got: str) -> DeviceProtocolError:
        """The error for an answer that cannot be; the link is closed."""
        self._give_up()
        hint = "check that no other program uses this port of the controller, then recover"
        return self._endpoint.error(DeviceProtocolError, expected, got, hint)

    def _send(self, text: str) -> float:
        """Send a command; returns the time by which its answer must be here."""
        try:
            unasked = b""
            while self._port.is_open and self._port.in_waiting:
                unasked += self._port.read(1)
                if unasked.strip(_BLANKS):
                    raise self.nonsense(f"nothing before {text}", repr(unasked))
            self._port.write(text.encode("ascii") + EOS)
        except OSError as error:
            raise self._broken(text, error) from error
        return time.monotonic() + self._device.response_timeout_s

    def _reply(self, text: str, deadline_s: float) -> Reply:
        first = self._byte(text, deadline_s)
        while first in _BLANKS:
            first = self._byte(text, deadline_s)
        if first not in _REPLIES:
            raise self.nonsense(f"one of {b''.join(_REPLIES).decode()} to {text}", repr(first))
        return _REPLIES[first]

    def _line(self, text: str, deadline_s: float) -> str:
        line = b""
        while (byte := self._byte(text, deadline_s)) != EOS:
            line += byte
            if len(line) > COMMAND_BYTES_MAX:
                raise self.nonsense(f"an answer to {text}", f"{len(line)} bytes without an end")
        return line.decode("ascii", "replace").strip()

    def _byte(self, text: str, deadline_s: float) -> bytes:
        while time.monotonic() <= deadline_s:
            try:
                byte: bytes = self._port.read(1)
            except OSError as error:
                raise self._broken(text, error) from error
            if byte:
                return byte
        self._give_up()
        raise self._endpoint.error(
            DeviceTimeout,
            f"an answer to {text} within {self._device.response_timeout_s:g} s",
            "none",
            "check the controller's power and its ASCII command set-up, then recover",
        )

    def _give_up(self) -> None:
        if self.last_words:
            with contextlib.suppress(OSError):
                self._port.write(b"".join(text.encode("ascii") + EOS for text in self.last_words))
                # A connection closed with answers unread is reset, and what was not yet heard is lost.
                self._port.timeout = _LAST_ANSWERS_S
                self._port.read(COMMAND_BYTES_MAX)
        self.close()

    def _broken(self, text: str, error: OSError) -> DeviceUnreachable:
        self.close()
        return self._endpoint.error(
            DeviceUnreachable,
            f"to send {text}",
            f"a broken connection ({error})",
            "check power and cable, and the timeout of the controller's socket; then recover",
        )
