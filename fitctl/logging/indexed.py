"""Reading of a finished log the messages that are wanted, and of the others no more than where they end.

The library's own reader makes an object of each message that a chunk holds. Most of a log are frames, and who
wants ticks would wait most of the time for those.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.reader import SeekingReader
from mcap.records import Channel, Chunk, Message, Schema
from mcap.stream_reader import get_chunk_data_stream

from fitctl.logging.chunks import MESSAGE, RECORD, records


class IndexedReader(SeekingReader):
    """The library's reader, which passes over what is not wanted within a chunk too."""

    def iter_messages(
        self, topics: Iterable[str] | str | None = None, *args: Any, **options: Any
    ) -> Iterator[tuple[Schema | None, Channel, Message]]:
        """Messages in the order of the file; nothing but topics can be asked for.

        Raises
        ------
        McapError, ValueError, KeyError, struct.error
            If the log is damaged.
        """
        summary = self.get_summary()
        if summary is None or not summary.chunk_indexes:
            yield from super().iter_messages(topics, *args, **options)
            return
        wanted = {
            number: (summary.schemas.get(channel.schema_id), channel)
            for number, channel in summary.channels.items()
            if topics is None or channel.topic in topics
        }
        for index in summary.chunk_indexes:
            inside = index.message_index_offsets
            if inside and wanted.keys().isdisjoint(inside):
                continue
            self._stream.seek(index.chunk_start_offset + RECORD.size)
            chunk = Chunk.read(ReadDataStream(self._stream))
            stream, length = get_chunk_data_stream(chunk, validate_crc=self._validate_crcs)
            content = stream.read(length)
            for opcode, begin, end in records(content):
                if opcode != Opcode.MESSAGE:
                    continue
                number, sequence, log_time, publish_time = MESSAGE.unpack_from(content, begin)
                if number in wanted:
                    data = content[begin + MESSAGE.size : end]
                    yield *wanted[number], Message(number, log_time, data, publish_time, sequence)
                elif number not in summary.channels:
                    msg = f"a message is of channel {number}, which the index does not know"
                    raise McapError(msg)
