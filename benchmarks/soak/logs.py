"""The logs of a soak, read from end to end as soon as each is done, before retention takes it."""

from __future__ import annotations

import multiprocessing
import os
from concurrent.futures import Future, ProcessPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from fitctl.logging.copying import recover
from fitctl.logging.errors import LogError
from fitctl.logging.folder import in_use
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.records import Event, RecorderStatus
from fitctl.logging.schemas import TOPICS
from fitctl.logging.verifying import verify

_PATIENCE_S = 300.0
_LOWEST_PRIORITY = 19


class Found(NamedTuple):
    """What is in one file: records that the supervisor offered, whether a kill cut it off, what is wrong."""

    records: set[int]
    cut: bool
    size_bytes: int
    problems: list[str]


class Audit:
    """Counts what is in a folder of logs, each file once, in a process of lowest priority.

    Attributes
    ----------
    written : int
        Records that the supervisor offered and that are in some file; one that two files hold, because its
        recorder was killed before it could confirm it, counts once.
    twice : int
        Records that two files hold.
    files, cut : int
        Files that were read, and those of them that a killed recorder left.
    problems : list of str
        What is wrong with a file.
    """

    def __init__(self, folder: Path) -> None:
        self.written = self.twice = self.files = self.cut = self.size_bytes = 0
        self.problems: list[str] = []
        self._folder = folder
        self._seen: set[Path] = set()
        self._before: set[int] = set()  # of the file before: no others share a record
        self._pending: list[Future[Found]] = []
        context = multiprocessing.get_context("spawn")
        self._executor = ProcessPoolExecutor(1, context, os.nice, (_LOWEST_PRIORITY,))

    def look(self) -> None:
        """Have every file read that nobody writes any more, and take what was found."""
        for path in sorted(self._folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime):
            if path not in self._seen and not in_use(path):
                self._seen.add(path)
                self._pending.append(self._executor.submit(read, path))
        while self._pending and self._pending[0].done():
            self._take(self._pending.pop(0).result())

    def finish(self) -> None:
        """Wait for the last file; raises TimeoutError if that takes too long."""
        self.look()
        for future in self._pending:
            self._take(future.result(_PATIENCE_S))
        self._executor.shutdown()

    @property
    def disk_bytes(self) -> int:
        """What the folder holds now."""
        return sum(path.stat().st_size for path in self._folder.glob("*.mcap"))

    def _take(self, found: Found) -> None:
        again = len(found.records & self._before)
        self.written += len(found.records) - again
        self.twice += again
        self._before = found.records
        self.files += 1
        self.cut += found.cut
        self.size_bytes += found.size_bytes
        self.problems += found.problems


def read(path: Path) -> Found:
    """Read one file; a finished one must be whole, one that was cut off must be so once it is mended."""
    records: set[int] = set()
    cut, problems = False, []
    try:
        for entry in read_records(path):
            if not _recorders_own(entry.topic, entry.message):
                content = entry.message.SerializeToString()
                records.add(hash((entry.topic, entry.publish_time_ns, content)))
        cut = not log_info(path).finished
        problems = _mended_problems(path) if cut else list(verify(path).problems)
    except (LogError, OSError) as error:
        problems = [str(error)]
    return Found(records, cut, path.stat().st_size, [f"{path.name}: {what}" for what in problems])


def _mended_problems(path: Path) -> list[str]:
    mended = path.with_suffix(".mended")
    try:
        recover(path, mended)
        return [f"mended: {problem}" for problem in verify(mended).problems]
    finally:
        mended.unlink(missing_ok=True)


def _recorders_own(topic: str, message: Any) -> bool:
    """Whether the recorder made it, so that it was never in the queue."""
    if topic == TOPICS[Event]:  # the supervisor's about the recorder all begin like this
        return message.name == "recorder" and not message.message.startswith("the recorder ")
    return topic == TOPICS[RecorderStatus]
