"""New logs out of old ones: mended, cut to a part, merged.

Messages and metadata are copied as they are, never decoded. Attachments are not: no log of ours has any.
"""

from __future__ import annotations

import contextlib
import heapq
import os
import zlib
from collections import ChainMap, OrderedDict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass
from operator import itemgetter
from pathlib import Path
from typing import IO, NamedTuple

from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, McapRecord, Message, Metadata, Schema
from mcap.stream_reader import StreamReader, breakup_chunk
from mcap.writer import Writer

from fitctl.files import replaced_whole
from fitctl.logging.errors import LogError
from fitctl.logging.files import COPY, DAMAGE, RECOVERED, Described, opened
from fitctl.logging.folder import in_use
from fitctl.text import plain

# A recorder that dies leaves a quarter of logging.queue_records unconfirmed, and that is a million at the most.
_REMEMBERED = 250_000


class _Copied(NamedTuple):
    """A message and what is needed to understand it."""

    schema: Schema | None
    channel: Channel
    message: Message


@dataclass(slots=True)
class _Source:
    """A file that is read for all it has to give, and what could not be read of it so far."""

    path: Path
    finished: bool = True
    damaged_chunks: int = 0
    undescribed: int = 0
    went_back: int = 0
    unread_bytes: int = 0

    def entries(self) -> Iterator[_Copied | Metadata]:
        """Messages and metadata in the file's order; what is damaged is passed over and counted."""
        with opened(self.path) as (stream, self.finished):
            size = os.fstat(stream.fileno()).st_size
            schemas: Described[Schema] = Described(self.path)
            channels: Described[Channel] = Described(self.path)
            newest_ns = 0
            # The index knows the channels of a damaged chunk, too; but it may be damaged itself.
            indexed_schemas, indexed_channels = self._indexed(stream)
            known_schemas = ChainMap(schemas, indexed_schemas)
            known_channels = ChainMap(channels, indexed_channels)
            read_bytes = 0
            try:
                reader = StreamReader(stream, emit_chunks=True, record_size_limit=size)
                for outer in reader.records:
                    read_bytes = stream.tell()
                    for record in self._inside(outer):
                        match record:
                            case Schema():
                                schemas[record.id] = record
                            case Channel():
                                channels[record.id] = record
                            case Metadata():
                                yield record
                            case Message() if record.channel_id in known_channels:
                                channel = known_channels[record.channel_id]
                                self.went_back += record.log_time < newest_ns
                                newest_ns = max(newest_ns, record.log_time)
                                yield _Copied(known_schemas.get(channel.schema_id), channel, record)
                            case Message():
                                self.undescribed += 1
            except DAMAGE:
                self.unread_bytes = size - read_bytes

    def _indexed(self, stream: IO[bytes]) -> tuple[Described[Schema], Described[Channel]]:
        """What a finished file's index describes, as far as it can be read."""
        schemas: Described[Schema] = Described(self.path)
        channels: Described[Channel] = Described(self.path)
        if self.finished:
            with contextlib.suppress(*DAMAGE):
                summary = SeekingReader(stream).get_summary()
                for schema in summary.schemas.values() if summary else ():
                    schemas[schema.id] = schema
                for channel in summary.channels.values() if summary else ():
                    channels[channel.id] = channel
            stream.seek(0)
        return schemas, channels

    def insist_sound(self) -> None:
        """Refuse to go on with a file that lacks something in its midst; a cut end is none."""
        if self.damaged_chunks or self.went_back or (self.finished and self.unread_bytes):
            msg = f"{self.path}: is damaged; repair it with `fitctl log recover` first"
            raise LogError(msg)

    def _inside(self, record: McapRecord) -> list[McapRecord]:
        if not isinstance(record, Chunk):
            return [record]
        try:
            return breakup_chunk(record, validate_crc=True)
        except DAMAGE:
            self.damaged_chunks += 1
            return []


class _Target:
    """A new file, which appears under its name once it is whole."""

    def __init__(self, path: Path, *, overwrite: bool) -> None:
        if path.exists() and not overwrite:
            msg = f"{path}: exists already; give another name with --out, or pass --overwrite"
            raise LogError(msg)
        if in_use(path):
            msg = f"{path}: is being recorded just now and is not overwritten; give another name"
            raise LogError(msg)
        self.path = path
        self.records = 0
        self._log_time_ns = 0
        self._metadata: set[tuple[str, tuple[tuple[str, str], ...]]] = set()
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._channels: dict[tuple[str, str, int], int] = {}

    @contextlib.contextmanager
    def writing(self, **about: str) -> Iterator[None]:
        """Write inside; after an error no file is left. `about` is what the metadata of a copy has beside."""
        try:
            with replaced_whole(self.path) as file:
                self._mcap = Writer(file, enable_data_crcs=True, use_summary_offsets=False)
                self._mcap.start(library="fitctl")
                self._mcap.add_metadata(COPY, {"by": "fitctl log", **about})
                yield
                self._mcap.finish()
        except OSError as error:
            msg = f"{self.path}: cannot be written: {error.strerror or error}; make room, or give another --out"
            raise LogError(msg) from error

    def add(self, entry: _Copied | Metadata) -> None:
        """Copy one entry; metadata that is there already is not added again, and log times never go back."""
        if isinstance(entry, Metadata):
            if entry.name == COPY:  # is of the source, not of this file
                return
            known = entry.name, tuple(sorted(entry.metadata.items()))
            if known not in self._metadata:
                self._metadata.add(known)
                self._mcap.add_metadata(entry.name, entry.metadata)
            return
        message = entry.message
        self._log_time_ns = max(self._log_time_ns, message.log_time)
        self._mcap.add_message(
            channel_id=self._channel(entry),
            log_time=self._log_time_ns,
            data=message.data,
            publish_time=message.publish_time,
            sequence=message.sequence,
        )
        self.records += 1

    def _channel(self, entry: _Copied) -> int:
        schema, channel = entry.schema, entry.channel
        number = 0
        if schema is not None:
            kind = (schema.name, schema.encoding, schema.data)
            if kind not in self._schemas:
                self._schemas[kind] = self._mcap.register_schema(*kind)
            number = self._schemas[kind]
        key = (channel.topic, channel.message_encoding, number)
        if key not in self._channels:
            self._channels[key] = self._mcap.register_channel(*key, metadata=channel.metadata)
        return self._channels[key]


@dataclass(frozen=True, slots=True)
class Recovered:
    """What was saved of a log and what was not.

    Attributes
    ----------
    records : int
        Saved.
    damaged_chunks : int
        Passed over; each holds what was recorded between two flushes, at the most.
    undescribed : int
        Records that cannot be read: only a damaged chunk described their topic.
    went_back : int
        Records saved whose log time was earlier than one before them; they have that one's now.
    unread_bytes : int
        At the end, from where the file stops making sense.
    """

    records: int
    damaged_chunks: int
    undescribed: int
    went_back: int
    unread_bytes: int


def is_recoverable(source: Path) -> bool:
    """Whether :func:`recover` would save any record of a log; reads no farther than the first."""
    return any(not isinstance(entry, Metadata) for entry in _Source(source).entries())


def recoverable(source: Path) -> Recovered:
    """What :func:`recover` would save of a log; errors as there."""
    reading = _Source(source)
    records = sum(not isinstance(entry, Metadata) for entry in reading.entries())
    return _recovered(records, reading)


def recover(source: Path, target: Path, *, overwrite: bool = False) -> Recovered:
    """Copy what is sound in a cut or damaged log into a whole one.

    Raises
    ------
    LogError
        If there is nothing to save, the source is no log, or the target exists or cannot be written.
    """
    reading, writing = _Source(source), _Target(target, overwrite=overwrite)
    with writing.writing(**{RECOVERED: plain(source.name)}):
        for entry in reading.entries():
            writing.add(entry)
        if not writing.records:
            msg = f"{source}: holds no whole record, so there is nothing to recover"
            raise LogError(msg)
    return _recovered(writing.records, reading)


def _recovered(records: int, reading: _Source) -> Recovered:
    return Recovered(
        records,
        reading.damaged_chunks,
        reading.undescribed,
        reading.went_back,
        reading.unread_bytes,
    )


def cut(
    source: Path,
    target: Path,
    *,
    from_ns: int,
    to_ns: int,
    topics: Collection[str] = (),
    overwrite: bool = False,
) -> int:
    """Copy what was recorded in a span of time, and of some topics only, if any are named.

    Parameters
    ----------
    source, target : Path
    from_ns, to_ns : int
        Log times, nanoseconds since 1970; the second is not included.
    topics : collection of str
    overwrite : bool
        Whether an existing target may go.

    Returns
    -------
    int
        Records copied; the run's description goes with them.

    Raises
    ------
    LogError
        If there are none, the source is damaged or no log, or the target exists or cannot be written.
    """
    reading, writing = _Source(source), _Target(target, overwrite=overwrite)
    with writing.writing():
        for entry in reading.entries():
            if isinstance(entry, Metadata) or (
                from_ns <= entry.message.log_time < to_ns
                and (not topics or entry.channel.topic in topics)
            ):
                writing.add(entry)
        reading.insist_sound()
        if not writing.records:
            msg = f"{source}: has no record of these topics in that time; see `fitctl log info {source}`"
            raise LogError(msg)
    return writing.records


def merge(sources: Sequence[Path], target: Path, *, overwrite: bool = False) -> tuple[int, int]:
    """Copy several logs into one, ordered by log time.

    What a recorder wrote but could not confirm before it died, its successor wrote again: of such a
    pair the first is copied.

    Returns
    -------
    records, doubles : int
        Copied, and left out because another file had them too.

    Raises
    ------
    LogError
        If a source is damaged or no log, or the target exists or cannot be written.
    """
    readings = [_Source(path) for path in sources]
    writing = _Target(target, overwrite=overwrite)
    seen: OrderedDict[tuple[str, int, int, int], int] = (
        OrderedDict()
    )  # the newest, and their source
    doubles = 0
    with writing.writing():
        timed = (_timed(number, reading) for number, reading in enumerate(readings))
        for _, source, entry in heapq.merge(*timed, key=itemgetter(0, 1)):
            if not isinstance(entry, Metadata):
                message = entry.message
                crc = zlib.crc32(message.data)
                key = (entry.channel.topic, message.publish_time, message.sequence, crc)
                if seen.setdefault(key, source) != source:
                    doubles += 1
                    continue
                if len(seen) > _REMEMBERED:
                    seen.popitem(last=False)
            writing.add(entry)
        for reading in readings:
            reading.insist_sound()
        if not writing.records:
            msg = f"{', '.join(map(str, sources))}: hold no record, so there is nothing to merge"
            raise LogError(msg)
    return writing.records, doubles


def _timed(number: int, source: _Source) -> Iterator[tuple[int, int, _Copied | Metadata]]:
    log_time_ns = 0  # the run's description comes before everything
    for entry in source.entries():
        if not isinstance(entry, Metadata):
            log_time_ns = entry.message.log_time
        yield log_time_ns, number, entry
