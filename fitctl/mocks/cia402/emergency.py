"""The mock drive's emergencies (CiA 301): error register, error history, EMCY messages.

Known limitations: no inhibit time; the history holds what was sent since power-up and is not kept.
Invented constant: the axis number in the EMCY's first manufacturer byte (0: whole drive).
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import AbortCode
from fitctl.mocks.cia402.axis import Axis
from fitctl.mocks.cia402.dictionary import Dictionary, Entry, SdoAbortError

HISTORY_ENTRIES = 8
_COMMUNICATION_CODES = 0x81


class Emergencies:
    """Errors, each reported once when it begins, and once more when all are over.

    Parameters
    ----------
    axes : sequence of Axis
    send : callable
        Takes an EMCY's data.
    """

    def __init__(self, axes: Sequence[Axis], send: Callable[[bytes], None]) -> None:
        self._axes = axes
        self._send = send
        self._history: deque[int] = deque(maxlen=HISTORY_ENTRIES)
        self._in_error = False

    def objects(self) -> Dictionary:
        """Error register and error history."""
        history = protocol.ERROR_HISTORY
        return {
            (protocol.ERROR_REGISTER, 0): Entry("B", self._register, mappable=True),
            (history, 0): Entry("B", lambda: len(self._history), self._clear_history),
        } | {
            (history, number + 1): Entry("I", partial(self._nth_newest, number))
            for number in range(HISTORY_ENTRIES)
        }

    def report(self, code: int, axis_number: int) -> None:
        """Report an error; `axis_number` is 1 or 2, or 0 for the whole drive."""
        self._history.appendleft(axis_number << 16 | code)
        self._send(protocol.encode_emcy(code, self._register(), bytes([axis_number])))

    def update(self) -> None:
        """Report that all is well again, if it is so since just now."""
        in_error = any(axis.error_code for axis in self._axes)
        if self._in_error and not in_error:
            self._send(protocol.encode_emcy(protocol.EMCY_NO_ERROR, self._register()))
        self._in_error = in_error

    def power_off(self) -> None:
        """Forget."""
        self._history.clear()
        self._in_error = False

    def _register(self) -> int:
        codes = [axis.error_code for axis in self._axes]
        register = protocol.ERROR_REGISTER_GENERIC if any(codes) else 0
        if any(code >> 8 == _COMMUNICATION_CODES for code in codes):
            register |= protocol.ERROR_REGISTER_COMMUNICATION
        return register

    def _nth_newest(self, number: int) -> int:
        if number >= len(self._history):
            raise SdoAbortError(AbortCode.NO_DATA)
        return self._history[number]

    def _clear_history(self, value: int) -> None:
        if value:
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        self._history.clear()
