"""The line to a C-887: one question, one answer, each within the time limit; a stop at any time."""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable, Iterator
from typing import NoReturn, TypeVar

from fitctl.config import C887Device
from fitctl.drivers.c887 import protocol
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)

T = TypeVar("T")
DEVICE = "hexapod"
_POLL_S = 0.02  # how long one read waits; the time limit is counted above it
_HINTS: dict[int, str] = {
    protocol.GcsError.NOT_REFERENCED_OR_SERVO_OFF: "reference the hexapod, which switches servos on too",
    protocol.GcsError.POSITION_OUT_OF_LIMITS: "choose a pose nearer to zero: what an axis reaches depends on"
    " the others, and VMO? reports whether a pose can be reached",
    protocol.GcsError.VELOCITY_OUT_OF_LIMITS: "lower collector.hexapod.velocity_limit_mm_s",
    protocol.GcsError.STOPPED: "start the motion again when it is safe",
    protocol.GcsError.REFERENCING_FAILED: "clear the way of the platform, then reference it again",
    protocol.GcsError.NOT_WHILE_MOVING: "wait until the platform stands still, or stop it",
    protocol.GcsError.EMERGENCY_STOP: "release the emergency stop when it is safe, then reference the hexapod",
    protocol.GcsError.EMERGENCY_STOP_BEFORE: "reference the hexapod when it is safe",
    protocol.GcsError.MOTION_ERROR: "find what blocks the platform, then reference the hexapod",
}
_FAULTS = {
    protocol.GcsError.EMERGENCY_STOP,
    protocol.GcsError.EMERGENCY_STOP_BEFORE,
    protocol.GcsError.MOTION_ERROR,
}


class C887Link:
    """A serial port or TCP connection; closed after anything but an answer, being out of step.

    Questions take turns; :meth:`interrupt` waits for none. Through ``socket://``, pyserial itself allows 5 s
    to connect and takes 0.3 s to close.

    Parameters
    ----------
    device : C887Device

    Raises
    ------
    DeviceUnreachable
        If there is no such port, or nobody listens there.
    """

    def __init__(self, device: C887Device) -> None:
        self._limit_s = device.response_timeout_s
        self.endpoint = Endpoint(DEVICE, device.port)
        self._turn = threading.RLock()
        self._writing = threading.Lock()
        self._port = self.endpoint.open_serial(
            "a C-887 controller",
            "check its power and cable, and collector.hexapod.port",
            baud_rate=device.baud_rate,
            poll_s=_POLL_S,
            write_timeout_s=device.response_timeout_s,
        )

    def resynchronise(self) -> None:
        """End a line that an earlier client may have left half typed, and forget its error."""
        with self.turn("ERR?"):
            self._write("LF", protocol.LF)
            with contextlib.suppress(OSError):
                self._port.reset_input_buffer()
            self.ask("ERR?", protocol.parse_error)

    def ask(self, question: str | bytes, parse: Callable[[bytes], T]) -> T:
        """Ask, and read the answer with `parse`, which raises ValueError where it is none.

        Raises
        ------
        DeviceRefused
            The controller does not answer this question, and its error number says why.
        DeviceTimeout, DeviceUnreachable, DeviceProtocolError
        """
        name, data = _named(question)
        with self.turn(name):
            try:
                answer = self._exchange(name, data)
            except DeviceTimeout:
                if name != "ERR?":
                    self._raise_why_unanswered(name)
                self.close()
                raise
            try:
                return parse(answer)
            except ValueError as error:
                self._nonsense(f"an answer to {name}", f"{answer[:80]!r} ({error})")

    def command(self, data: bytes) -> None:
        """Have something done that has no answer of its own.

        Raises
        ------
        DeviceRefused, DeviceFault
            The controller reports an error; it has done nothing.
        DeviceTimeout, DeviceUnreachable, DeviceProtocolError
        """
        name = data.decode("ascii").strip()
        with self.turn(name):
            try:
                answer = self._exchange(name, data + protocol.line("ERR?"))
            except DeviceTimeout:
                self.close()
                raise
            try:
                number = protocol.parse_error(answer)
            except ValueError as error:
                self._nonsense(f"an error number after {name}", f"{answer[:80]!r} ({error})")
            if number:
                raise self.refused(name, number)

    def interrupt(self, data: bytes) -> None:
        """Send a control character now, whoever has the turn.

        Raises
        ------
        DeviceUnreachable
        """
        self._write(f"#{data[0]}", data)

    @contextlib.contextmanager
    def turn(self, name: str) -> Iterator[None]:
        """Keep other threads' questions out for a while.

        Raises
        ------
        DeviceTimeout
            If another thread has had the turn for twice the time limit.
        """
        if not self._turn.acquire(timeout=2 * self._limit_s):
            raise self._silent(f"its turn to send {name}", "another question still open")
        try:
            yield
        finally:
            self._turn.release()

    def close(self) -> None:
        """Close the port, after the answer to another thread's question; safe to call twice."""
        has_turn = self._turn.acquire(timeout=self._limit_s)
        try:
            with self._writing:
                self._port.close()
        finally:
            if has_turn:
                self._turn.release()

    def refused(self, name: str, number: int) -> DeviceError:
        """The error for a command that the controller has not done."""
        hint = _HINTS.get(number, "see the maker's manual for this number")
        kind = DeviceFault if number in _FAULTS else DeviceRefused
        return self.endpoint.error(kind, f"{name} to be done", protocol.error_text(number), hint)

    def _exchange(self, name: str, data: bytes) -> bytes:
        """Send, and read up to the end of one answer."""
        try:
            unasked = self._port.read(self._port.in_waiting) if self._port.is_open else b""
        except OSError as error:
            raise self._broken(name, error) from error
        if unasked:
            self._nonsense(f"nothing before {name}", repr(unasked[:80]))
        self._write(name, data)
        deadline_s = time.monotonic() + self._limit_s
        answer = b""
        while not protocol.is_complete(answer):
            # What came while this computer stood still is in time.
            if time.monotonic() > deadline_s and not self._waiting(name):
                raise self._silent(f"an answer to {name}", repr(answer[:80]) if answer else "none")
            if len(answer) > protocol.ANSWER_BYTES_MAX:
                self._nonsense(f"an answer to {name}", f"{len(answer)} bytes without an end")
            try:
                answer += self._port.read(max(1, self._port.in_waiting))
            except OSError as error:
                raise self._broken(name, error) from error
        return answer

    def _waiting(self, name: str) -> int:
        try:
            return int(self._port.in_waiting)
        except OSError as error:
            raise self._broken(name, error) from error

    def _raise_why_unanswered(self, name: str) -> None:
        """A question that the controller cannot answer leaves an error number instead."""
        try:
            number = protocol.parse_error(self._exchange("ERR?", protocol.line("ERR?")))
        except (DeviceError, ValueError):
            return
        if number:
            raise self.refused(name, number) from None

    def _write(self, name: str, data: bytes) -> None:
        try:
            with self._writing:
                self._port.write(data)
        except OSError as error:
            raise self._broken(name, error) from error

    def _nonsense(self, expected: str, got: str) -> NoReturn:
        self.close()
        hint = (
            "check collector.hexapod.baud_rate, and that no other program uses this port; then start the "
            "collector"
        )
        raise self.endpoint.error(DeviceProtocolError, expected, got, hint)

    def _silent(self, expected: str, got: str) -> DeviceTimeout:
        hint = "check the controller's power and cable, and collector.hexapod.port; then start the collector"
        return self.endpoint.error(
            DeviceTimeout, f"{expected} within {self._limit_s:g} s", got, hint
        )

    def _broken(self, name: str, error: OSError) -> DeviceUnreachable:
        self.close()
        hint = "check its power and cable, then start the collector; after a loss of power, reference it"
        return self.endpoint.error(
            DeviceUnreachable, f"to send {name}", f"a broken connection ({error})", hint
        )


def _named(question: str | bytes) -> tuple[str, bytes]:
    """How errors call a question, and its bytes: control characters come as bytes."""
    if isinstance(question, str):
        return question, protocol.line(question)
    return f"#{question[0]}", question
