"""The telemetry of the last ten minutes, packed, so that the console can show it again."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence

import msgspec
import zstandard

from fitctl.logging.records import Event, MetrologyTick, ModeChange, Overlap, Tick
from fitctl.messages.telemetry import Telemetry
from fitctl.tui.history import KEPT_S
from fitctl.tui.rewind.moment import Moment, course_from_s, until
from fitctl.tui.state import READING_STEP_S

REWIND_S = 600.0
MOST_BYTES = 128 << 20


class _Course(msgspec.Struct, kw_only=True):
    """The parts of a message that a minute of messages is needed for; the rest is not decoded."""

    pid: int
    ticks: list[Tick]
    mode_changes: list[ModeChange]
    metrology_ticks: list[MetrologyTick] = []
    overlaps: list[Overlap] = []


class Recent:
    """Every message of the last `REWIND_S`, and of the minute before that its traces need.

    At most `MOST_BYTES`: of a supervisor that sends more, less than ten minutes are kept. Messages are added
    on one thread and read on another.

    Parameters
    ----------
    events : callable
        All events that the console knows, newest first.
    """

    def __init__(self, events: Callable[[], Sequence[Event]]) -> None:
        self.events = events
        self.packed_bytes = 0
        self._kept: deque[tuple[float, bytes]] = deque()
        self._lock = threading.Lock()
        self._pack = zstandard.ZstdCompressor(level=1).compress
        self._encode = msgspec.msgpack.Encoder().encode
        self._decode = msgspec.msgpack.Decoder(Telemetry).decode
        self._decode_course = msgspec.msgpack.Decoder(_Course).decode

    def add(self, message: Telemetry, received_s: float) -> None:
        """Keep a message, and drop what is too old or too much."""
        packed = self._pack(self._encode(message))
        with self._lock:
            if self._kept and received_s < self._kept[-1][0]:
                self._kept.clear()  # the supervisor's clock has begun anew
                self.packed_bytes = 0
            self._kept.append((received_s, packed))
            self.packed_bytes += len(packed)
            oldest_s = received_s - REWIND_S - KEPT_S
            while self._kept[0][0] < oldest_s or self.packed_bytes > MOST_BYTES:
                self.packed_bytes -= len(self._kept.popleft()[1])
                if not self._kept:
                    break

    def span_s(self) -> tuple[float, float]:
        """From at most `REWIND_S` before the newest message to that."""
        with self._lock:
            if not self._kept:
                return 0.0, 0.0
            oldest_s, newest_s = self._kept[0][0], self._kept[-1][0]
        return max(oldest_s, newest_s - REWIND_S), newest_s

    def at(self, time_s: float) -> Moment | None:
        """The moment at a time; None before the first message."""
        with self._lock:
            rows = [row for row in self._kept if row[0] <= time_s]
        if not rows:
            return None
        unpack = zstandard.ZstdDecompressor().decompress
        received_s, packed = rows.pop()
        newest = self._decode(unpack(packed))
        from_s = course_from_s(newest.loops, received_s)
        earlier = [self._decode_course(unpack(row[1])) for row in rows if row[0] >= from_s]
        course = [part for part in earlier if part.pid == newest.pid] + [newest]
        message = msgspec.structs.replace(
            newest,
            **{
                name: [record for part in course for record in getattr(part, name)]
                for name in ("ticks", "mode_changes", "metrology_ticks", "overlaps")
            },
        )
        states = [(newest.time_s, newest.loops)]
        for then_s, earlier_packed in reversed(rows):
            if then_s < time_s - KEPT_S:
                break
            if then_s <= states[-1][0] - READING_STEP_S:
                then = self._decode(unpack(earlier_packed))
                states.append((then.time_s, then.loops))
        return Moment(message, received_s, until(self.events(), time_s), states[::-1])
