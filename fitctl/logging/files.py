"""Opening log files, and what a torn or damaged one means."""

from __future__ import annotations

import contextlib
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import IO

import google.protobuf.message
import zstandard
from mcap.exceptions import McapError
from mcap.writer import MCAP0_MAGIC

from fitctl.logging.errors import LogError

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


@contextlib.contextmanager
def opened(path: Path) -> Iterator[tuple[IO[bytes], bool]]:
    """The file, and whether it was finished."""
    try:
        stream = path.open("rb")
    except OSError as error:
        msg = f"{path}: cannot be opened: {error.strerror}; logs are *.mcap in the rig's logging.folder"
        raise LogError(msg) from error
    with stream:
        if stream.read(len(MCAP0_MAGIC)) != MCAP0_MAGIC:
            msg = f"{path}: is not an MCAP log; name a file that fitctl recorded"
            raise LogError(msg)
        start = stream.tell()
        stream.seek(max(start, path.stat().st_size - len(MCAP0_MAGIC)))
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
            msg = f"{path}: is damaged: {error}; {MEND}"
            raise LogError(msg) from error
