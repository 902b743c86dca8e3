"""Process data objects of the mock drive: what is mapped, when it is sent or acted on (CiA 301).

A PDO is configured as on a real drive: out of service (bit 31 of the COB-ID), mapping emptied, filled and
counted, put back. Its objects are looked up once, when its mapping is counted, not at each frame.

Known limitations: no inhibit time, no SYNC start value, no dummy entries, no time limit of an RPDO
(its event timer). Of an RPDO, transmission types 0 to 240 are the same: acted on at the next SYNC.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Any

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import AbortCode
from fitctl.mocks.cia402.dictionary import Dictionary, Entry, SdoAbortError, find

ENTRIES = 8
_CAN_ID = 0x7FF
_EXTENDED = 0x2000_0000
_RESTRICTED = (
    range(0x081),
    range(0x101, 0x181),
    range(0x581, 0x600),
    range(0x601, 0x680),
    range(0x6E0, 0x700),
    range(0x701, 0x800),
)
"""CiA 301: identifiers that no PDO may have."""


class Pdo:
    """One PDO's communication and mapping parameters.

    Parameters
    ----------
    dictionary : dict
        Where mapped objects are found, and where this PDO's own parameters are entered.
    communication, mapping : int
        Indices of its parameters, such as 1800 and 1A00.
    can_id : int
        By the predefined connections.
    sends : bool
        True for a TPDO.
    changed : callable
        Called when it goes into or out of service, or gets another event time.
    """

    def __init__(
        self,
        dictionary: Dictionary,
        communication: int,
        mapping: int,
        can_id: int,
        *,
        sends: bool,
        changed: Callable[[], None],
    ) -> None:
        self._dictionary = dictionary
        self._sends = sends
        self._changed = changed
        self._slots = [0] * ENTRIES
        self._default_cob_id = can_id | protocol.PDO_DISABLED
        dictionary |= {
            (communication, 0): Entry("B", lambda: 5 if sends else 2),
            (communication, 1): Entry("I", lambda: self.cob_id, self._set_cob_id),
            (communication, 2): Entry("B", lambda: self.transmission, self._set_transmission),
            (mapping, 0): Entry("B", lambda: self._count, self._set_count),
        }
        if sends:
            dictionary[communication, 5] = Entry("H", lambda: self.event_ms, self._set_event_ms)
        for slot in range(ENTRIES):
            dictionary[mapping, slot + 1] = self._slot_entry(slot)
        self.reset()

    def reset(self) -> None:
        """As after power-up: out of service, nothing mapped."""
        self.cob_id = self._default_cob_id
        self.transmission = protocol.ON_EVENT
        self.event_ms = 0
        self.received: bytes | None = None
        self.syncs = 0
        self._last: bytes | None = None
        self._sampled: bytes | None = None
        self._count = 0
        self._slots[:] = [0] * ENTRIES
        self._resolve()

    @property
    def in_service(self) -> bool:
        """Sent, or listened to, while the node is operational."""
        return not self.cob_id & protocol.PDO_DISABLED

    @property
    def can_id(self) -> int:
        """The frame's identifier."""
        return self.cob_id & _CAN_ID

    @property
    def on_event(self) -> bool:
        """Sent on change and by its event timer; acted on at once."""
        return self.transmission >= protocol.MAKERS_EVENT

    @property
    def answers_remote(self) -> bool:
        """Sent when a remote frame asks for it."""
        return not self.cob_id & protocol.PDO_NO_RTR

    def due(self) -> bool:
        """Count a SYNC; True if this TPDO is sent at this one."""
        if self.transmission == protocol.ACYCLIC_SYNC:
            return self.changed
        if self.transmission == protocol.RTR_AT_SYNC:
            self._sampled = self.pack()
        self.syncs += 1
        if self.transmission > protocol.LAST_SYNC or self.syncs < self.transmission:
            return False
        self.syncs = 0
        return True

    @property
    def changed(self) -> bool:
        """Its contents differ from the last ones sent."""
        return self.pack() != self._last

    def message(self) -> bytes:
        """The mapped objects' values, to be sent now."""
        self._last = self.pack()
        return self._last

    def remote_answer(self) -> bytes:
        """What a remote frame gets."""
        if self.transmission == protocol.RTR_AT_SYNC:
            return self._sampled or self.message()
        return self.message()

    def pack(self) -> bytes:
        """The mapped objects' values."""
        return self._layout.pack(*[read() for read in self._reads])

    def apply(self, data: bytes) -> bool:
        """Write the mapped objects; False, and nothing written, if the frame is too short."""
        if len(data) < self._layout.size:
            return False
        for write, value in zip(self._writes, self._layout.unpack_from(data), strict=True):
            write(value)
        return True

    def _slot_entry(self, slot: int) -> Entry:
        def write(value: int) -> None:
            if self.in_service or self._count:
                raise SdoAbortError(AbortCode.DEVICE_STATE)
            self._mappable(value)
            self._slots[slot] = value

        return Entry("I", lambda: self._slots[slot], write)

    def _mappable(self, value: int) -> Entry:
        entry = find(self._dictionary, value >> 16, value >> 8 & 0xFF)
        access = entry.read if self._sends else entry.write
        if not entry.mappable or access is None or entry.bits != value & 0xFF:
            raise SdoAbortError(AbortCode.NOT_MAPPABLE)
        return entry

    def _set_count(self, count: int) -> None:
        if self.in_service:
            raise SdoAbortError(AbortCode.DEVICE_STATE)
        if count > ENTRIES or sum(value & 0xFF for value in self._slots[:count]) > 64:
            raise SdoAbortError(AbortCode.MAPPING_TOO_LONG)
        for value in self._slots[:count]:
            self._mappable(value)
        self._count = count
        self._resolve()

    def _resolve(self) -> None:
        entries = [self._mappable(value) for value in self._slots[: self._count]]
        self._layout = struct.Struct("<" + "".join(entry.code for entry in entries))
        self._reads: list[Callable[[], Any]] = [e.read for e in entries if e.read]
        self._writes: list[Callable[[Any], None]] = [e.write for e in entries if e.write]

    def _set_cob_id(self, cob_id: int) -> None:
        if self.in_service and not cob_id & protocol.PDO_DISABLED and cob_id != self.cob_id:
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        goes_into_service = not cob_id & protocol.PDO_DISABLED
        if goes_into_service and (cob_id & _EXTENDED or _is_restricted(cob_id & _CAN_ID)):
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        self.cob_id = cob_id
        self.received = self._last = self._sampled = None
        self.syncs = 0
        self._changed()

    def _set_transmission(self, transmission: int) -> None:
        remote = {protocol.RTR_AT_SYNC, protocol.RTR_ONLY} if self._sends else set()
        known = transmission <= protocol.LAST_SYNC or transmission >= protocol.MAKERS_EVENT
        if not known and transmission not in remote:
            raise SdoAbortError(AbortCode.INVALID_VALUE)
        self.transmission = transmission
        self._changed()

    def _set_event_ms(self, event_ms: int) -> None:
        self.event_ms = event_ms
        self._changed()


def _is_restricted(can_id: int) -> bool:
    return any(can_id in identifiers for identifiers in _RESTRICTED)
