"""The door to the network: TCP, encrypted by CURVE, for the allowed keys alone. The gateway holds it."""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable
from contextlib import suppress

import zmq
from zmq.utils import z85

from fitctl.clock import Clock
from fitctl.config import ConfigError, Rig
from fitctl.messages.endpoints import keep_alive, tcp_endpoint
from fitctl.messages.keys import AllowedKey, allowed_keys, keys_signature, server_pair
from fitctl.service.doors import Door, frame_property, publisher_socket, router_socket
from fitctl.service.intake import Limit
from fitctl.service.traffic import Traffic

_HANDSHAKE_MS = 5000
_ZAP_FRAMES = 7
_MOST_UNREAD_COMMANDS_BYTES = 256 * 1024  # some sixty of the longest commands
_MOST_FROM_SUBSCRIBER_BYTES = 64 * 1024  # one that is ours sends half a kilobyte, once
_CONNECTIONS_PER_S = 10.0  # of one key
_CONNECTIONS_AT_ONCE = 50.0
_BANNED_S = 30.0
_FREED_S = 3.0  # a gateway whose supervisor was killed has let go of its ports by then


class KeyedDoor:
    """Commands in and replies out by ROUTER, telemetry out by PUB.

    Parameters
    ----------
    rig : Rig
    context : zmq.Context
        It answers who may come in for all of its sockets (ZAP).
    report : callable
        Hears of key files that cannot be used, and of keys that are refused for a time.
    clock : Clock

    Attributes
    ----------
    allowed : dict of AllowedKey
        By public key.
    zap : zmq.Socket
        Readable when somebody knocks; then :meth:`admit`.

    Raises
    ------
    ConfigError
        If the address or the keys cannot be used.
    """

    def __init__(
        self,
        rig: Rig,
        context: zmq.Context[zmq.Socket[bytes]],
        report: Callable[[str], None],
        clock: Clock,
    ) -> None:
        self.allowed: dict[str, AllowedKey] = {}
        self._rig = rig
        self._context = context
        self._report = report
        self._clock = clock
        self._connections = Limit(_CONNECTIONS_PER_S, _CONNECTIONS_AT_ONCE)
        self._banned_until_s: dict[str, float] = {}  # by public key
        self._traffic = Traffic(
            {
                rig.service.command_port: _MOST_UNREAD_COMMANDS_BYTES,
                rig.service.telemetry_port: _MOST_FROM_SUBSCRIBER_BYTES,
            }
        )
        self._pair = server_pair(rig)
        self._signature: object = None
        self._publisher: zmq.Socket[bytes] | None = None
        # ZAP, RFC 27: libzmq asks here whether a key may come in. Polled with the rest: unlike pyzmq's
        # authenticator thread, it takes no more than its share when many knock.
        self.zap = context.socket(zmq.REP)
        self.zap.bind("inproc://zeromq.zap.01")
        router = self._keyed(router_socket(context))
        self.door = Door(router, self._count)
        self._look()
        try:
            self._bind(router, rig.service.command_port)
            self._publish_again()
        except zmq.ZMQError as error:
            self.close()
            raise _cannot_listen(rig, str(error)) from None

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
            if key not in self.allowed:
                self._look()  # it may be quite new; libzmq's clients do not ask twice
            if key not in self.allowed:
                status, user = (b"400", b"this key is not allowed"), b""
            elif self._may_connect(key):
                status, user = (b"200", b"OK"), key.encode()
            else:  # which libzmq's clients try again
                status, user = (b"300", b"too many connections of this key"), b""
            self.zap.send_multipart([b"1.0", asked[1], *status, user, b""])

    def _may_connect(self, key: str) -> bool:
        now_s = self._clock.now_s()
        within_limit = self._connections.within(key, now_s)
        return within_limit and now_s >= self._banned_until_s.get(key, 0.0)

    def end_excessive(self) -> list[str]:
        """End connections that send far more than anybody reads, and refuse their keys for a while.

        Returns
        -------
        list of str
            Whose they were: the name of a key, or the address where none is known.
        """
        whose = []
        for public, address in self._traffic.end_excessive():
            key = self.allowed.get(public)
            whose.append(address if key is None else key.name)
            if key is not None:
                self.ban(key)
        return whose

    def ban(self, key: AllowedKey) -> None:
        """Refuse new connections of a key for a while; its open connections stay."""
        now_s = self._clock.now_s()
        if now_s >= self._banned_until_s.get(key.public, 0.0):
            self._banned_until_s[key.public] = now_s + _BANNED_S
            self._report(
                f"the key {key.name} sends far more than fitctl reads; it cannot connect again for "
                f"{_BANNED_S:.0f} s. If this is not a mistake of a program: fitctl keys revoke {key.name}"
            )

    def _count(self, frame: zmq.Frame) -> None:
        self._traffic.count(frame, frame_property(frame, "User-Id"))

    def key_of(self, payload: zmq.Frame) -> AllowedKey | None:
        """Whose message this is; None if the key has been revoked since it connected."""
        return self.allowed.get(frame_property(payload, "User-Id"))

    def publish(self, telemetry: zmq.Frame) -> None:
        """Send telemetry to all subscribers; a slow subscriber misses messages."""
        if self._publisher is not None:
            with suppress(zmq.Again):
                self._publisher.send(telemetry, zmq.NOBLOCK, copy=False)

    def refresh(self) -> None:
        """Look whether the allowed keys have changed.

        If one is no longer what it was, its telemetry is cut: everybody's is, for a moment, and only the
        allowed can connect again.
        """
        if self._publisher is None:
            with suppress(zmq.ZMQError):  # the port is being let go of; the next look will do
                self._publish_again()
        self._look()

    def close(self) -> None:
        """Let go of all sockets."""
        self.door.router.close()
        self.zap.close(linger=0)
        if self._publisher is not None:
            self._publisher.close()

    def _look(self) -> None:
        signature = keys_signature(self._rig)
        if signature == self._signature:
            return
        self._signature = signature
        before, (self.allowed, problems) = self.allowed, allowed_keys(self._rig)
        for problem in problems:
            self._report(problem)
        gone = any(self.allowed.get(public) != key for public, key in before.items())
        if gone and self._publisher is not None:
            self._publisher.close(linger=0)
            self._publisher = None

    def _publish_again(self) -> None:
        publisher = self._keyed(publisher_socket(self._context))
        try:
            self._bind(publisher, self._rig.service.telemetry_port)
        except zmq.ZMQError:
            publisher.close(linger=0)
            raise
        self._publisher = publisher

    def _keyed(self, bare: zmq.Socket[bytes]) -> zmq.Socket[bytes]:
        bare.curve_server = True
        bare.curve_secretkey = self._pair.secret.encode()
        bare.setsockopt(zmq.ZAP_DOMAIN, b"fitctl")
        bare.setsockopt(zmq.HANDSHAKE_IVL, _HANDSHAKE_MS)
        bare.setsockopt(zmq.RCVHWM, 0)  # never stop input: see fitctl.service.traffic
        keep_alive(bare)
        return bare

    def _bind(self, keyed: zmq.Socket[bytes], port: int) -> None:
        endpoint = tcp_endpoint(self._rig.service.tcp_address, port)
        keyed.setsockopt(zmq.IPV6, "[" in endpoint)
        keyed.bind(endpoint)


def check_keyed_door(rig: Rig) -> None:
    """See that a rig that is to be reached by TCP has its keys, and its ports, without keeping these.

    Raises
    ------
    ConfigError
        If not.
    """
    service = rig.service
    if not service.tcp_address:
        return
    server_pair(rig)
    end_s = time.monotonic() + _FREED_S
    for port in (service.command_port, service.telemetry_port):
        while (error := _why_not_bound(service.tcp_address, port)) is not None:
            if error.errno != errno.EADDRINUSE or time.monotonic() > end_s:
                raise _cannot_listen(rig, error.strerror or str(error))
            time.sleep(0.1)


def _why_not_bound(host: str, port: int) -> OSError | None:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    with socket.socket(family) as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as libzmq does
        try:
            probe.bind((host, port))
        except OSError as error:
            return error
    return None


def _cannot_listen(rig: Rig, why: str) -> ConfigError:
    service = rig.service
    return ConfigError(
        f"service.tcp_address: {service.tcp_address}, ports {service.command_port} and "
        f"{service.telemetry_port}, cannot be listened at: {why}; choose others"
    )
