"""The Logs screen's list."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path, PurePath
from typing import ClassVar, NamedTuple

from fitctl.logging.folder import is_kept
from fitctl.tui.look import DIM, GREEN, INK, ORANGE, SKY, Line, shorten, text
from fitctl.tui.state import ConsoleState
from fitctl.tui.widgets.choice import Choice

LISTED = 300
LOOK_EVERY_S = 2.0


class LogFile(NamedTuple):
    """A log as its folder has it."""

    path: Path
    size_bytes: int
    written_s: float
    kept: bool


class LogList(Choice):
    """The newest logs of a folder, the newest first."""

    every: ClassVar[int] = 5

    def __init__(self, state: ConsoleState, title: str, folder: Path | None) -> None:
        super().__init__(state, title)
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

    def head(self, columns: int) -> list[Line]:
        """Names of the columns."""
        folder = str(self.folder or "a folder of the rig's own machine")
        where = shorten(folder, max(8, columns - 46))
        return [[text(f"  {'written, UTC':<21}{'size':>10}  mark       log in {where}", DIM)]]

    def rows(self, columns: int) -> list[Line]:
        """One line each."""
        if time.monotonic() - self._looked_s >= LOOK_EVERY_S:
            self.look()
        recorder = self.state.newest.recorder if self.state.newest else None
        current = PurePath(recorder.path).name if recorder else ""
        lines = [_row(log, current, columns) for log in self.logs]
        return lines or [[text(f"no log in {self.folder}", DIM)]]


def _log(path: Path) -> LogFile | None:
    try:
        status = path.stat()
    except OSError:  # somebody deleted it meanwhile
        return None
    return LogFile(path, status.st_size, status.st_mtime, is_kept(path))


def _row(log: LogFile, current: str, columns: int) -> Line:
    written = datetime.fromtimestamp(log.written_s, UTC).strftime("%Y-%m-%d %H:%M:%S")
    sign, mark, colour = ("  ", "", DIM)
    if log.path.name == current:
        sign, mark, colour = ("● ", "recording", GREEN)
    elif log.kept:
        sign, mark, colour = ("◆ ", "kept", ORANGE)
    both = log.kept and log.path.name == current
    return [
        text(sign, colour, bold=True),
        text(f"{written:<21}", INK),
        text(f"{_size(log.size_bytes):>10}  ", INK),
        text(f"{'rec, kept' if both else mark:<11}", colour, bold=True),
        text(shorten(log.path.name, columns - 46), SKY),
    ]


def _size(size_bytes: int) -> str:
    for unit, factor in (("GB", 1e9), ("MB", 1e6)):
        if size_bytes >= factor:
            return f"{size_bytes / factor:.1f} {unit}"
    return f"{size_bytes / 1e3:.0f} kB"
