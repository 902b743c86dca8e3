"""The Logs screen's list."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import ClassVar, NamedTuple

import msgspec

from fitctl.logging.folder import is_kept
from fitctl.text import plain
from fitctl.tui.inks import DIM, GREEN, INK, ORANGE, SKY, WHITE
from fitctl.tui.jobs import Job
from fitctl.tui.look import Line, duration, shorten, text, width
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.choice import Choice

LISTED = 300
AT_ONCE = 10  # logs that one process reads
MOST_BYTES = 2_000_000_000  # of a log that is read for its RMS
LATEST_S = 2.5e11  # the year 9892
LOOK_EVERY_S = 2.0


class LogFile(NamedTuple):
    """A log as its folder has it."""

    path: Path
    size_bytes: int
    written_s: float
    kept: bool


class LogSummary(msgspec.Struct):
    """A line of `fitctl log summary --json`."""

    path: str
    start_s: float | None = None
    duration_s: float | None = None
    verdict: str = ""
    rms: dict[str, str] = {}
    error: str = ""


class Summaries:
    """Start, duration, RMS and verdict of logs, read by a process of its own, some logs at a time.

    What was read is kept as long as the log is listed and unchanged.
    """

    def __init__(self) -> None:
        self._known: dict[LogFile, LogSummary | None] = {}
        self._asked: list[LogFile] = []
        self._job: Job | None = None

    def of(self, log: LogFile) -> LogSummary | None:
        """What is known of a log; None while nothing is."""
        return self._known.get(_as_read(log))

    def ask(self, start_job: Callable[..., Job], logs: list[LogFile], current: str) -> None:
        """Collect what was read, and have the newest logs read that are not known; not one that grows."""
        if self._job is not None:
            self._collect(self._job)
        listed = [_as_read(log) for log in logs if log.path.name != current]
        if self._job is None:
            self._known = {log: self._known[log] for log in listed if log in self._known}
            self._asked = [log for log in listed if log not in self._known][:AT_ONCE]
            if self._asked:
                paths = [str(log.path) for log in self._asked]
                options = ["--json", "--most-bytes", str(MOST_BYTES)]
                self._job = start_job(["log", "summary", *options, *paths])

    def end(self) -> None:
        """Leave no child behind."""
        if self._job is not None:
            self._job.end()
            self._job = None

    def _collect(self, job: Job) -> None:
        ended = job.status is not None  # before its text is read: then that is all
        # JSON has a name that is not UTF-8 only as `plain` shows it.
        by_path = {plain(str(log.path)): log for log in self._asked}
        for line in job.text().splitlines():
            with contextlib.suppress(msgspec.MsgspecError):  # the last one may be half a line
                summary = msgspec.json.decode(line, type=LogSummary)
                if log := by_path.get(plain(summary.path)):
                    self._known[log] = summary
        if ended:
            for log in self._asked:  # what is not known now will not be
                self._known.setdefault(log, None)
            self.end()


def _as_read(log: LogFile) -> LogFile:
    """A log by what a change of its contents changes; marking it is none."""
    return log._replace(kept=False)


class LogList(Choice):
    """The newest logs of a folder, the newest first."""

    every: ClassVar[int] = 5

    def __init__(
        self,
        state: ConsoleState,
        title: str,
        folder: Path | None,
        summary_of: Callable[[LogFile], LogSummary | None] = lambda _: None,
    ) -> None:
        super().__init__(state, title)
        self._summary_of = summary_of
        self.folder = folder
        self.logs: list[LogFile] = []
        self._looked_s = -LOOK_EVERY_S

    @property
    def chosen_log(self) -> LogFile | None:
        """The chosen one."""
        return self.logs[self.chosen] if self.chosen < len(self.logs) else None

    def look(self) -> None:
        """Read the folder anew; the chosen log stays chosen."""
        self._looked_s = time.monotonic()
        chosen = self.chosen_log.path if self.chosen_log else None
        files = self.folder.glob("*.mcap") if self.folder else ()
        found = sorted(files, key=lambda path: path.name, reverse=True)
        self.logs = [log for path in found[:LISTED] if (log := _log(path)) is not None]
        self.logs.sort(key=lambda log: -log.written_s)
        paths = [log.path for log in self.logs]
        self.chosen = paths.index(chosen) if chosen in paths else min(self.chosen, len(paths))

    @property
    def current(self) -> str:
        """Name of the log that is being recorded; empty without one."""
        recorder = self.state.newest.recorder if self.state.newest else None
        return PurePath(recorder.path).name if recorder else ""

    def head(self, columns: int) -> list[Line]:
        """Names of the columns."""
        names = f"  {'begins, UTC':<15}{'lasts':>8}{'RMS':>11}  {'requirement':<12}{'size':>8} "
        folder = str(self.folder or "a folder of the rig's own machine")
        return [[text(names, DIM), text(shorten(f"log in {folder}", columns - len(names)), DIM)]]

    def rows(self, columns: int) -> list[Line]:
        """One line each."""
        if time.monotonic() - self._looked_s >= LOOK_EVERY_S:
            self.look()
        loop = self.state.shown
        lines = [_row(log, self._summary_of(log), loop, self.current, columns) for log in self.logs]
        return lines or [[text(f"no log in {self.folder}", DIM)]]


def _log(path: Path) -> LogFile | None:
    try:
        status = path.stat()
    except OSError:  # somebody deleted it meanwhile
        return None
    return LogFile(path, status.st_size, status.st_mtime, is_kept(path))


def _row(log: LogFile, summary: LogSummary | None, loop: str, current: str, columns: int) -> Line:
    sign, colour = ("◆ ", WHITE) if log.kept else ("  ", DIM)
    if log.path.name == current:
        sign, colour = ("● ", GREEN)
    known = summary or LogSummary(path="")
    begins_s, lasts = known.start_s, ""
    if known.duration_s is not None:
        lasts = duration(known.duration_s)
    # The shown loop's, or of a rig without that loop the first one's.
    rms = known.rms.get(loop) or next(iter(known.rms.values()), "")
    good = {"met": GREEN, "not met": ORANGE}.get(known.verdict, DIM)
    mark = {"met": "✓ met", "not met": "▲ not met"}.get(known.verdict, known.verdict)
    if log.path.name == current:
        mark, good = "recording", GREEN
    kept = " kept" if log.kept else ""
    line = [
        text(sign, colour, bold=True),
        text(f"{_when(begins_s):<15}{lasts:>8}{rms:>11}  ", INK),
        text(f"{'unreadable' if known.error else mark:<12}", good),
        text(f"{_size(log.size_bytes):>8} ", INK),
    ]
    room = columns - width(line) - len(kept)
    return [*line, text(shorten(log.path.name, room), SKY), text(kept, WHITE)]


def _when(wall_s: float | None) -> str:
    """Month, day and time in UTC; the year is in the log's name."""
    if wall_s is None or not abs(wall_s) < LATEST_S:
        return "…"
    return datetime.fromtimestamp(wall_s, UTC).strftime("%m-%d %H:%M:%S")


def _size(size_bytes: int) -> str:
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if size_bytes >= factor:
            return f"{size_bytes / factor:.1f} {unit}"
    return f"{size_bytes / 1e3:.0f} kB"
