"""The mock drive's object dictionary and its SDO server (CiA 301).

Known limitations: no block transfer (aborted as an unknown command); a transfer that its client leaves
half done waits for the next one instead of timing out.
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
    """The object, or the abort that names what is missing."""
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
    check_length(entry, len(data))
    (value,) = struct.unpack("<" + entry.code, data)
    entry.write(value)


def check_length(entry: Entry, length: int) -> None:
    """Let pass what is exactly as long as the object, or the abort."""
    if length * 8 > entry.bits:
        raise SdoAbortError(AbortCode.TOO_LONG)
    if length * 8 < entry.bits:
        raise SdoAbortError(AbortCode.TOO_SHORT)


class SdoServer:
    """Answers requests on one dictionary; keeps the segmented transfer that is under way."""

    def __init__(self, dictionary: Dictionary) -> None:
        self._dictionary = dictionary
        self._object = (0, 0)
        self._services: dict[int, Callable[[protocol.SdoFrame, bytes], bytes]] = {
            protocol.SDO_UPLOAD: self._upload,
            protocol.SDO_UPLOAD_SEGMENT: self._upload_segment,
            protocol.SDO_DOWNLOAD: self._download,
            protocol.SDO_DOWNLOAD_SEGMENT: self._download_segment,
        }
        self.reset()

    def reset(self) -> None:
        """Forget the transfer that is under way."""
        self._to_send: bytes | None = None
        self._received: bytes | None = None
        self._toggle = 0

    def answer(self, request: bytes) -> bytes | None:
        """The eight bytes to send back; None for a client's abort or a frame of another length."""
        try:
            frame = protocol.decode_sdo(request)
        except ValueError:
            return None
        if frame.command == protocol.SDO_ABORT:
            self.reset()
            return None
        if frame.command & protocol.SDO_SPECIFIER not in _SEGMENTS:
            self.reset()
            self._object = frame.index, frame.subindex
        try:
            service = self._services.get(frame.command & protocol.SDO_SPECIFIER, _refuse)
            return service(frame, request)
        except SdoAbortError as abort:
            self.reset()
            return protocol.encode_sdo(
                protocol.SDO_ABORT, *self._object, struct.pack("<I", abort.code)
            )

    # ------------------------------------------------------------ the client reads
    def _upload(self, _frame: protocol.SdoFrame, _request: bytes) -> bytes:
        data = read(self._dictionary, *self._object)
        if 1 <= len(data) <= 4:
            command = protocol.expedited_command(protocol.SDO_UPLOAD, len(data))
            return protocol.encode_sdo(command, *self._object, data)
        self._to_send = data
        command = protocol.SDO_UPLOAD | protocol.SDO_SIZE_GIVEN
        return protocol.encode_sdo(command, *self._object, struct.pack("<I", len(data)))

    def _upload_segment(self, frame: protocol.SdoFrame, _request: bytes) -> bytes:
        if self._to_send is None:
            raise SdoAbortError(AbortCode.COMMAND_SPECIFIER)
        toggle = self._check_toggle(frame)
        chunk, rest = self._to_send[:7], self._to_send[7:]
        self._to_send = rest or None
        return protocol.encode_segment(chunk, toggle, last=not rest)

    # ------------------------------------------------------------ the client writes
    def _download(self, frame: protocol.SdoFrame, _request: bytes) -> bytes:
        entry = find(self._dictionary, *self._object)
        if entry.write is None:
            raise SdoAbortError(AbortCode.READ_ONLY)
        if frame.command & protocol.SDO_EXPEDITED:
            data = protocol.expedited_data(frame)
            if not frame.command & protocol.SDO_SIZE_GIVEN:
                data = data[: entry.bits // 8]
            write(self._dictionary, *self._object, data)
        else:
            size = protocol.announced_size(frame)
            if size is not None:
                check_length(entry, size)
            self._received = b""
        return protocol.encode_sdo(protocol.SDO_DOWNLOADED, *self._object)

    def _download_segment(self, frame: protocol.SdoFrame, request: bytes) -> bytes:
        if self._received is None:
            raise SdoAbortError(AbortCode.COMMAND_SPECIFIER)
        toggle = self._check_toggle(frame)
        chunk, last = protocol.decode_segment(request)
        self._received += chunk
        if last:
            data, self._received = self._received, None
            write(self._dictionary, *self._object, data)
        elif len(self._received) * 8 > find(self._dictionary, *self._object).bits:
            raise SdoAbortError(AbortCode.TOO_LONG)
        return protocol.encode_sdo(protocol.SDO_SEGMENT_DOWNLOADED | toggle, 0, 0)

    def _check_toggle(self, frame: protocol.SdoFrame) -> int:
        toggle = frame.command & protocol.SDO_TOGGLE
        if toggle != self._toggle:
            raise SdoAbortError(AbortCode.TOGGLE_BIT)
        self._toggle ^= protocol.SDO_TOGGLE
        return toggle


_SEGMENTS = frozenset({protocol.SDO_UPLOAD_SEGMENT, protocol.SDO_DOWNLOAD_SEGMENT})
"""Services that do not name their object."""


def _refuse(_frame: protocol.SdoFrame, _request: bytes) -> bytes:
    raise SdoAbortError(AbortCode.COMMAND_SPECIFIER)
