"""The recorder process: receives every record, writes the log, reports its status.

It shares nothing with the supervisor but the queue's socket, because flushing a chunk may take as long
as a whole frame period.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable
from pathlib import Path

import msgspec

from fitctl.config import Logging
from fitctl.logging.queue import RecordReceiver
from fitctl.logging.records import (
    RECORD_VERSION,
    AnyRecord,
    Envelope,
    Event,
    RecorderStatus,
    RunInfo,
    Severity,
)
from fitctl.logging.rotation import RotatingLog
from fitctl.text import UNDECODABLE

STATUS_PERIOD_S = 1.0
DRAIN_S = 2.0
_POLL_S = 0.1  # how soon a stop or a dead parent is noticed
_QUIET_S = 0.2  # the queue counts as drained when nothing came for this long

_decode = msgspec.msgpack.Decoder(Envelope).decode


def record(
    endpoint: str,
    rig_logging: Logging,
    *,
    rig_name: str,
    folder: Path,
    stop: threading.Event,
    on_status: Callable[[RecorderStatus], None] | None = None,
    parent_pid: int | None = None,
) -> None:
    """Record until `stop` is set or the parent process dies; then drain the queue and finish the log.

    Parameters
    ----------
    endpoint : str
        The supervisor's :class:`~fitctl.logging.queue.RecordQueue`.
    rig_logging : Logging
        Chunks, compression, how often to flush, when to begin a new file, what to delete.
    rig_name : str
        Begins each file's name.
    folder : Path
        Where the files go; made if missing.
    stop : threading.Event
        Set by the caller, from a signal handler for example.
    on_status : callable, optional
        Called about once a second, and at the end.
    parent_pid : int, optional
        The parent as the caller knows it; without it, whoever is the parent now.

    Raises
    ------
    LogError
        If the log cannot be written, or the endpoint is no address.
    """
    parent = os.getppid() if parent_pid is None else parent_pid
    with RotatingLog(rig_logging, rig_name, folder) as log:
        receiver = RecordReceiver(endpoint)
        try:
            recording = _Recording(log, receiver, rig_logging, on_status)
            while not stop.is_set() and os.getppid() == parent:
                recording.step(_POLL_S)
            deadline_s = time.monotonic() + DRAIN_S
            still_coming = True
            while still_coming and time.monotonic() < deadline_s:
                still_coming = recording.step(_QUIET_S)
            if still_coming:
                recording.warn_of_cut_end()
            recording.report()
            log.close()
            recording.confirm()
        finally:
            receiver.close()


class _Recording:
    """One log in the making: what came, what is missing, when to flush and when to report."""

    def __init__(
        self,
        log: RotatingLog,
        receiver: RecordReceiver,
        settings: Logging,
        on_status: Callable[[RecorderStatus], None] | None,
    ) -> None:
        self._log = log
        self._receiver = receiver
        self._flush_s = settings.flush_s
        # The queue keeps what is not confirmed, so confirm well before it is full.
        self._flush_records = max(1, settings.queue_records // 4)
        self._on_status = on_status
        # One offset for the whole log, the run's once it is known: log times never go back and
        # compare with the records' own times, even if somebody sets the wall clock meanwhile.
        self._wall_minus_monotonic_s = time.time() - time.monotonic()
        self._log_time_s = 0.0
        self._last_sequence: int | None = None
        self._unconfirmed = 0
        self._lost = 0
        self._lost_reported = 0
        self._malformed = 0
        self._malformed_reported = 0
        self._malformed_why = ""
        self._next_flush_s = time.monotonic() + self._flush_s
        self._next_status_s = time.monotonic() + STATUS_PERIOD_S

    def step(self, timeout_s: float) -> bool:
        """Receive and write one record, then whatever is due; False when none came in time."""
        data = self._receiver.receive(timeout_s)
        if data is not None:
            self._receive(data)
        now_s = time.monotonic()
        if now_s >= self._next_status_s:
            self._next_status_s = now_s + STATUS_PERIOD_S
            self.report()
        if now_s >= self._next_flush_s or self._unconfirmed >= self._flush_records:
            self._next_flush_s = now_s + self._flush_s
            self._log.flush()
            self.confirm()
            self._log.rotate_if_due()
        return data is not None

    def confirm(self) -> None:
        """Confirm to the queue what is in the file."""
        if self._last_sequence is not None and self._unconfirmed:
            self._receiver.confirm(self._last_sequence)
        self._unconfirmed = 0

    def report(self) -> None:
        """Write a status record, and before it what was lost, not understood or deleted since the last."""
        now_s = time.monotonic()
        for severity, message in self._log.pop_notes():
            self._write_event(severity, message)
        if self._lost > self._lost_reported:
            self._write_event(
                "warning",
                f"{self._lost - self._lost_reported} records were lost on their way to the log "
                f"({self._lost} in all); the disk or the machine is too slow",
            )
            self._lost_reported = self._lost
        if self._malformed > self._malformed_reported:
            self._write_event(
                "error",
                f"{self._malformed - self._malformed_reported} messages were no records "
                f"({self._malformed} in all); the last: {self._malformed_why}",
            )
            self._malformed_reported = self._malformed
        status = RecorderStatus(
            time_s=now_s,
            path=str(self._log.path),
            records=self._log.records,
            lost=self._lost,
            bytes_written=self._log.bytes_written,
        )
        self._write(status)
        if self._on_status is not None:
            self._on_status(status)

    def warn_of_cut_end(self) -> None:
        """Write a warning that the log may end before the queue does."""
        self._write_event(
            "warning",
            f"after {DRAIN_S:g} s of draining the queue, records still arrived; "
            "some may be missing at the end of this log",
        )

    def _receive(self, data: bytes) -> None:
        self._unconfirmed += 1
        try:
            envelope = _envelope_of(data)
            self._count_gap(envelope.sequence)
            if isinstance(envelope.record, RunInfo):
                self._wall_minus_monotonic_s = envelope.record.wall_minus_monotonic_s
            self._write(envelope.record)
        except (*UNDECODABLE, ValueError) as error:
            self._malformed += 1
            self._malformed_why = str(error)

    def _count_gap(self, sequence: int) -> None:
        if self._last_sequence is not None:
            self._lost += max(0, sequence - self._last_sequence - 1)
        self._last_sequence = sequence

    def _write(self, record: AnyRecord) -> None:
        now_s = time.monotonic() + self._wall_minus_monotonic_s
        self._log_time_s = max(self._log_time_s, now_s)  # the run's offset comes a little late
        self._log.write(record, self._log_time_s)

    def _write_event(self, severity: Severity, message: str) -> None:
        event = Event(
            time_s=time.monotonic(), severity=severity, source="recorder", message=message
        )
        self._write(event)


def _envelope_of(data: bytes) -> Envelope:
    """Decode an envelope of this version.

    Raises
    ------
    msgspec.DecodeError, RecursionError, ValueError
        If it is damaged, or of another version.
    """
    try:
        envelope = _decode(data)
    except msgspec.ValidationError:  # msgpack, but not our envelope: perhaps another version's
        _check_version(msgspec.msgpack.decode(data))
        raise
    _check_version([envelope.version])
    return envelope


def _check_version(content: object) -> None:
    if isinstance(content, list) and content and content[0] != RECORD_VERSION:
        msg = (
            f"a record of version {content[0]}, but this recorder knows version {RECORD_VERSION}; "
            "start supervisor and recorder from the same installation of fitctl"
        )
        raise ValueError(msg)
