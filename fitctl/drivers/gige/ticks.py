"""The camera's clock against the host's."""

from __future__ import annotations

import time
from collections import deque
from typing import NamedTuple

from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.gvcp import ControlChannel
from fitctl.drivers.gige.protocol import Register

DRIFT = 50e-6  # how much a camera's crystal may be off
_LATCHES_KEPT = 8
_FIRST_LATCHES = 5
_FIRST_PAUSE_S = 0.002  # long enough for the slowest clock to tick


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
    channel : ControlChannel
        With control of the camera.

    Attributes
    ----------
    runs : bool
        Whether the camera has a clock that can be read; :meth:`host_s` means nothing otherwise.
    """

    def __init__(self, channel: ControlChannel) -> None:
        self._channel = channel
        high = channel.read_register(Register.TICK_FREQUENCY_HIGH)
        self._ticks_per_s = high << 32 | channel.read_register(Register.TICK_FREQUENCY_LOW)
        self._latches: deque[Latch] = deque(maxlen=_LATCHES_KEPT)
        self._best = Latch(0, 0.0, 0.0)
        self.runs = self._ticks_per_s > 0
        if self.runs:
            for _ in range(_FIRST_LATCHES):
                self.latch()
                time.sleep(_FIRST_PAUSE_S)
            self.runs = self._latches[-1].ticks > self._latches[0].ticks

    def latch(self) -> None:
        """Read the camera's clock once, and keep the best of the last few readings."""
        before_s = time.monotonic()
        self._channel.write_register(Register.TIMESTAMP_CONTROL, protocol.TIMESTAMP_LATCH)
        after_s = time.monotonic()
        high = self._channel.read_register(Register.TIMESTAMP_HIGH)
        ticks = high << 32 | self._channel.read_register(Register.TIMESTAMP_LOW)
        self._latches.append(Latch(ticks, before_s, after_s))
        self._best = min(self._latches, key=lambda latch: latch.error_bound_s(after_s))

    def host_s(self, ticks: int) -> float:
        """The host's monotonic time of a camera timestamp; may be called from any thread."""
        best = self._best
        return best.host_s + (ticks - best.ticks) / self._ticks_per_s
