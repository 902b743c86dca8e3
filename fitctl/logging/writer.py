"""Records into one MCAP file: protobuf messages, compressed chunks, checksums, an index at the end."""

from __future__ import annotations

import contextlib
import fcntl
import os
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

from google.protobuf.message import Message
from mcap.well_known import MessageEncoding
from mcap.writer import CompressionType, Writer
from mcap_protobuf.schema import register_schema

from fitctl.config import Logging
from fitctl.logging.errors import LogError
from fitctl.logging.records import AnyRecord, RunInfo
from fitctl.logging.schemas import run_metadata, to_message, topic_of

_COMPRESSION = {
    "zstd": CompressionType.ZSTD,
    "lz4": CompressionType.LZ4,
    "none": CompressionType.NONE,
}
_WALL_LIMIT_S = 2**63 / 1e9  # what fits in nanoseconds


class LogWriter:
    """One log file, open for writing; a context manager that finishes it.

    The file is locked (flock) for as long as it is open: `fitctl.logging.folder.in_use` asks for that. A
    message's publish time is its record's own time and its log time is the recorder's, both as wall
    time. The sequence of a message is its record's ``number`` where it has one (ticks, frames), and
    otherwise counts the messages of its topic from 1.

    Parameters
    ----------
    path : Path
        A file that does not exist yet.
    settings : Logging
        Chunk size and compression.

    Raises
    ------
    LogError
        If the file exists or cannot be made.
    """

    def __init__(self, path: Path, settings: Logging) -> None:
        self.path = path
        self.records = 0
        self._wall_minus_monotonic_s = time.time() - time.monotonic()
        self._run_info: RunInfo | None = None
        self._schemas: dict[type[Message], int] = {}
        self._channels: dict[str, int] = {}
        self._written: Counter[str] = Counter()
        self._closed = False
        self._failed = False
        with self._explained():
            self._file = path.open("xb")
        self._mcap = Writer(
            self._file,
            chunk_size=settings.chunk_bytes,
            compression=_COMPRESSION[settings.compression],
            enable_crcs=True,
            enable_data_crcs=True,
            use_summary_offsets=False,  # this writer would point to groups that are empty
        )
        try:
            with self._explained():
                with contextlib.suppress(OSError):  # a network folder may know no locks
                    fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                self._mcap.start(library="fitctl")
                self.flush()  # so that the file is a log from its first moment
                _sync_folder(path.parent)
        except LogError:
            self.close()
            path.unlink(missing_ok=True)  # a full disk still has room for any number of empty files
            raise

    @property
    def bytes_written(self) -> int:
        """Size of the file so far; the chunk in the making is not counted."""
        return self._file.tell() if not self._file.closed else self.path.stat().st_size

    def write(self, record: AnyRecord, log_time_s: float) -> None:
        """Add a record; a RunInfo becomes metadata, and the same one a second time nothing.

        Parameters
        ----------
        record : AnyRecord
            What to write.
        log_time_s : float
            The recorder's wall time, seconds since 1970; should never go back.

        Raises
        ------
        LogError
            If the disk is full or the file is gone; nothing more can be written then.
        ValueError
            If the record holds a value that the log cannot, such as a time that is not a number. The
            log stays as it was.
        """
        with self._explained():
            if isinstance(record, RunInfo):
                self._write_run_info(record)
            else:
                self._write_message(record, log_time_s)
            self.records += 1

    def flush(self) -> None:
        """Put everything so far on the disk; a power cut or a killed recorder loses only what comes after.

        Raises
        ------
        LogError
            If the disk is full.
        """
        with self._explained():
            self._mcap.flush()
            os.fdatasync(self._file.fileno())

    def close(self) -> None:
        """Write the index and close; safe to call twice and after a failure.

        Raises
        ------
        LogError
            If the disk is full; the file is closed all the same, and readable up to its last flush.
        """
        if self._closed:
            return
        self._closed = True
        try:
            if not self._failed:
                with self._explained():
                    self._mcap.finish()
                    self._file.flush()
                    os.fdatasync(self._file.fileno())
        finally:
            with contextlib.suppress(OSError):  # a full disk was reported already
                self._file.close()

    def __enter__(self) -> LogWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _write_run_info(self, info: RunInfo) -> None:
        if info == self._run_info:  # sent again to each new recorder, see fitctl.logging.queue
            return
        self._run_info = info
        self._wall_minus_monotonic_s = info.wall_minus_monotonic_s
        for name, texts in run_metadata(info).items():
            self._mcap.add_metadata(name, texts)

    def _write_message(self, record: AnyRecord, log_time_s: float) -> None:
        topic = topic_of(record)
        publish_s = record.time_s + self._wall_minus_monotonic_s
        if not 0 <= publish_s < _WALL_LIMIT_S:  # not a number fails this too
            msg = f"{type(record).__name__}: time_s = {record.time_s!r} is no time"
            raise ValueError(msg)
        publish_ns = round(publish_s * 1e9)
        message = to_message(record, publish_ns)
        channel = self._channels.get(topic)
        if channel is None:
            channel = self._channels[topic] = self._register(topic, type(message))
        self._written[topic] += 1
        number: int = getattr(record, "number", self._written[topic])
        self._mcap.add_message(
            channel_id=channel,
            log_time=round(log_time_s * 1e9),
            data=message.SerializeToString(),
            publish_time=publish_ns,
            sequence=number % 2**32,
        )

    def _register(self, topic: str, kind: type[Message]) -> int:
        if kind not in self._schemas:
            self._schemas[kind] = register_schema(self._mcap, kind)
        return self._mcap.register_channel(
            topic=topic,
            message_encoding=MessageEncoding.Protobuf,
            schema_id=self._schemas[kind],
        )

    @contextlib.contextmanager
    def _explained(self) -> Iterator[None]:
        """Turn the operating system's refusal into a LogError, and remember it."""
        if self._failed:
            msg = f"{self.path}: an earlier write failed, so nothing more is written to this log"
            raise LogError(msg)
        try:
            yield
        except FileExistsError:
            msg = f"{self.path}: exists already and is not overwritten; choose another name"
            raise LogError(msg) from None
        except OSError as error:
            self._failed = True
            msg = (
                f"{self.path}: cannot be written: {error.strerror or error}; make room or give "
                "write permission there, or name another folder (key logging.folder of the rig file)"
            )
            raise LogError(msg) from error


def _sync_folder(folder: Path) -> None:
    """Put the folder's own list of files on the disk: a new file's data alone would not be found again."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
