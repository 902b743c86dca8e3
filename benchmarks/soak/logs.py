"""The logs of a soak, read from end to end as soon as each is done, before retention takes it."""

from __future__ import annotations

import os
import threading
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

from fitctl.logging.copying import recover
from fitctl.logging.errors import LogError
from fitctl.logging.folder import in_use
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.records import Event, RecorderStatus
from fitctl.logging.schemas import TOPICS
from fitctl.logging.verifying import verify

_PATIENCE_S = 300.0
_LOWEST_PRIORITY = 19


class Audit:
    """Counts what is in a folder of logs, each file once, on a thread of low priority.

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
        self.written = self.twice = self.files = self.cut = self.bytes = 0
        self.problems: list[str] = []
        self._folder = folder
        self._seen: set[Path] = set()
        self._before: set[int] = set()  # of the file before: more do not share a record
        self._executor = ThreadPoolExecutor(1, initializer=_be_patient)
        self._pending: list[Future] = []

    def look(self) -> None:
        """Have every file read that nobody writes any more."""
        for path in sorted(self._folder.glob("*.mcap"), key=lambda path: path.stat().st_mtime):
            if path not in self._seen and not in_use(path):
                self._seen.add(path)
                self._pending.append(self._executor.submit(self._read, path))
        self._pending = [future for future in self._pending if not future.done()]

    def finish(self) -> None:
        """Wait for the last file; raises TimeoutError if that takes too long."""
        self.look()
        for future in self._pending:
            future.result(_PATIENCE_S)
        self._executor.shutdown()

    @property
    def disk_bytes(self) -> int:
        """What the folder holds now."""
        return sum(path.stat().st_size for path in self._folder.glob("*.mcap"))

    def _read(self, path: Path) -> None:
        try:
            self._count(path)
            self._judge(path)
        except (LogError, OSError) as error:
            self.problems.append(str(error))
        self.files += 1

    def _count(self, path: Path) -> None:
        found = set()
        for entry in read_records(path):
            if not _recorders_own(entry.topic, entry.message):
                content = entry.message.SerializeToString()
                found.add(hash((entry.topic, entry.publish_time_ns, content)))
        again = len(found & self._before)
        self.written += len(found) - again
        self.twice += again
        self._before = found
        self.bytes += path.stat().st_size

    def _judge(self, path: Path) -> None:
        """A finished file must be whole; one that was cut off must be so once it is mended."""
        if log_info(path).finished:
            self.problems += [f"{path.name}: {problem}" for problem in verify(path).problems]
            return
        self.cut += 1
        mended = path.with_suffix(".mended")
        try:
            recover(path, mended)
            self.problems += [f"{path.name}, mended: {what}" for what in verify(mended).problems]
        finally:
            mended.unlink(missing_ok=True)


def _recorders_own(topic: str, message: object) -> bool:
    """Whether the recorder made it, so that it was never in the queue."""
    if topic == TOPICS[Event]:  # the supervisor's about the recorder all begin like this
        return message.name == "recorder" and not message.message.startswith("the recorder ")
    return topic == TOPICS[RecorderStatus]


def _be_patient() -> None:
    os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _LOWEST_PRIORITY)
