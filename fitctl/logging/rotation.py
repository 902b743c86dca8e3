"""A log that goes on from file to file, and clears away what has had its time."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path

from fitctl.config import Logging
from fitctl.logging.folder import new_log_path, prune
from fitctl.logging.records import AnyRecord, RunInfo, Severity
from fitctl.logging.writer import LogWriter


class RotatingLog:
    """One run's log as one file after the other; each can be read alone, for each has the run's description.

    Parameters
    ----------
    settings : Logging
        Among others when a new file begins, and how much may stay.
    rig_name : str
        Begins each file's name.
    folder : Path
        Where the files go; made if missing.

    Raises
    ------
    LogError
        If the folder or the first file cannot be made.
    """

    def __init__(self, settings: Logging, rig_name: str, folder: Path) -> None:
        self._settings = settings
        self._rig_name = rig_name
        self._folder = folder
        self._run_info: RunInfo | None = None
        self._records_before = 0
        self._bytes_before = 0
        self._notes: list[tuple[Severity, str]] = []
        self._begin()

    @property
    def path(self) -> Path:
        """The file that is being written."""
        return self._writer.path

    @property
    def records(self) -> int:
        """Written so far, to all files."""
        return self._records_before + self._writer.records

    @property
    def bytes_written(self) -> int:
        """Size of all files so far; the chunk in the making is not counted."""
        return self._bytes_before + self._writer.bytes_written

    def write(self, record: AnyRecord, log_time_s: float) -> None:
        """Add a record: see :meth:`fitctl.logging.writer.LogWriter.write`, also for what it raises."""
        self._writer.write(record, log_time_s)
        if isinstance(record, RunInfo):
            self._run_info = record

    def flush(self) -> None:
        """Put everything so far on the disk; raises LogError if it is full."""
        self._writer.flush()

    def rotate_if_due(self) -> None:
        """Begin another file if this one is large or old enough; flush first.

        Raises
        ------
        LogError
            If the new file cannot be made, or this one not be finished.
        """
        settings, writer = self._settings, self._writer
        age_s = time.monotonic() - self._begun_s
        if writer.bytes_written < settings.rotate_bytes and age_s < settings.rotate_s:
            return
        self._begin()  # first, so that the old one is left open, and closed by whoever ends us, if it fails
        writer.close()
        self._records_before += writer.records
        self._bytes_before += writer.bytes_written
        if self._run_info is not None:
            self._writer.write(self._run_info, time.time())

    def pop_notes(self) -> list[tuple[Severity, str]]:
        """What people should read about deleted files, once."""
        notes, self._notes = self._notes, []
        return notes

    def close(self) -> None:
        """Finish the file; safe to call twice. Raises LogError if the disk is full."""
        self._writer.close()

    def __enter__(self) -> RotatingLog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _begin(self) -> None:
        now = datetime.now(UTC)
        path = new_log_path(self._folder, self._rig_name, now)
        self._writer = LogWriter(path, self._settings)
        self._begun_s = time.monotonic()
        pruned = prune(self._folder, self._rig_name, self._settings, now)
        self._notes += [("warning", why) for why in pruned.refused]  # no reason to stop recording
        self._notes += [("info", f"{log}: deleted, its time was over") for log in pruned.deleted]
