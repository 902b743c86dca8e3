"""Telemetry in the making: what the loop leaves for consoles, and what the service adds."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

import msgspec

from fitctl.config import Rig
from fitctl.logging.records import (
    CommandRecord,
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    Losses,
    MetrologyTick,
    ModeChange,
    Overlap,
    PiezoReading,
    Record,
    RecorderStatus,
    Tick,
)
from fitctl.messages.telemetry import FringeOptics, Telemetry
from fitctl.supervisor.supervisor import Supervisor

_BUFFERED_TICKS = 2000
_BUFFERED_EVENTS = 500
_REMEMBERED_EVENTS = 300
_REMEMBERED_BYTES = 64 * 1024  # of what one answer may take of the service's time

T = TypeVar("T")


class CountingBuffer(Generic[T]):
    """What waits for one thread and comes from another; what there is no room for is counted in `lost`.

    The oldest goes. Only the thread that fills it counts.
    """

    def __init__(self, size: int) -> None:
        self.lost = 0
        self._size = size
        self._waiting: deque[T] = deque()

    def put(self, item: T) -> None:
        """Add one; never blocks."""
        self._waiting.append(item)
        if len(self._waiting) > self._size:
            with suppress(IndexError):  # drained at this very moment: nothing is lost
                self._waiting.popleft()
                self.lost += 1

    def drain(self) -> list[T]:
        """Take all of them, oldest first."""
        drained: list[T] = []
        with suppress(IndexError):
            while True:
                drained.append(self._waiting.popleft())
        return drained


class TelemetryBuffer:
    """Records on their way to the consoles; filled by the loop, emptied by the service."""

    def __init__(self) -> None:
        self.frame: FrameRecord | None = None
        self.recorder: RecorderStatus | None = None
        self.stopped_by = ""
        self._ticks = CountingBuffer[Tick](_BUFFERED_TICKS)
        self._metrology_ticks = CountingBuffer[MetrologyTick](_BUFFERED_TICKS)
        self._overlaps = CountingBuffer[Overlap](_BUFFERED_TICKS)
        self._events = CountingBuffer[Event](_BUFFERED_EVENTS)
        self._changes = CountingBuffer[ModeChange](_BUFFERED_EVENTS)
        self._published = deque[Event](maxlen=_REMEMBERED_EVENTS)  # the service's thread alone
        self._devices: dict[str, DeviceHealth] = {}
        self._piezo: dict[str, PiezoReading] = {}
        self._timing: dict[str, LoopTiming] = {}

    def add(self, record: Record) -> None:
        """Take one record; never blocks."""
        match record:
            case Tick():
                self._ticks.put(record)
            case MetrologyTick():
                self._metrology_ticks.put(record)
            case Overlap():
                self._overlaps.put(record)
            case FrameRecord():
                self.frame = record
            case Event():
                self._events.put(record)
            case ModeChange():
                self._changes.put(record)
            case DeviceHealth():
                self._devices[record.device] = record
            case PiezoReading():
                self._piezo[record.loop] = record
            case LoopTiming():
                self._timing[record.loop] = record
            case CommandRecord() if record.command == "Stop" and record.accepted:
                self.stopped_by = record.sender

    def telemetry(self, supervisor: Supervisor, state: ServiceState, now_s: float) -> Telemetry:
        """Everything since the last call."""
        events = self._events.drain()
        self._published.extend(events)
        return Telemetry(
            sequence=state.sequence,
            time_s=now_s,
            wall_minus_monotonic_s=state.wall_minus_monotonic_s,
            rig_name=supervisor.rig.name,
            pid=state.pid,
            loops=[
                supervisor.outcomes.add_to(loop.state(now_s)) for loop in supervisor.loops.values()
            ],
            ticks=self._ticks.drain(),
            events=events,
            mode_changes=self._changes.drain(),
            frame=self.frame,
            devices=list(self._devices.values()),
            piezo=list(self._piezo.values()),
            timing=list(self._timing.values()),
            recorder=self.recorder,
            losses=self.losses(state, now_s),
            scheduling=state.scheduling,
            running_sequence=supervisor.sequences.status(),
            commander=state.commander,
            metrology_ticks=self._metrology_ticks.drain(),
            overlaps=self._overlaps.drain(),
            collector=None if supervisor.collector is None else supervisor.collector.state,
            stopped_by=self.stopped_by,
            fringes=_fringe_optics(supervisor.rig),
            recorder_started_s=state.recorder_started_s(),
            shutting_down=supervisor.shutdown_wanted,
        )

    def recent_events(self) -> list[Event]:
        """The newest that were published, oldest first, as many as one answer may hold."""
        newest: deque[Event] = deque()
        room_bytes = _REMEMBERED_BYTES
        for event in reversed(self._published):
            room_bytes -= len(msgspec.msgpack.encode(event))
            if room_bytes < 0:
                break
            newest.appendleft(event)
        return list(newest)

    def losses(self, state: ServiceState, now_s: float) -> Losses:
        """The messages that each queue has dropped so far."""
        return Losses(
            time_s=now_s,
            records_offered=state.records_offered(),
            records_lost=state.records_lost(),
            ticks_unsent=self._ticks.lost + self._metrology_ticks.lost,
            events_unsent=self._events.lost,
            mode_changes_unsent=self._changes.lost,
            replies_unsent=state.replies_unsent,
        )


def _fringe_optics(rig: Rig) -> FringeOptics | None:
    if rig.fringes is None:
        return None
    one, other = rig.fringes.loops
    return FringeOptics(
        loops=(one, other),
        aperture_m=rig.fringes.aperture_m,
        wavelength_m=rig.fringes.wavelength_m,
    )


class ServiceState(msgspec.Struct):
    """What telemetry carries besides records."""

    pid: int
    wall_minus_monotonic_s: float
    scheduling: str
    records_lost: Callable[[], int]
    records_offered: Callable[[], int]
    sequence: int = 0
    commander: str = ""
    replies_unsent: int = 0
    recorder_started_s: Callable[[], float | None] = lambda: None
