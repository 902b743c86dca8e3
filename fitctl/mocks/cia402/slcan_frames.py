"""CAN frames as SLCAN (LAWICEL) lines of ASCII. Source: LAWICEL CANUSB and CAN232 manuals."""

from __future__ import annotations

import re
from typing import NamedTuple

_FRAME = re.compile(
    rb"(?:[tr]([0-7][0-9A-Fa-f]{2})|[TR]([01][0-9A-Fa-f]{7}))([0-8])((?:[0-9A-Fa-f]{2})*)"
)


class CanFrame(NamedTuple):
    """One classic CAN frame.

    Attributes
    ----------
    can_id : int
        11 bits, or 29 if `extended`.
    data : bytes
        Up to eight; empty in a remote frame.
    extended : bool
        29-bit identifier.
    remote_length : int or None
        None for a data frame; the length asked for by a remote frame.
    """

    can_id: int
    data: bytes
    extended: bool = False
    remote_length: int | None = None


def encode_frame(frame: CanFrame, stamp: bytes = b"") -> bytes:
    """A frame as a line, CR included; `stamp` is the time of its receipt where that is wanted."""
    can_id = b"%08X" % frame.can_id if frame.extended else b"%03X" % frame.can_id
    if frame.remote_length is not None:
        kind = b"R" if frame.extended else b"r"
        return b"%b%b%d%b\r" % (kind, can_id, frame.remote_length, stamp)
    kind = b"T" if frame.extended else b"t"
    digits = frame.data.hex().upper().encode()
    return b"%b%b%d%b%b\r" % (kind, can_id, len(frame.data), digits, stamp)


def decode_frame(line: bytes) -> CanFrame:
    """A line, without its CR, as a frame.

    Raises
    ------
    ValueError
        If it is not exactly one frame: wrong digits, or data that do not fit the length.
    """
    match = _FRAME.fullmatch(line)
    if match is None:
        msg = f"not an SLCAN frame: {line!r}"
        raise ValueError(msg)
    standard, extended, length_digit, digits = match.groups()
    length = int(length_digit)
    remote = line[:1] in {b"r", b"R"}
    if len(digits) != (0 if remote else 2 * length):
        msg = f"length {length} does not fit the data of {line!r}"
        raise ValueError(msg)
    return CanFrame(
        int(extended or standard, 16),
        bytes.fromhex(digits.decode()),
        extended is not None,
        length if remote else None,
    )
