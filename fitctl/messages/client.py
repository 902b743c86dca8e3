"""The other side of the service: what consoles, scripts and the recorder use."""

from __future__ import annotations

import itertools
import socket
import time
from collections import deque
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import TypeVar

import msgspec
import zmq

from fitctl.config import ConfigError
from fitctl.messages.command_table import may_be_too_late
from fitctl.messages.commands import MAX_COMMAND_BYTES, AnyCommand, Reply, Status
from fitctl.messages.endpoints import (
    COMMAND_SOCKET,
    TELEMETRY_SOCKET,
    SocketFolder,
    keep_alive,
    tcp_endpoint,
)
from fitctl.messages.keys import RemoteKey
from fitctl.messages.running import running_rig
from fitctl.messages.telemetry import Telemetry
from fitctl.text import UNDECODABLE, plain, plain_message

REPLY_TIMEOUT_S = 2.0
_REFUSED_TIMEOUT_S = 1.0
_CLOCK_MESSAGES = 100
_FOLDER_PERIOD_S = 0.05  # how soon a folder that comes is found

_T = TypeVar("_T")


class Client:
    """Talks to a running supervisor; reconnects by itself when one comes back.

    Telemetry is received on one thread; commands may be sent from any, each on a socket of its own, so
    that none waits behind another. A socket whose command was answered is kept for the next one.

    On this machine, sockets are reached through the descriptor of a folder that was examined when it was opened
    (:class:`~fitctl.messages.endpoints.SocketFolder`), so whoever answers is this user or root. libzmq does
    not give SO_PEERCRED of the other end to a client that connects, and a second connection would say nothing
    about the first. A folder that has been made anew is examined and opened anew.

    Parameters
    ----------
    where : Path or RemoteKey
        The supervisor's socket folder on this machine, or the key to one elsewhere.
    """

    def __init__(self, where: Path | RemoteKey) -> None:
        self._where = where if isinstance(where, RemoteKey) else SocketFolder(where)
        self._context = zmq.Context()
        self._tags = itertools.count(1)
        self._closed = False
        self._idle: deque[tuple[str, zmq.Socket[bytes]]] = deque()  # with the endpoint of each
        self._ahead_s: deque[float] = deque(maxlen=_CLOCK_MESSAGES)
        self._decode_telemetry = msgspec.msgpack.Decoder(Telemetry).decode
        self._decode_reply = msgspec.msgpack.Decoder(Reply).decode
        self._encode = msgspec.msgpack.Encoder().encode
        self._subscriber = self._socket(zmq.SUB)
        self._subscriber.setsockopt(zmq.RCVHWM, 200)
        self._subscriber.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        self._subscriber.subscribe(b"")
        self._heard_at = ""
        with suppress(ConnectionError):
            self._subscribe()

    @property
    def folder(self) -> Path | None:
        """The supervisor's socket folder; None for a supervisor on another machine."""
        return None if isinstance(self._where, RemoteKey) else self._where.path

    def now_s(self) -> float:
        """The supervisor's time.

        Processes of one machine share their monotonic clock. Another machine's is estimated from what was
        heard last, less what the quickest of it took to come.
        """
        return time.monotonic() + max(self._ahead_s, default=0.0)

    def receive(self, timeout_s: float) -> Telemetry | None:
        """The next telemetry message, or None when none came in time.

        Raises
        ------
        ConnectionError
            If what came cannot be read, and the next message may be readable again; or if the socket folder
            could be another user's.
        """
        if not self._subscriber.poll(int(timeout_s * 1000)):
            self._subscribe()
            return None
        telemetry = _decoded(self._decode_telemetry, self._subscriber.recv(), "telemetry")
        self._hear(telemetry.time_s)
        return telemetry

    def send(self, command: AnyCommand, timeout_s: float = REPLY_TIMEOUT_S) -> Reply:
        """Give a command and wait for its reply; one that is too long is refused here.

        Raises
        ------
        ConnectionError
            If no supervisor answers in time, or its reply cannot be read.
        """
        if may_be_too_late(command):
            if isinstance(self._where, RemoteKey) and not self._ahead_s:
                self.send(Status(), timeout_s)  # its answer has the supervisor's time
            command = msgspec.structs.replace(command, sent_s=self.now_s())
        payload, name = self._encode(command), type(command).__name__
        if len(payload) > MAX_COMMAND_BYTES:
            text = f"{name} takes {len(payload)} bytes; a command may take {MAX_COMMAND_BYTES}: make it shorter"
            return Reply(accepted=False, text=text)
        endpoint, dealer = self._dealer(timeout_s)
        timeout_ms = int(timeout_s * 1000)
        try:
            # A socket that was refused since its last command has no way out; sending would wait for ever.
            dealer.setsockopt(zmq.SNDTIMEO, timeout_ms)
            dealer.send_multipart([next(self._tags).to_bytes(8, "big"), payload])
            if not dealer.poll(timeout_ms):
                raise ConnectionError(self.why_silent(timeout_s))
            _, answer = dealer.recv_multipart()
        except zmq.Again:
            dealer.close()
            raise ConnectionError(self.why_silent(timeout_s)) from None
        except BaseException:  # also Ctrl-C: a socket left open would hold up close()
            dealer.close()
            raise
        self._idle.append((endpoint, dealer))
        if self._closed:
            self._close_idle()
        reply = _decoded(self._decode_reply, answer, f"the reply to {name}")
        self._hear(reply.time_s)
        return reply

    def close(self) -> None:
        """Disconnect."""
        self._closed = True
        self._subscriber.close()
        self._close_idle()
        self._context.term()
        if isinstance(self._where, SocketFolder):
            self._where.close()

    def _close_idle(self) -> None:
        with suppress(IndexError):  # another thread may take the last one
            while True:
                self._idle.pop()[1].close()

    def _dealer(self, timeout_s: float) -> tuple[str, zmq.Socket[bytes]]:
        """A socket for a command, and where it is connected to."""
        endpoint = self._endpoint(COMMAND_SOCKET)
        end_s = time.monotonic() + timeout_s
        while not endpoint:
            if time.monotonic() > end_s:
                raise ConnectionError(self.why_silent(timeout_s))
            time.sleep(_FOLDER_PERIOD_S)
            endpoint = self._endpoint(COMMAND_SOCKET)
        with suppress(IndexError):
            while True:
                idle = self._idle.pop()
                if idle[0] == endpoint:
                    return idle
                idle[1].close()  # of a folder that is no longer there
        dealer = self._socket(zmq.DEALER)
        dealer.connect(endpoint)
        return endpoint, dealer

    def _subscribe(self) -> None:
        """Listen where telemetry comes from now; for the thread that receives."""
        endpoint = self._endpoint(TELEMETRY_SOCKET)
        if endpoint and endpoint != self._heard_at:
            if self._heard_at:
                self._subscriber.disconnect(self._heard_at)
            self._subscriber.connect(endpoint)
            self._heard_at = endpoint

    def _socket(self, kind: int) -> zmq.Socket[bytes]:
        new = self._context.socket(kind)
        new.setsockopt(zmq.LINGER, 0)
        if isinstance(self._where, RemoteKey):
            new.curve_serverkey = self._where.server_public.encode()
            new.curve_publickey = self._where.public.encode()
            new.curve_secretkey = self._where.secret.encode()
            new.setsockopt(zmq.IPV6, ":" in self._where.host)
            keep_alive(new)
        return new

    def _endpoint(self, which: str) -> str:
        """Where a socket of the supervisor is now; empty while there is no folder.

        Raises
        ------
        ConnectionError
            If the folder could be another user's.
        """
        where = self._where
        if isinstance(where, RemoteKey):
            port = where.command_port if which == COMMAND_SOCKET else where.telemetry_port
            return tcp_endpoint(where.host, port)
        try:
            return where.endpoint(which)
        except ConfigError as error:
            raise ConnectionError(str(error)) from None

    def _hear(self, time_s: float) -> None:
        """Learn from a message how far the supervisor's clock is ahead, at least."""
        if isinstance(self._where, RemoteKey):
            self._ahead_s.append(time_s - time.monotonic())

    def why_silent(self, timeout_s: float) -> str:
        """Why nothing comes from the supervisor, and the next step."""
        where = self._where
        if not isinstance(where, RemoteKey):
            running = running_rig(where.path)
            if running is not None:
                return (
                    f"the supervisor (process {running.pid}) runs, but did not answer within {timeout_s:g} s; "
                    f"if it stays silent, end it with kill -KILL {running.pid}, and start it again"
                )
            return (
                f"no supervisor answers at {where.path} within {timeout_s:g} s; start one with fitctl run and "
                "the same --rig"
            )
        place = f"{where.host} port {where.command_port}"
        if self._is_refused():
            return (
                f"{place} does not let the key {where.name} in; was it revoked, or the server given a new "
                "key? Ask the rig's owner for: fitctl keys new"
            )
        return (
            f"no supervisor answers at {place} within {timeout_s:g} s; see that rig {where.rig} runs with "
            "service.tcp_address, and that nothing between blocks its ports"
        )

    def nobody_listens(self) -> bool:
        """Whether a supervisor on another machine has left its port; False if that machine does not answer."""
        where = self._where
        if not isinstance(where, RemoteKey):
            return False
        try:
            with socket.create_connection((where.host, where.command_port), _REFUSED_TIMEOUT_S):
                return False
        except ConnectionRefusedError:
            return True
        except OSError:
            return False

    def _is_refused(self) -> bool:
        """Whether there is a server that ends the handshake."""
        refusals = (
            zmq.EVENT_HANDSHAKE_FAILED_AUTH
            | zmq.EVENT_HANDSHAKE_FAILED_PROTOCOL
            | zmq.EVENT_HANDSHAKE_FAILED_NO_DETAIL
        )
        with self._socket(zmq.DEALER) as dealer, dealer.get_monitor_socket(refusals) as monitor:
            dealer.connect(self._endpoint(COMMAND_SOCKET))
            refused = bool(monitor.poll(int(_REFUSED_TIMEOUT_S * 1000)))
            dealer.disable_monitor()
        return refused


def _decoded(decode: Callable[[bytes], _T], payload: bytes, what: str) -> _T:
    try:
        return plain_message(decode(payload))
    except UNDECODABLE as error:
        msg = f"{what} ({plain(str(error))}) is unreadable; is the supervisor of another version of fitctl?"
        raise ConnectionError(msg) from error
