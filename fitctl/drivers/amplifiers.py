"""What the siderostat's amplifiers have in common, whatever they are connected by."""

from __future__ import annotations

import contextlib
import math
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Generic, Protocol, TypeVar

from fitctl.config import Siderostat
from fitctl.config.base import Settings
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import AzEl, DeviceError, DeviceFault
from fitctl.drivers.plausibility import MotionCheck

DEVICE = "siderostat amplifiers"
"""What errors call the device."""
AXES = ("azimuth", "elevation")


class _Closable(Protocol):
    def close(self) -> None: ...


_Link = TypeVar("_Link", bound=_Closable)
_Settings = TypeVar("_Settings", bound=Settings)


class LinkedAmplifiers(ABC, Generic[_Link, _Settings]):
    """Both axes' amplifiers on one link, which is None while they are closed.

    Parameters
    ----------
    siderostat : Siderostat
        Limits and device settings of the rig.
    endpoint : str
        Their address in errors.
    """

    def __init__(self, siderostat: Siderostat[_Settings], endpoint: str) -> None:
        self._device = siderostat.device
        self._endpoint = Endpoint(DEVICE, endpoint)
        self._velocity_limit_rad_s = siderostat.velocity_limit_rad_s
        self._link: _Link | None = None

    @abstractmethod
    def disable(self) -> None:
        """Take power from both axes."""

    def close(self) -> None:
        """Disable if possible and disconnect; safe to call twice and after a failure."""
        if self._link is None:
            return
        try:
            with contextlib.suppress(DeviceError):
                self._shut_down()
        finally:
            self._drop()

    def _shut_down(self) -> None:
        self.disable()

    def _drop(self) -> None:
        link, self._link = self._link, None
        if link is not None:
            link.close()

    @contextlib.contextmanager
    def _connected(self, link: _Link) -> Iterator[_Link]:
        """Set a new link up inside; after a failure it is closed."""
        self._link = link
        try:
            yield link
        except BaseException:
            self._drop()
            raise

    @contextlib.contextmanager
    def _disabled_on_failure(self) -> Iterator[None]:
        """Power the axes inside; after a failure neither has power."""
        try:
            yield
        except DeviceError:
            with contextlib.suppress(DeviceError):
                self.disable()
            raise

    def _opened(self) -> _Link:
        if self._link is None:
            raise self._endpoint.not_open()
        return self._link

    def _limited(self, velocity_rad_s: AzEl) -> AzEl:
        """Both velocities within the motors' limit. Raises ValueError if one is not finite."""
        az_rad_s, el_rad_s = velocity_rad_s
        if not (math.isfinite(az_rad_s) and math.isfinite(el_rad_s)):
            msg = f"velocities must be finite numbers of rad/s, not {velocity_rad_s}"
            raise ValueError(msg)
        limit_rad_s = self._velocity_limit_rad_s
        return (
            max(-limit_rad_s, min(limit_rad_s, az_rad_s)),
            max(-limit_rad_s, min(limit_rad_s, el_rad_s)),
        )

    def _check_jumped(self, motion: MotionCheck, rad_per_unit: float) -> None:
        """Raise DeviceFault if an encoder made a jump that no motor could."""
        if motion.jumped is not None:
            steps = zip(AXES, motion.jumped, strict=True)
            raise self._endpoint.error(
                DeviceFault,
                "encoders that move as their motors can",
                ", ".join(f"{axis} moved by {step * rad_per_unit:.3f} rad" for axis, step in steps),
                "look at the encoder, its cable and its counter, recover, and acquire again",
            )
