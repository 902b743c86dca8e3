"""Telemetry in the making: what the loop leaves for consoles, and what the service adds."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import TypeVar

import msgspec

from fitctl.logging.records import (
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    ModeChange,
    PiezoReading,
    Record,
    RecorderStatus,
    Tick,
)
from fitctl.model.optics import scales
from fitctl.supervisor.messages import LoopState, Telemetry
from fitctl.supervisor.modes import usable_commands
from fitctl.supervisor.supervisor import Supervisor

_BUFFERED_TICKS = 2000
_BUFFERED_EVENTS = 500

T = TypeVar("T")


class TelemetryBuffer:
    """Records on their way to the consoles; filled by the loop, emptied by the service."""

    def __init__(self) -> None:
        self.frame: FrameRecord | None = None
        self.recorder: RecorderStatus | None = None
        self._ticks: deque[Tick] = deque(maxlen=_BUFFERED_TICKS)
        self._events: deque[Event] = deque(maxlen=_BUFFERED_EVENTS)
        self._changes: deque[ModeChange] = deque(maxlen=_BUFFERED_EVENTS)
        self._devices: dict[str, DeviceHealth] = {}
        self._piezo: dict[str, PiezoReading] = {}
        self._timing: dict[str, LoopTiming] = {}

    def add(self, record: Record) -> None:
        """Take one record; never blocks."""
        match record:
            case Tick():
                self._ticks.append(record)
            case FrameRecord():
                self.frame = record
            case Event():
                self._events.append(record)
            case ModeChange():
                self._changes.append(record)
            case DeviceHealth():
                self._devices[record.device] = record
            case PiezoReading():
                self._piezo[record.loop] = record
            case LoopTiming():
                self._timing[record.loop] = record
            case RecorderStatus():
                self.recorder = record

    def telemetry(self, supervisor: Supervisor, state: ServiceState, now_s: float) -> Telemetry:
        """Everything since the last call."""
        return Telemetry(
            sequence=state.sequence,
            time_s=now_s,
            wall_minus_monotonic_s=state.wall_minus_monotonic_s,
            rig_name=supervisor.rig.name,
            pid=state.pid,
            loops=[
                LoopState(
                    name=name,
                    mode=loop.mode.name,
                    since_s=loop.mode_since_s,
                    requirement_px=loop.settings.requirement_px,
                    sky_arcsec_per_px=scales(supervisor.rig, loop.settings).sky_arcsec_per_px,
                    usable_commands=[t.name.capitalize() for t in usable_commands(loop.mode)],
                    controller=loop.controller,
                    last_change=loop.last_change,
                    interlocks=list(loop.interlocks.tripped),
                )
                for name, loop in supervisor.loops.items()
            ],
            ticks=_drain(self._ticks),
            events=_drain(self._events),
            mode_changes=_drain(self._changes),
            frame=self.frame,
            devices=list(self._devices.values()),
            piezo=list(self._piezo.values()),
            timing=list(self._timing.values()),
            recorder=self.recorder,
            records_lost=state.records_lost(),
            scheduling=state.scheduling,
            running_sequence=supervisor.sequences.status(),
            commander=state.commander,
        )


def _drain(buffer: deque[T]) -> list[T]:
    return [buffer.popleft() for _ in range(len(buffer))]


class ServiceState(msgspec.Struct):
    """What telemetry carries besides records."""

    pid: int
    wall_minus_monotonic_s: float
    scheduling: str
    records_lost: Callable[[], int]
    sequence: int = 0
    commander: str = ""
