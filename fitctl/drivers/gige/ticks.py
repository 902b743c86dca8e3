"""The camera's clock against the host's."""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple, Protocol

from fitctl.config import Camera
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.protocol import Register
from fitctl.drivers.interface import DeviceUnreachable

DRIFT = 50e-6  # how much a camera's crystal may be off
_LATCHES_KEPT = 8
_FIRST_LATCHES = 5
_FIRST_PAUSE_S = 0.002  # long enough for the slowest clock to tick


class Registers(Protocol):
    """A camera's registers by address.

    Attributes
    ----------
    endpoint : Endpoint
        What errors call the camera's address.
    answered_s : float
        Host's monotonic time of its last answer.
    """

    endpoint: Endpoint
    answered_s: float

    def read_register(self, address: int) -> int:
        """Read one 32-bit register."""
        ...

    def write_register(self, address: int, value: int) -> None:
        """Write one 32-bit register."""
        ...


class Latch(NamedTuple):
    """One reading of the camera's clock: its ticks, and the host's times around it."""

    ticks: int
    before_s: float
    after_s: float

    @property
    def host_s(self) -> float:
        """The host's time of the reading, at best guess."""
        return 0.5 * (self.before_s + self.after_s)

    def error_bound_s(self, now_s: float) -> float:
        """How wrong this reading may be by now: half its round trip, and the drift since."""
        return 0.5 * (self.after_s - self.before_s) + DRIFT * (now_s - self.host_s)


class CameraTime:
    """Maps the camera's ticks to the host's monotonic time.

    Parameters
    ----------
    channel : Registers
        With control of the camera.

    Attributes
    ----------
    ticks_per_s : int
        The clock's frequency; 0 if it has none.
    runs : bool
        Whether the camera has a clock that can be read; :meth:`host_s` means nothing otherwise.
    """

    def __init__(self, channel: Registers) -> None:
        self._channel = channel
        high = channel.read_register(Register.TICK_FREQUENCY_HIGH)
        self.ticks_per_s = high << 32 | channel.read_register(Register.TICK_FREQUENCY_LOW)
        self._latches: deque[Latch] = deque(maxlen=_LATCHES_KEPT)
        self._best = Latch(0, 0.0, 0.0)
        self.runs = self.ticks_per_s > 0
        if self.runs:
            for _ in range(_FIRST_LATCHES):
                self.latch()
                time.sleep(_FIRST_PAUSE_S)
            self.runs = self._latches[-1].ticks > self._latches[0].ticks

    def latch(self) -> None:
        """Read the camera's clock once, and keep the best of the last few readings.

        Raises
        ------
        DeviceUnreachable
            If the clock went back: the camera has restarted, and would date frames from before it wrongly.
        """
        before_s = time.monotonic()
        self._channel.write_register(Register.TIMESTAMP_CONTROL, protocol.TIMESTAMP_LATCH)
        after_s = time.monotonic()
        high = self._channel.read_register(Register.TIMESTAMP_HIGH)
        ticks = high << 32 | self._channel.read_register(Register.TIMESTAMP_LOW)
        if self._latches and ticks < self._latches[-1].ticks:
            raise self._channel.endpoint.error(
                DeviceUnreachable,
                f"a camera clock of more than {self._latches[-1].ticks} ticks",
                str(ticks),
                "the camera restarted, or another program has reset its clock; open it again",
            )
        self._latches.append(Latch(ticks, before_s, after_s))
        self._best = min(self._latches, key=lambda latch: latch.error_bound_s(after_s))

    def host_s(self, ticks: int) -> float:
        """The host's monotonic time of a camera timestamp; may be called from any thread."""
        best = self._best
        return best.host_s + (ticks - best.ticks) / self.ticks_per_s


def mid_exposure_s(
    camera_time: CameraTime | None, camera: Camera, exposure_s: float, ticks: int, received_s: float
) -> float:
    """Host's monotonic time of the middle of an exposure.

    Parameters
    ----------
    camera_time : CameraTime or None
    camera : Camera
        Of a camera without a clock, frames are as old as the rig file says.
    exposure_s : float
    ticks : int
        The camera's clock at the start of the exposure.
    received_s : float
        Host's monotonic time at which the frame was complete.
    """
    if camera_time is None or not camera_time.runs:
        return received_s - camera.frame_delay_s
    return camera_time.host_s(ticks) + 0.5 * exposure_s
