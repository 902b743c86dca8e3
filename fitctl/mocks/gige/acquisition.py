"""Exposures, on an absolute schedule or by trigger, and their way through the frame grabber."""

from __future__ import annotations

import asyncio
import math
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.drivers.gige import protocol
from fitctl.mocks.gige.picture import pixels
from fitctl.mocks.gige.stream import Stream, StreamSettings, frame_packets

LATE_S = 0.002


@dataclass(frozen=True, slots=True)
class AcquisitionSettings:
    """The registers at the start of the acquisition."""

    exposure_s: float
    frame_rate_hz: float
    gain_db: float
    single_frame: bool
    triggered: bool


class _InFlight(NamedTuple):
    due_s: float
    block_id: int
    packets: list[bytes]


class Acquisition:
    """Exposes, holds each frame for the frame grabber's delay, and gives it to the stream.

    Exposure k starts at t0 + k / rate, or, with the trigger on, when triggered. The image is asked
    for the middle of the exposure once that, or the whole exposure, has passed; the frame leaves
    `frame_delay_s` after the middle. A process that was held up sends all that is due when it wakes:
    frames come late, and none is left out.

    Parameters
    ----------
    render : callable
        The uint16 image of a host monotonic time.
    ticks : callable
        The camera's clock at a host monotonic time.
    frame_delay_s : float
        From mid-exposure until the frame leaves.
    stream : Stream
    seen_at : float
        Which part of the exposure must have passed.
    true_rate_hz : float, optional
        Where it runs at another rate than it is set to.

    Attributes
    ----------
    late_frames : int
        How many frames left more than 2 ms after their time.
    worst_late_s : float
        By how much the latest one was late.
    """

    def __init__(
        self,
        render: Callable[[float], NDArray[np.uint16]],
        ticks: Callable[[float], int],
        frame_delay_s: float,
        stream: Stream,
        *,
        seen_at: float = 0.5,
        true_rate_hz: float | None = None,
    ) -> None:
        self._true_rate_hz = true_rate_hz
        self.late_frames = 0
        self.worst_late_s = 0.0
        self._render = render
        self._ticks = ticks
        self._delay_s = frame_delay_s
        self._stream = stream
        self._seen_at = seen_at
        self._running: tuple[AcquisitionSettings, StreamSettings] | None = None
        self._next_start_s = math.inf
        self._busy_until_s = 0.0
        self._start_s = 0.0
        self._exposures = 0
        self._block_id = 0
        self._in_flight: deque[_InFlight] = deque()
        self._timer: asyncio.TimerHandle | None = None

    @property
    def running(self) -> bool:
        """Whether frames are being taken."""
        return self._running is not None

    def start(self, settings: AcquisitionSettings, stream: StreamSettings) -> None:
        """Begin the first exposure now, or at the first trigger; block ids start at 1 again."""
        self.stop()
        self._running = settings, stream
        self._stream.open(stream.destination, stream.packet_gap_s)
        self._start_s = time.monotonic()
        self._exposures = 0
        self._block_id = 0
        self._busy_until_s = 0.0
        self._next_start_s = math.inf if settings.triggered else self._start_s
        self._arm()

    def set_rate(self, frame_rate_hz: float) -> None:
        """Begin exposures at this rate from the next one on, a new period after the last."""
        if self._running is None:
            return
        settings, stream = self._running
        self._running = replace(settings, frame_rate_hz=frame_rate_hz), stream
        if settings.single_frame or settings.triggered or not self._exposures:
            return
        self._start_s += (self._exposures - 1) * self._period_s(settings)
        self._exposures = 1
        self._next_start_s = self._following_start_s(self._running[0])
        self._arm()

    def trigger(self) -> None:
        """Begin an exposure, unless the camera waits for none or is still busy with the last one."""
        if self._running is None or not self._running[0].triggered:
            return
        now_s = time.monotonic()
        if now_s < self._busy_until_s or math.isfinite(self._next_start_s):
            return
        self._busy_until_s = now_s + 1 / self._running[0].frame_rate_hz
        self._next_start_s = now_s
        self._arm()

    def stop(self) -> None:
        """Take no more frames, and drop the frames that were not sent yet."""
        self._running = None
        self._in_flight.clear()
        self._stream.clear()
        self._disarm()

    def _advance(self) -> None:
        if self._running is None:
            return
        settings, stream = self._running
        now_s = time.monotonic()
        while self._next_start_s + self._seen_at * settings.exposure_s <= now_s:
            self._expose(settings, stream)
        while self._in_flight and self._in_flight[0].due_s <= now_s:
            self._emit(self._in_flight.popleft())
        self._stream.advance()
        self._arm()

    def _arm(self) -> None:
        """Wake for whatever comes next."""
        self._disarm()
        if self._running is None:
            return
        seen_s = self._next_start_s + self._seen_at * self._running[0].exposure_s
        due_s = min(seen_s, self._stream.due_s)
        if self._in_flight:
            due_s = min(due_s, self._in_flight[0].due_s)
        if math.isfinite(due_s):
            # The event loop's clock is the monotonic one.
            self._timer = asyncio.get_running_loop().call_at(due_s, self._advance)

    def _disarm(self) -> None:
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None

    def _expose(self, settings: AcquisitionSettings, stream: StreamSettings) -> None:
        start_s = self._next_start_s
        self._exposures += 1
        self._next_start_s = self._following_start_s(settings)
        self._block_id = protocol.next_block(self._block_id)
        middle_s = start_s + 0.5 * settings.exposure_s
        image = self._render(middle_s)[
            stream.offset_y_px : stream.offset_y_px + stream.height_px,
            stream.offset_x_px : stream.offset_x_px + stream.width_px,
        ]
        sent = pixels(image, settings.gain_db, stream.pixel_format)
        packets = frame_packets(self._block_id, self._ticks(start_s), sent, stream)
        self._in_flight.append(_InFlight(middle_s + self._delay_s, self._block_id, packets))

    def _following_start_s(self, settings: AcquisitionSettings) -> float:
        if settings.single_frame or settings.triggered:
            return math.inf
        return self._start_s + self._exposures * self._period_s(settings)

    def _period_s(self, settings: AcquisitionSettings) -> float:
        return 1 / (self._true_rate_hz or settings.frame_rate_hz)

    def _emit(self, frame: _InFlight) -> None:
        late_s = time.monotonic() - frame.due_s
        self.worst_late_s = max(self.worst_late_s, late_s)
        self.late_frames += late_s > LATE_S
        self._stream.send_frame(frame.block_id, frame.packets)
