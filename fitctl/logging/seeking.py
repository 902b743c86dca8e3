"""Reading a log from any time on, finished or not, without reading what comes before.

The library's readers need the index at a file's end, which a killed recorder did not write. Here a log is a
list of chunks, each with the times that its record has.
"""

from __future__ import annotations

import contextlib
import io
import struct
from collections.abc import Callable, Collection, Iterator, Mapping
from pathlib import Path
from typing import IO, Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema
from mcap.stream_reader import get_chunk_data_stream
from mcap.writer import MCAP0_MAGIC
from mcap_protobuf.decoder import DecoderFactory

from fitctl.logging.chunks import MESSAGE, RECORD, records
from fitctl.logging.errors import LogError
from fitctl.logging.files import DAMAGE, Described, opened
from fitctl.logging.reading import LogMessage

MOST_CHUNKS = 1_000_000
MOST_METADATA_BYTES = 128 << 20
MOST_BYTES_AT_ONCE = 256 << 20  # that one call unpacks
_TIMES = struct.Struct("<QQ")  # of a chunk's first and last message
_CHANNEL = struct.Struct("<H")  # that a message index is of


class _ChunkPlace(NamedTuple):
    """Where a chunk is in the file, the log times in ns of its first and last message, and its channels.

    Without an index of its messages the channels are unknown, and empty.
    """

    offset: int
    size: int
    start_ns: int
    end_ns: int
    channels: set[int]


class SeekableLog:
    """The chunks of a log that were in the file when it was opened.

    Damage ends the list of chunks; a chunk that cannot be read is left out and counted.

    Parameters
    ----------
    path : Path

    Attributes
    ----------
    metadata : dict
        The run's description by name, as :class:`fitctl.logging.reading.LogInfo` has it.
    topics : set of str
    damaged : int
        Chunks that could not be read so far.

    Raises
    ------
    LogError
        If the file is missing or no MCAP log, holds no message, or has more chunks than `MOST_CHUNKS` or more
        schemas than :class:`~fitctl.logging.files.Described` keeps.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.metadata: dict[str, dict[str, str]] = {}
        self.damaged = 0
        self._chunks: list[_ChunkPlace] = []
        self._schemas: Described[Schema] = Described(path)
        self._channels: Described[Channel] = Described(path)
        self._decoders: dict[int, Callable[[bytes], Any] | None] = {}
        self._factory = DecoderFactory()
        # What comes before a torn end, or before damage, can be read.
        with opened(path) as (stream, _), contextlib.suppress(*DAMAGE):
            self._scan(stream)
        if not self._chunks:
            msg = (
                f"{path}: holds no messages that can be read; `fitctl log verify` lists the damage"
            )
            raise LogError(msg)

    @property
    def topics(self) -> set[str]:
        """Of all chunks."""
        return {channel.topic for channel in self._channels.values()}

    @property
    def span_ns(self) -> tuple[int, int]:
        """Log times of the first and the last message, in ns since 1970."""
        return min(c.start_ns for c in self._chunks), max(c.end_ns for c in self._chunks)

    def messages(
        self,
        from_ns: int,
        to_ns: int,
        topics: Collection[str] | None = None,
        most_bytes: int = MOST_BYTES_AT_ONCE,
    ) -> Iterator[LogMessage]:
        """Messages logged from one time to another, in the order of the file.

        Raises
        ------
        LogError
            If the file is gone, or unpacks to more than `most_bytes` between these times.
        """
        unpacked = 0
        wanted = {
            number: channel.topic
            for number, channel in self._channels.items()
            if topics is None or channel.topic in topics
        }
        with opened(self.path) as (stream, _):
            for place in self._chunks:
                if place.end_ns < from_ns or place.start_ns > to_ns:
                    continue
                if place.channels and wanted.keys().isdisjoint(place.channels):
                    continue
                try:
                    content = self._unpack(stream, place)
                except DAMAGE:
                    self.damaged += 1
                    continue
                unpacked += len(content)
                if unpacked > most_bytes:
                    msg = f"{self.path}: more than {most_bytes >> 20} MiB would have to be read at once"
                    raise LogError(msg)
                yield from self._inside(content, from_ns, to_ns, wanted)

    def _scan(self, stream: IO[bytes]) -> None:
        at, metadata_bytes = len(MCAP0_MAGIC), 0
        newest: _ChunkPlace | None = None
        unpacked: _ChunkPlace | None = None
        while True:
            stream.seek(at)
            head = stream.read(RECORD.size)
            if len(head) < RECORD.size:
                return
            opcode, size = RECORD.unpack(head)
            if opcode in {Opcode.CHUNK_INDEX, Opcode.FOOTER}:
                return  # all channels of a finished log come before the index
            if opcode == Opcode.CHUNK:
                start_ns, end_ns = _TIMES.unpack(stream.read(_TIMES.size))
                newest = _ChunkPlace(at, size, start_ns, end_ns, set())
                self._chunks.append(newest)
                if len(self._chunks) > MOST_CHUNKS:
                    msg = f"{self.path}: has more than {MOST_CHUNKS} chunks; cut it with `fitctl log cut`"
                    raise LogError(msg)
            elif opcode == Opcode.MESSAGE_INDEX and newest is not None:
                (channel,) = _CHANNEL.unpack(stream.read(_CHANNEL.size))
                newest.channels.add(channel)
                if channel not in self._channels and newest is not unpacked:  # each chunk once
                    unpacked = newest
                    with contextlib.suppress(*DAMAGE):  # is counted when it is read
                        self._learn_channels(self._unpack(stream, newest))
            elif opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                self._learn_channels(head + stream.read(min(size, MOST_METADATA_BYTES)))
            elif opcode == Opcode.METADATA and metadata_bytes + size <= MOST_METADATA_BYTES:
                metadata_bytes += size
                entry = Metadata.read(ReadDataStream(io.BytesIO(stream.read(size))))
                self.metadata[entry.name] = entry.metadata
            at += RECORD.size + size

    def _learn_channels(self, content: bytes) -> None:
        for opcode, begin, end in records(content):
            if opcode in {Opcode.SCHEMA, Opcode.CHANNEL}:
                part = ReadDataStream(io.BytesIO(content[begin:end]))
                if opcode == Opcode.SCHEMA:
                    schema = Schema.read(part)
                    self._schemas[schema.id] = schema
                else:
                    channel = Channel.read(part)
                    self._channels[channel.id] = channel

    def _unpack(self, stream: IO[bytes], place: _ChunkPlace) -> bytes:
        if place.size > MOST_BYTES_AT_ONCE:
            msg = f"a chunk of {place.size} bytes"
            raise McapError(msg)
        stream.seek(place.offset + RECORD.size)
        chunk = Chunk.read(ReadDataStream(io.BytesIO(stream.read(place.size))))
        content, length = get_chunk_data_stream(chunk, validate_crc=True)
        return content.read(length)

    def _inside(
        self, content: bytes, from_ns: int, to_ns: int, wanted: Mapping[int, str]
    ) -> Iterator[LogMessage]:
        try:
            for opcode, begin, end in records(content):
                if opcode != Opcode.MESSAGE:
                    continue
                number, sequence, log_ns, publish_ns = MESSAGE.unpack_from(content, begin)
                if number not in wanted or not from_ns <= log_ns <= to_ns:
                    continue
                decode = self._decoder(number)
                if decode is not None:
                    message = decode(content[begin + MESSAGE.size : end])
                    yield LogMessage(wanted[number], message, log_ns, publish_ns, sequence)
        except DAMAGE:
            self.damaged += 1

    def _decoder(self, number: int) -> Callable[[bytes], Any] | None:
        """Of a channel's messages; None if its schema is of another kind."""
        if number not in self._decoders:
            channel = self._channels[number]
            schema = self._schemas.get(channel.schema_id)
            self._decoders[number] = self._factory.decoder_for(channel.message_encoding, schema)
        return self._decoders[number]
