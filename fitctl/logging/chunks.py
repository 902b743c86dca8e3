"""The records within a chunk of a log.

(MCAP specification, "Records" and "Message".)
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

RECORD = struct.Struct("<BQ")
"""Begins each record: opcode, length of what follows."""
MESSAGE = struct.Struct("<HIQQ")
"""Begins a message: channel, sequence, log time, publish time, in ns; then its data."""


def records(content: bytes) -> Iterator[tuple[int, int, int]]:
    """Opcode of each record of a chunk, and where the record's own part begins and ends.

    Raises
    ------
    struct.error
        If the chunk ends within the beginning of a record.
    """
    at = 0
    while at < len(content):
        opcode, size = RECORD.unpack_from(content, at)
        begin, at = at + RECORD.size, at + RECORD.size + size
        yield opcode, begin, at
