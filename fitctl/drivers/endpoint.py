"""A device and its address, named once for all its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import serial

from fitctl.drivers.interface import DeviceError, DeviceUnreachable

_NOTHING_LISTENS = "nothing listens there: start what serves it (mocks: fitctl mocks), or"
_Error = TypeVar("_Error", bound=DeviceError)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """What errors call a device and the place where it is addressed."""

    device: str
    address: str

    def error(self, kind: type[_Error], expected: str, got: str, hint: str = "") -> _Error:
        """An error of this device; fields as in :class:`~fitctl.drivers.interface.DeviceError`."""
        return kind(self.device, self.address, expected, got, hint)

    def not_open(self) -> DeviceUnreachable:
        """The error of a driver that is used before it is opened, or after it was closed."""
        return self.error(DeviceUnreachable, "an open connection", "none", "open it again")

    def open_serial(
        self, expected: str, hint: str, *, baud_rate: int, poll_s: float, write_timeout_s: float
    ) -> serial.Serial:
        """Open the serial port or ``socket://`` at the address, which nobody else can then open.

        Parameters
        ----------
        expected, hint : str
            For the error.
        baud_rate : int
        poll_s : float
            How long one read waits.
        write_timeout_s : float

        Raises
        ------
        DeviceUnreachable
            If there is no such port, or nobody listens there.
        """
        try:
            return serial.serial_for_url(
                self.address,
                baudrate=baud_rate,
                timeout=poll_s,
                write_timeout=write_timeout_s,
                exclusive=True,
            )
        except (OSError, ValueError) as error:
            got = str(error)
            if isinstance(error.__context__, ConnectionRefusedError):
                got, hint = "connection refused", f"{_NOTHING_LISTENS} {hint}"
            raise self.error(DeviceUnreachable, expected, got, hint) from error
