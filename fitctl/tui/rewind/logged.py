"""A log as a recording: the telemetry that its records would have been, at any time.

Anyone may have written the log, so nothing in it is trusted: a record with a value of another type or a number
out of all bounds is left out.
"""

from __future__ import annotations

import contextlib
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import msgspec

from fitctl.config import is_name
from fitctl.logging.errors import LogError
from fitctl.logging.reading import LogMessage, clock_of
from fitctl.logging.records import (
    CAMERA,
    MOST,
    AnyRecord,
    DeviceHealth,
    Event,
    FrameRecord,
    LoopTiming,
    Losses,
    MetrologyTick,
    ModeChange,
    Overlap,
    PiezoReading,
    RecorderStatus,
    Snapshot,
    Tick,
)
from fitctl.logging.schemas import TOPICS, fields_of
from fitctl.logging.seeking import SeekableLog
from fitctl.messages.telemetry import LoopState, Telemetry, Unlogged
from fitctl.text import UNDECODABLE, plain, plain_message
from fitctl.tui.rewind.moment import Moment, course_from_s, until

LAG_S = 3.0  # the recorder has a record at most so long after its time
SILENT_S = 2.5  # a supervisor that records nothing for longer was not there
FRAME_S = 2.0  # the frame on the screen is at most so old
MOST_EVENTS = 20_000
MOST_LOOPS = 12
MOST_DEVICES = 60
MOST_PIXELS = 4_000_000
MOST_TEXT = 4_000
MOST_STATE_BYTES = 1 << 20
EVENT_BYTES = 4 << 30  # of chunks that have an event, unpacked once when the log is opened
SMALLEST, LARGEST = 1e-6, 1e5  # of a loop's requirement, scale and limits, which panels divide by
SMALLEST_WAVELENGTH_M = 1e-9  # of light; panels divide by it
_OF_LOOP: tuple[type[AnyRecord], ...] = (
    Tick,
    MetrologyTick,
    Overlap,
    ModeChange,
    LoopTiming,
    PiezoReading,
)
_OF_RIG: tuple[type[AnyRecord], ...] = (DeviceHealth, RecorderStatus, Losses, Snapshot)
_NO_LOSSES = Losses(
    time_s=0.0,
    records_offered=0,
    records_lost=0,
    ticks_unsent=0,
    events_unsent=0,
    mode_changes_unsent=0,
    replies_unsent=0,
)
_decode_state = msgspec.msgpack.Decoder(Unlogged).decode
_LEVELS = {1: "info", 2: "info", 3: "warning", 4: "error", 5: "error"}


class LoggedRun:
    """A run's log.

    Parameters
    ----------
    path : Path
    loops_of : callable
        The loops at the start of a run, from its rig as JSON.

    Raises
    ------
    LogError
        If the log cannot be read, or does not say what its times are.
    """

    def __init__(self, path: Path, loops_of: Callable[[str], list[LoopState]]) -> None:
        self._log = SeekableLog(path)
        metadata = self._log.metadata
        self._offset_s = clock_of(path, metadata).wall_minus_monotonic_s
        self._rig_name = plain(metadata.get("rig", {}).get("name", ""))[:40]
        self._scheduling = plain(metadata.get("scheduling", {}).get("policy", ""))[:200]
        self._first_ns, self._last_ns = self._log.span_ns
        loops = loops_of(metadata.get("rig", {}).get("json", ""))[:MOST_LOOPS]
        start_s = self.span_s()[0]
        self._loops = [msgspec.structs.replace(loop, since_s=start_s) for loop in loops]
        self._kinds = _kinds_of(self._log.topics)
        self._events, self._changes = self._read_events()

    def span_s(self) -> tuple[float, float]:
        """Times of the first and the last message."""
        return self._first_ns / 1e9 - self._offset_s, self._last_ns / 1e9 - self._offset_s

    def events(self) -> Sequence[Event]:
        """All events, newest first; of a flood the newest."""
        return self._events

    def at(self, time_s: float) -> Moment:
        """The moment at a time.

        Raises
        ------
        LogError
            If the log cannot be read.
        """
        changes = self._changes_at(time_s)
        loops = [_changed(loop, changes.get(loop.name)) for loop in self._loops]
        from_s = course_from_s(loops, time_s)
        records: dict[type, list[Any]] = defaultdict(list)
        newest_s = -math.inf
        for record in self._records(from_s, time_s, set(self._kinds) - {TOPICS[FrameRecord]}):
            records[type(record)].append(record)
            newest_s = max(newest_s, record.time_s)
        if newest_s == -math.inf:  # before its first record, or of damaged ones
            newest_s = self.span_s()[0]
        snapshots = [(snapshot.time_s, _state_of(snapshot)) for snapshot in records[Snapshot]]
        states = [(then_s, state.loops) for then_s, state in snapshots if state is not None]
        known = self._state_at(snapshots, changes)
        losses = records[Losses] or [_NO_LOSSES]
        devices = {record.device: record for record in records[DeviceHealth]}
        message = Telemetry(
            sequence=1,
            time_s=newest_s,
            wall_minus_monotonic_s=self._offset_s,
            rig_name=self._rig_name,
            pid=0,
            ticks=records[Tick],
            events=[],
            mode_changes=records[ModeChange],
            frame=self._frame_at(time_s),
            devices=list(devices.values())[:MOST_DEVICES],
            piezo=list({record.loop: record for record in records[PiezoReading]}.values()),
            timing=list({record.loop: record for record in records[LoopTiming]}.values()),
            recorder=next(reversed(records[RecorderStatus]), None),
            recorder_started_s=self.span_s()[0],  # one that ran has written this
            losses=losses[-1],
            metrology_ticks=records[MetrologyTick],
            overlaps=records[Overlap],
            **_fields(known) | {"scheduling": known.scheduling or self._scheduling},
        )
        received_s = time_s if time_s - newest_s < SILENT_S else newest_s
        return Moment(message, received_s, until(self._events, time_s), states)

    # ------------------------------------------------------------ what was when

    def _state_at(
        self, snapshots: list[tuple[float, Unlogged | None]], changes: dict[str, ModeChange]
    ) -> Unlogged:
        """The newest snapshot, or the state at the start, each loop in the mode of its newest change."""
        known, known_s = Unlogged(loops=self._loops), -math.inf
        for time_s, state in snapshots:
            if state is not None:
                known, known_s = state, time_s
        since = {name: change for name, change in changes.items() if change.time_s >= known_s}
        return msgspec.structs.replace(
            known, loops=[_changed(loop, since.get(loop.name)) for loop in known.loops]
        )

    def _changes_at(self, time_s: float) -> dict[str, ModeChange]:
        """The change that led each loop into its mode at a time."""
        return {
            change.loop: change
            for change in self._changes
            if change.time_s <= time_s and change.source != change.target
        }

    def _frame_at(self, time_s: float) -> FrameRecord | None:
        frame = None
        for record in self._records(time_s - FRAME_S, time_s, {TOPICS[FrameRecord]}):
            frame = record
        return frame

    def _read_events(self) -> tuple[list[Event], list[ModeChange]]:
        events: list[Event] = []
        changes: list[ModeChange] = []
        topics = {topic for topic, kind in self._kinds.items() if kind in {Event, ModeChange}}
        at_the_earliest_s, last_s = -self._offset_s, self.span_s()[1]
        with contextlib.suppress(LogError):  # it has more than is read
            for record in self._records(at_the_earliest_s, last_s, topics, EVENT_BYTES):
                (events if isinstance(record, Event) else changes).append(record)
                if len(events) + len(changes) > 2 * MOST_EVENTS:
                    del events[:-MOST_EVENTS], changes[:-MOST_EVENTS]
        events.reverse()
        events.sort(key=lambda event: -event.time_s)  # of one time, the last one first
        changes.sort(key=lambda change: change.time_s)
        return events[:MOST_EVENTS], changes

    def _records(
        self, from_s: float, to_s: float, topics: set[str], most_bytes: int | None = None
    ) -> Iterator[Any]:
        """Records of some topics and times, in the order of the file."""
        from_ns, to_ns = (
            round((time_s + self._offset_s) * 1e9) for time_s in (from_s, to_s + LAG_S)
        )
        more = {} if most_bytes is None else {"most_bytes": most_bytes}
        for entry in self._log.messages(max(0, from_ns), to_ns, topics, **more):
            record = self._record_of(entry)
            if record is not None and from_s <= record.time_s <= to_s:
                yield record

    def _record_of(self, entry: LogMessage) -> Any:
        """The record of a message; None of one that cannot be."""
        kind, message = self._kinds[entry.topic], entry.message
        time_s = entry.publish_time_ns / 1e9 - self._offset_s
        if kind is FrameRecord:
            return _frame_of(message, time_s, entry.sequence)
        if kind is Event:
            severity = _LEVELS.get(getattr(message, "level", 0))
            values = {
                "severity": severity,
                "source": getattr(message, "name", ""),
                "time_s": time_s,
            }
            values["message"] = getattr(message, "message", "")
        else:
            values = fields_of(kind, message)
        for name, value in values.items():
            if isinstance(value, str):
                values[name] = plain(value[:MOST_TEXT])
            elif isinstance(value, float | int) and not _is_bounded(value):
                return None
        with contextlib.suppress(msgspec.ValidationError):
            return msgspec.convert(values | {"type": kind.__name__}, kind)
        return None


def _kinds_of(topics: set[str]) -> dict[str, type[AnyRecord]]:
    """The kind of record of each topic of a log that a console shows."""
    known: dict[str, type[AnyRecord]] = {
        TOPICS[kind]: kind for kind in (*_OF_RIG, Event, FrameRecord) if TOPICS[kind] in topics
    }
    for kind in _OF_LOOP:
        head, tail = TOPICS[kind].split("{loop}")
        known |= {t: kind for t in topics if t.startswith(head) and t.endswith(tail)}
    return known


def _changed(loop: LoopState, change: ModeChange | None) -> LoopState:
    """A loop after a change of its mode."""
    if change is None:
        return loop
    return msgspec.structs.replace(
        loop, mode=change.target, since_s=change.time_s, last_change=change
    )


def _is_bounded(value: float) -> bool:
    return math.isnan(value) or abs(value) < MOST


def _frame_of(message: Any, time_s: float, number: int) -> FrameRecord | None:
    """A frame whose data are as many as its size says."""
    width_px, height_px = getattr(message, "width", 0), getattr(message, "height", 0)
    data = getattr(message, "data", b"")
    if not 0 < width_px * height_px <= MOST_PIXELS or len(data) != 2 * width_px * height_px:
        return None
    return FrameRecord(
        time_s=time_s,
        camera=CAMERA,
        number=number,
        width_px=width_px,
        height_px=height_px,
        data=data,
    )


def _fields(state: Unlogged) -> dict[str, Any]:
    """The fields of telemetry that a snapshot has."""
    return {name: getattr(state, name) for name in state.__struct_fields__}


def _state_of(snapshot: Snapshot) -> Unlogged | None:
    """What a snapshot has; None if it cannot be."""
    if len(snapshot.state_msgpack) > MOST_STATE_BYTES:
        return None
    try:
        state = plain_message(_decode_state(snapshot.state_msgpack))
    except UNDECODABLE:
        return None
    sound = _all_bounded(msgspec.to_builtins(state)) and all(map(_is_sound, state.loops))
    if state.fringes is not None:
        sound &= state.fringes.wavelength_m > SMALLEST_WAVELENGTH_M
    return state if sound and 0 < len(state.loops) <= MOST_LOOPS else None


def _is_sound(loop: LoopState) -> bool:
    """Whether a loop has a proper name, and scales and limits that can be drawn."""
    scales = [loop.requirement_px, loop.sky_arcsec_per_px]
    limits = loop.limits
    if limits is not None:
        pitch_arcsec = limits.spiral_pitch_sky_arcsec
        scales += [limits.siderostat_travel_sky_arcsec, pitch_arcsec]
        scales.append(limits.search_radius_sky_arcsec / max(pitch_arcsec, SMALLEST))  # turns
        scales.append(limits.fsm_range_rad + 1.0)  # zero without a mirror
    return is_name(loop.name) and all(SMALLEST < scale < LARGEST for scale in scales)


def _all_bounded(value: Any) -> bool:
    if isinstance(value, dict):
        return all(map(_all_bounded, value.values()))
    if isinstance(value, list | tuple):
        return all(map(_all_bounded, value))
    if isinstance(value, str):
        return len(value) <= MOST_TEXT
    return not isinstance(value, float | int) or _is_bounded(value)
