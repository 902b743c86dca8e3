"""The mock drive's object dictionary and its SDO server (CiA 301).

Known limitations: downloads are expedited only (no object is longer than four bytes and writable); no
block transfer.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import AbortCode


class SdoAbortError(Exception):
    """The access is refused; the client is sent the code."""

    def __init__(self, code: AbortCode) -> None:
        super().__init__(protocol.abort_text(code))
        self.code = code


@dataclass(frozen=True, slots=True)
class Entry:
    """One object: how it looks on the wire, how it is read, how it is written.

    Attributes
    ----------
    code : str
        `struct` code of the integer, or ``s`` for text.
    read : callable or None
        Gives the value; None for write-only.
    write : callable or None
        Takes the value, may raise :class:`SdoAbortError`; None for read-only.
    mappable : bool
        May stand in a PDO.
    """

    code: str
    read: Callable[[], Any] | None
    write: Callable[[Any], None] | None = None
    mappable: bool = False

    @property
    def bits(self) -> int:
        """Length on the wire."""
        return 8 * struct.calcsize("<" + self.code)


Dictionary = dict[tuple[int, int], Entry]


def constant(code: str, value: int | str) -> Entry:
    """An object that never changes."""
    return Entry(code, lambda: value)


def find(dictionary: Dictionary, index: int, subindex: int) -> Entry:
    """The object, or the abort that says what is missing."""
    entry = dictionary.get((index, subindex))
    if entry is None:
        known = any(other == index for other, _ in dictionary)
        raise SdoAbortError(AbortCode.NO_SUBINDEX if known else AbortCode.NO_OBJECT)
    return entry


def read(dictionary: Dictionary, index: int, subindex: int) -> bytes:
    """An object's bytes, or the abort."""
    entry = find(dictionary, index, subindex)
    if entry.read is None:
        raise SdoAbortError(AbortCode.WRITE_ONLY)
    value = entry.read()
    return value.encode("ascii") if entry.code == "s" else struct.pack("<" + entry.code, value)


def write(dictionary: Dictionary, index: int, subindex: int, data: bytes) -> None:
    """Set an object from bytes of exactly its length, or the abort."""
    entry = find(dictionary, index, subindex)
    if entry.write is None:
        raise SdoAbortError(AbortCode.READ_ONLY)
    if len(data) * 8 != entry.bits:
        raise SdoAbortError(AbortCode.WRONG_LENGTH)
    (value,) = struct.unpack("<" + entry.code, data)
    entry.write(value)


class SdoServer:
    """Answers requests on one dictionary; keeps the segmented upload that is under way."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._object = (0, 0)
        self._left = b""
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """The eight bytes to send back; None for a client's abort or a frame of another length."""
        try:
            frame = protocol.decode_sdo(request)
        except ValueError:
            return None
        if frame.command == protocol.SDO_ABORT:
            self._left = b""
            return None
        try:
            return self._serve(frame)
        except SdoAbortError as abort:
            self._left = b""
            return protocol.encode_sdo(
                protocol.SDO_ABORT, *self._object, struct.pack("<I", abort.code)
            )

    def _serve(self, frame: protocol.SdoFrame) -> bytes:
        service = frame.command & protocol.SDO_SPECIFIER
        if service == protocol.SDO_UPLOAD_SEGMENT:
            return self._segment(frame.command & protocol.SDO_TOGGLE)
        self._left = b""
        self._object = frame.index, frame.subindex
        if service == protocol.SDO_UPLOAD:
            return self._upload()
        if service == protocol.SDO_DOWNLOAD and frame.command & protocol.SDO_EXPEDITED:
            write(self._dictionary, *self._object, self._sized(frame))
            return protocol.encode_sdo(protocol.SDO_DOWNLOADED, *self._object)
        raise SdoAbortError(AbortCode.COMMAND_SPECIFIER)

    def _sized(self, frame: protocol.SdoFrame) -> bytes:
        """The data of a download, cut to the object where the client gave no size."""
        data = protocol.expedited_data(frame)
        if frame.command & protocol.SDO_SIZE_GIVEN:
            return data
        return data[: find(self._dictionary, frame.index, frame.subindex).bits // 8]

    def _upload(self) -> bytes:
        data = read(self._dictionary, *self._object)
        if 1 <= len(data) <= 4:
            command = protocol.expedited_command(protocol.SDO_UPLOAD, len(data))
            return protocol.encode_sdo(command, *self._object, data)
        self._left, self._toggle = data, 0
        command = protocol.SDO_UPLOAD | protocol.SDO_SIZE_GIVEN
        return protocol.encode_sdo(command, *self._object, struct.pack("<I", len(data)))

    def _segment(self, toggle: int) -> bytes:
        if not self._left:
            raise SdoAbortError(AbortCode.COMMAND_SPECIFIER)
        if toggle != self._toggle:
            raise SdoAbortError(AbortCode.TOGGLE_BIT)
        chunk, self._left = self._left[:7], self._left[7:]
        self._toggle ^= protocol.SDO_TOGGLE
        return protocol.encode_segment(chunk, toggle, last=not self._left)
