"""A device and its address, named once for all its errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

from fitctl.drivers.interface import DeviceError

_Error = TypeVar("_Error", bound=DeviceError)


@dataclass(frozen=True, slots=True)
class Endpoint:
    """What errors call a device and the place where it is addressed."""

    device: str
    address: str

    def error(self, kind: type[_Error], expected: str, got: str, hint: str = "") -> _Error:
        """An error of this device; fields as in :class:`~fitctl.drivers.interface.DeviceError`."""
        return kind(self.device, self.address, expected, got, hint)
