"""Opening log files, and what a torn or damaged one means."""

from __future__ import annotations

import contextlib
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import IO, TypeVar

import google.protobuf.message
import lz4.frame
import mcap.stream_reader
import zstandard
from mcap.exceptions import McapError
from mcap.records import Channel, Schema
from mcap.writer import MCAP0_MAGIC

from fitctl.files import open_regular
from fitctl.logging.errors import LogError, NoLogError

# What a torn or damaged file makes the reader, its decompressors (lz4: RuntimeError) and protobuf (a schema
# that is none: TypeError) raise.
DAMAGE = (
    McapError,
    struct.error,
    ValueError,
    TypeError,
    RuntimeError,
    KeyError,
    google.protobuf.message.DecodeError,
    zstandard.ZstdError,
    OSError,  # an offset that is nonsense
    MemoryError,  # and such a length
    OverflowError,
)
MEND = "`fitctl log recover` saves what is sound into a new file"
COPY = "copy"
"""Name of the metadata that a log has which was made from others."""
RECOVERED = "recovered"
"""In that metadata, the name of the file that such a log was recovered from, as `fitctl.text.plain` has it."""


# A chunk is logging.chunk_bytes and a record, at most; a few kilobytes can unpack to gigabytes.
_MOST_CHUNK_BYTES = 64 << 20
_MOST_DESCRIBED_BYTES = 16 << 20


def _too_large() -> McapError:
    return McapError(f"a chunk unpacks to more than {_MOST_CHUNK_BYTES >> 20} MiB")


def _unpack_zstd(data: bytes, size: int) -> bytes:
    if max(size, zstandard.frame_content_size(data)) > _MOST_CHUNK_BYTES:
        raise _too_large()
    return zstandard.ZstdDecompressor().decompress(data, max_output_size=size)


def _unpack_lz4(data: bytes) -> bytes:
    reader = lz4.frame.LZ4FrameDecompressor()
    unpacked: bytes = reader.decompress(data, max_length=_MOST_CHUNK_BYTES + 1)
    if len(unpacked) > _MOST_CHUNK_BYTES:
        raise _too_large()
    if not reader.eof:
        msg = "a chunk's lz4 frame is cut off"
        raise McapError(msg)
    return unpacked


_Kept = TypeVar("_Kept", bound=Schema | Channel)


class Described(dict[int, _Kept]):
    """A log's schemas or channels by number: the first of each number, and of at most 16 MiB together.

    Those of fitctl have less than 100 kB. They stay in memory as long as the log is read, and a chunk of a few
    kilobytes may unpack to hundreds of megabytes of them.
    """

    def __init__(self, path: Path) -> None:
        super().__init__()
        self._path = path
        self._bytes = 0

    def __setitem__(self, number: int, record: _Kept) -> None:
        if number in self:
            return
        parts = vars(record).values()
        self._bytes += sum(len(part if isinstance(part, bytes) else str(part)) for part in parts)
        if self._bytes > _MOST_DESCRIBED_BYTES:
            msg = (
                f"{self._path}: has schemas or channels of more than {_MOST_DESCRIBED_BYTES >> 20} MiB; "
                "expected a log that fitctl recorded"
            )
            raise LogError(msg)
        super().__setitem__(number, record)


# The one place of the library at which every reader unpacks; it knows no limit of its own.
vars(mcap.stream_reader).update(
    zstandard=SimpleNamespace(decompress=_unpack_zstd), lz4=SimpleNamespace(decompress=_unpack_lz4)
)


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[IO[bytes], bool]]:
    """The file, and whether it was finished."""
    try:
        stream = open_regular(path)
    except OSError as error:
        msg = f"{path}: cannot be opened: {error.strerror}; logs are *.mcap in the rig's logging.folder"
        raise LogError(msg) from error
    with stream:
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            msg = f"{path}: is not an MCAP log; name a file that fitctl recorded"
            raise NoLogError(msg)
        start = stream.tell()
        stream.seek(max(start, os.fstat(stream.fileno()).st_size - len(MCAP0_MAGIC)))
        finished = stream.read() == MCAP0_MAGIC
        stream.seek(0)
        yield stream, finished


@contextlib.contextmanager
def up_to_the_tear(path: Path, finished: bool) -> Iterator[None]:
    """Damage ends a cut file; in a finished file it is an error."""
    try:
        yield
    except DAMAGE as error:
        if finished:
            msg = f"{path}: {damaged(error)}"
            raise LogError(msg) from error


def damaged(error: Exception) -> str:
    """What is wrong with a log that made a reader raise this, also where the error itself has no words."""
    words = str(error)
    if not words or isinstance(error, KeyError):  # whose words are only the key
        words = (
            f"its records do not fit together ({' '.join([type(error).__name__, words]).strip()})"
        )
    return f"is damaged: {words}; {MEND}"
