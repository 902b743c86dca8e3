"""What the gateway tells the supervisor: for whom it speaks, and who may come in.

It has a socket of its own for this (:mod:`fitctl.service.service`); on the socket for everybody these are
no commands.
"""

from __future__ import annotations

import msgspec

from fitctl.logging.records import Severity
from fitctl.messages.keys import AllowedKey, Name, Role
from fitctl.text import UNDECODABLE

MAX_ENVELOPE_BYTES = 1_048_576  # a report of some ten thousand keys


class Passed(msgspec.Struct, frozen=True, kw_only=True, tag=True, forbid_unknown_fields=True):
    """A message as it came, and the owner of its key; no local user can have such a name."""

    name: Name
    role: Role
    address: str
    payload: bytes


class Report(msgspec.Struct, frozen=True, kw_only=True, tag=True, forbid_unknown_fields=True):
    """All keys that may come in, as of now, and what people should know."""

    keys: list[AllowedKey]
    events: list[tuple[Severity, str]]


def decode_envelope(payload: bytes) -> Passed | Report | None:
    """The gateway's message; None if the bytes are no envelope."""
    try:
        return _decode(payload)
    except UNDECODABLE:
        return None


_decode = msgspec.msgpack.Decoder(Passed | Report).decode
