"""The service's doors: the Unix socket of the owner, and TCP for keys. Each knows who sent what.

A door is read a few frames at a time. What is left waits in ZeroMQ's short queue, then in the kernel's, and
then the sender waits; ZeroMQ takes a message from each connection in turn, so that a flood on one holds up no
other.
"""

from __future__ import annotations

import os
import pwd
import socket
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import NamedTuple

import zmq
from zmq.utils import z85

from fitctl.config import ConfigError, Rig
from fitctl.supervisor.admission import Sender
from fitctl.supervisor.endpoints import (
    COMMAND_SOCKET,
    TELEMETRY_SOCKET,
    keep_alive,
    tcp_endpoint,
)
from fitctl.supervisor.keys import AllowedKey, allowed_keys, keys_signature, server_pair
from fitctl.supervisor.messages import MAX_COMMAND_BYTES

_QUEUED = 64  # messages of one connection
_QUEUED_TELEMETRY = 50
_LINGER_MS = 200
_HANDSHAKE_MS = 5000
FRAMES = 3  # of a command: identity, tag, payload
_ZAP_FRAMES = 7


class Parcel(NamedTuple):
    """One message as it came. `sender` is None when its key has been revoked since it connected."""

    identity: bytes
    tag: bytes
    payload: bytes
    sender: Sender | None


class Door:
    """Commands in and replies out by ROUTER, telemetry out by PUB.

    Parameters
    ----------
    router, publisher : zmq.Socket
        Bound.
    whose : callable
        Who sent a frame.
    """

    def __init__(
        self,
        router: zmq.Socket[bytes],
        publisher: zmq.Socket[bytes] | None,
        whose: Callable[[zmq.Frame], Sender | None],
    ) -> None:
        self.router = router
        self.publisher = publisher
        self._whose = whose
        self._frames: list[zmq.Frame] = []

    def take(self, frames: int) -> list[Parcel]:
        """At most so many frames: the whole messages of the right shape in them.

        Others are thrown away, however many parts they have.
        """
        parcels: list[Parcel] = []
        for _ in range(frames):
            try:
                frame = self.router.recv(zmq.NOBLOCK, copy=False)
            except zmq.Again:
                break
            # One more than there may be is kept, to tell that there are too many.
            self._frames = [*self._frames[:FRAMES], frame]
            if not frame.more:
                whole, self._frames = self._frames, []
                if len(whole) == FRAMES:
                    identity, tag, payload = (bytes(part.buffer) for part in whole)
                    parcels.append(Parcel(identity, tag, payload, self._whose(frame)))
        return parcels

    def answer(self, identity: bytes, tag: bytes, payload: bytes) -> bool:
        """Send a reply; False if whoever asked has gone, or does not read."""
        try:
            self.router.send_multipart([identity, tag, payload], zmq.NOBLOCK)
        except zmq.ZMQError as error:
            if error.errno not in {zmq.EHOSTUNREACH, zmq.EAGAIN}:
                raise
            return False
        return True

    def publish(self, payload: bytes) -> None:
        """Send telemetry to whoever listens."""
        if self.publisher is not None:
            with suppress(zmq.Again):
                self.publisher.send(payload, zmq.NOBLOCK)

    def close(self) -> None:
        """Let go of the sockets."""
        self.router.close()
        if self.publisher is not None:
            self.publisher.close()


def local_door(context: zmq.Context[zmq.Socket[bytes]], folder: Path) -> Door:
    """The Unix sockets; the kernel tells whose process is at the other end."""
    router = router_socket(context)
    router.bind(f"ipc://{folder / COMMAND_SOCKET}")
    publisher = publisher_socket(context)
    publisher.bind(f"ipc://{folder / TELEMETRY_SOCKET}")
    host = socket.gethostname()
    return Door(router, publisher, lambda frame: _local_sender(frame, host))


def router_socket(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
    """A ROUTER with all its limits, not yet bound."""
    router = context.socket(zmq.ROUTER)
    router.setsockopt(zmq.MAXMSGSIZE, MAX_COMMAND_BYTES)
    router.setsockopt(zmq.ROUTER_MANDATORY, 1)  # say when a reply cannot be sent
    router.setsockopt(zmq.RCVHWM, _QUEUED)
    router.setsockopt(zmq.SNDHWM, _QUEUED)
    router.setsockopt(zmq.LINGER, _LINGER_MS)
    return router


def publisher_socket(context: zmq.Context[zmq.Socket[bytes]]) -> zmq.Socket[bytes]:
    """A PUB with all its limits, not yet bound."""
    publisher = context.socket(zmq.PUB)
    publisher.setsockopt(zmq.MAXMSGSIZE, MAX_COMMAND_BYTES)  # of what subscribers send
    publisher.setsockopt(zmq.SNDHWM, _QUEUED_TELEMETRY)
    publisher.setsockopt(zmq.LINGER, _LINGER_MS)
    return publisher


def _local_sender(frame: zmq.Frame, host: str) -> Sender:
    # As libzmq has it of the kernel: HOST:UID:GID:PID. Who hung up at once is unknown, but was the owner.
    parts = _property(frame, "Peer-Address").split(":")
    uid, pid = (int(parts[1]), parts[3]) if len(parts) == 4 else (os.getuid(), "unknown")
    return Sender(f"{_user(uid)}@{host}", f"process {pid}", "commander", is_local=True)


def _property(frame: zmq.Frame, name: str) -> str:
    """What libzmq knows of a frame's connection; empty if it does not."""
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


class KeyedDoor:
    """TCP, encrypted by CURVE, for the allowed keys alone; a context of its own, so that it delays no other.

    Parameters
    ----------
    rig : Rig
    note : callable
        Hears of key files that cannot be used.

    Raises
    ------
    ConfigError
        If the address or the keys cannot be used.
    """

    def __init__(self, rig: Rig, note: Callable[[str], None]) -> None:
        self._rig = rig
        self._note = note
        self._pair = server_pair(rig)
        self._signature: object = None
        self._allowed: dict[str, AllowedKey] = {}
        self._gone: list[str] = []
        self._context = zmq.Context()
        # ZAP, RFC 27: libzmq asks here whether a key may come in. Polled with the rest: unlike pyzmq's
        # authenticator thread, it takes no more of the interpreter than its share when many knock.
        self.zap = self._context.socket(zmq.REP)
        self.zap.bind("inproc://zeromq.zap.01")
        router = self._keyed(router_socket(self._context))
        self.door = Door(router, None, self._whose)
        self._look()
        try:
            self._bind(router, rig.service.command_port)
            self._publish_again()
        except zmq.ZMQError as error:
            self.close()
            msg = (
                f"service.tcp_address: {rig.service.tcp_address}, ports {rig.service.command_port} and "
                f"{rig.service.telemetry_port}, cannot be listened at: {error}; choose others"
            )
            raise ConfigError(msg) from None

    def admit(self, handshakes: int) -> None:
        """Answer at most so many who knock."""
        for _ in range(handshakes):
            try:
                asked = self.zap.recv_multipart(zmq.NOBLOCK)
            except zmq.Again:
                return
            key = ""
            if len(asked) == _ZAP_FRAMES and asked[5] == b"CURVE" and len(asked[6]) == 32:
                key = z85.encode(asked[6]).decode()
            if key not in self._allowed:
                self._look()  # it may be quite new; libzmq's clients do not ask twice
            known = key in self._allowed
            status = (b"200", b"OK") if known else (b"400", b"this key is not allowed")
            user = key.encode() if known else b""
            self.zap.send_multipart([b"1.0", asked[1], *status, user, b""])

    def refresh(self) -> list[str]:
        """Look whether allowed keys have changed; names of those that are no longer what they were.

        Their telemetry is cut: everybody's is, for a moment, and only the allowed can connect again.
        """
        if self.door.publisher is None:
            with suppress(zmq.ZMQError):  # the port is being let go of; the next look will do
                self._publish_again()
        self._look()
        gone, self._gone = self._gone, []
        return gone

    def close(self) -> None:
        """Let go of everything."""
        self.door.close()
        self.zap.close(linger=0)
        self._context.term()

    def _look(self) -> None:
        signature = keys_signature(self._rig)
        if signature == self._signature:
            return
        self._signature = signature
        before, (self._allowed, problems) = self._allowed, allowed_keys(self._rig)
        for problem in problems:
            self._note(problem)
        gone = [key.name for public, key in before.items() if self._allowed.get(public) != key]
        if gone and self.door.publisher is not None:
            self.door.publisher.close(linger=0)
            self.door.publisher = None
        self._gone += gone

    def _whose(self, frame: zmq.Frame) -> Sender | None:
        key = self._allowed.get(_property(frame, "User-Id"))
        if key is None:
            return None
        return Sender(key.name, _property(frame, "Peer-Address"), key.role, is_local=False)

    def _publish_again(self) -> None:
        publisher = self._keyed(publisher_socket(self._context))
        try:
            self._bind(publisher, self._rig.service.telemetry_port)
        except zmq.ZMQError:
            publisher.close(linger=0)
            raise
        self.door.publisher = publisher

    def _keyed(self, bare: zmq.Socket[bytes]) -> zmq.Socket[bytes]:
        bare.curve_server = True
        bare.curve_secretkey = self._pair.secret.encode()
        bare.setsockopt(zmq.ZAP_DOMAIN, b"fitctl")
        bare.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        keep_alive(bare)
        return bare

    def _bind(self, keyed: zmq.Socket[bytes], port: int) -> None:
        endpoint = tcp_endpoint(self._rig.service.tcp_address, port)
        keyed.setsockopt(zmq.IPV6, "[" in endpoint)
        keyed.bind(endpoint)
