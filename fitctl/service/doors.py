"""Doors, through which commands come: read a few frames at a time, with limits on all that they hold.

What is left waits in ZeroMQ's short queue, then in the kernel's, and then the sender waits; ZeroMQ takes a
message from each connection in turn, so that a flood on one holds up no other.
"""

from __future__ import annotations

import os
import pwd
import socket
from collections.abc import Callable
from typing import NamedTuple

import zmq

from fitctl.messages.commands import MAX_COMMAND_BYTES
from fitctl.service.admission import Sender

QUEUED = 64  # messages of one connection
ROUND_MS = 5
MESSAGES_A_ROUND = 8
_QUEUED_TELEMETRY = 50
_LINGER_MS = 200
_FRAMES = 3  # of a message: identity, tag, payload


class Parcel(NamedTuple):
    """One message as it came; `payload` knows of its connection (:func:`frame_property`)."""

    identity: bytes
    tag: bytes
    payload: zmq.Frame


class Door:
    """Messages in and replies out by ROUTER.

    Parameters
    ----------
    router : zmq.Socket
        As from :func:`router_socket`.
    count : callable
        Called with each frame that came over the connection.
    """

    def __init__(
        self, router: zmq.Socket[bytes], count: Callable[[zmq.Frame], None] = lambda _: None
    ) -> None:
        self.router = router
        self._count = count
        self._frames: list[zmq.Frame] = []

    def receive(self, messages: int) -> list[Parcel]:
        """What is in the frames of so many messages, at most.

        What is not of the right shape is thrown away, however many parts it has.
        """
        parcels: list[Parcel] = []
        for _ in range(messages * _FRAMES):
            try:
                frame = self.router.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            if self._frames:  # the first is the identity, which libzmq has put there
                self._count(frame)
            # One more than there may be is kept, to tell that there are too many.
            self._frames = [*self._frames[:_FRAMES], frame]
            if not frame.more:
                whole, self._frames = self._frames, []
                if len(whole) == _FRAMES:
                    identity, tag = (bytes(part.buffer) for part in whole[:2])
                    parcels.append(Parcel(identity, tag, frame))
        return parcels

    def answer(self, identity: bytes, tag: bytes, payload: bytes) -> bool:
        """Send a reply; False if the client has gone, or does not read its replies."""
        try:
            self.router.send_multipart([identity, tag, payload], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno not in {zmq.EHOSTUNREACH, zmq.EAGAIN}:
                raise
            return False
        return True


def router_socket(
    context: zmq.Context[zmq.Socket[bytes]], most_bytes: int = MAX_COMMAND_BYTES
) -> zmq.Socket[bytes]:
    """A ROUTER with all its limits, not yet bound; no part of a message may be longer than `most_bytes`."""
    router = context.socket(zmq.ROUTER)
    router.setsockopt(zmq.MAXMSGSIZE, most_bytes)
    router.setsockopt(zmq.ROUTER_MANDATORY, 1)  # say when a reply cannot be sent
    router.setsockopt(zmq.RCVHWM, QUEUED)
    router.setsockopt(zmq.SNDHWM, QUEUED)
    router.setsockopt(zmq.LINGER, _LINGER_MS)
    return router


def publisher_socket(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
    """A PUB with all its limits, not yet bound."""
    publisher = context.socket(zmq.PUB)
    publisher.setsockopt(zmq.MAXMSGSIZE, MAX_COMMAND_BYTES)  # of what subscribers send
    publisher.setsockopt(zmq.SNDHWM, _QUEUED_TELEMETRY)
    publisher.setsockopt(zmq.LINGER, _LINGER_MS)
    return publisher


def local_sender(payload: zmq.Frame) -> Sender:
    """The process at the other end of a Unix socket, from the kernel."""
    # As libzmq has it of the kernel: HOST:UID:GID:PID. Who hung up at once is unknown, but was the owner.
    parts = frame_property(payload, "Peer-Address").split(":")
    uid, pid = (int(parts[1]), parts[3]) if len(parts) == 4 else (os.getuid(), "unknown")
    return Sender(f"{_user(uid)}@{_host}", f"process {pid}", "commander", is_local=True)


def frame_property(frame: zmq.Frame, name: str) -> str:
    """What libzmq knows of a frame's connection; empty if it knows nothing."""
    try:
        return str(frame.get(name))
    except zmq.ZMQError:
        return ""


def _user(uid: int) -> str:
    if uid not in _users:
        try:
            _users[uid] = pwd.getpwuid(uid).pw_name
        except KeyError:
            _users[uid] = f"user-{uid}"
    return _users[uid]


_users: dict[int, str] = {}
_host = socket.gethostname()
