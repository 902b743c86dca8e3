"""The other side of the service: what consoles, scripts and the recorder use."""

from __future__ import annotations

import itertools
import time
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import msgspec
import zmq

from fitctl.supervisor.endpoints import COMMAND_SOCKET, TELEMETRY_SOCKET
from fitctl.supervisor.messages import AnyCommand, Reply, Telemetry

REPLY_TIMEOUT_S = 2.0

_T = TypeVar("_T")


class Client:
    """Talks to a running supervisor; reconnects by itself when one comes back.

    Telemetry is received on one thread; commands may be sent from any, each on a socket of its own, so
    that none waits behind another.

    Parameters
    ----------
    folder : Path
        The supervisor's socket folder.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._context = zmq.Context()
        self._tags = itertools.count(1)
        self._decode_telemetry = msgspec.msgpack.Decoder(Telemetry).decode
        self._decode_reply = msgspec.msgpack.Decoder(Reply).decode
        self._encode = msgspec.msgpack.Encoder().encode
        self._subscriber = self._context.socket(zmq.SUB)
        self._subscriber.setsockopt(zmq.RCVHWM, 200)
        self._subscriber.setsockopt(zmq.LINGER, 0)
        self._subscriber.setsockopt(zmq.RECONNECT_IVL_MAX, 500)
        self._subscriber.subscribe(b"")
        self._subscriber.connect(f"ipc://{folder / TELEMETRY_SOCKET}")

    @staticmethod
    def now_s() -> float:
        """The supervisor's time: processes of one machine share their monotonic clock."""
        return time.monotonic()

    def receive(self, timeout_s: float) -> Telemetry | None:
        """The next telemetry message, or None when none came in time.

        Raises
        ------
        ConnectionError
            If what came cannot be read; the next message may be readable again.
        """
        if not self._subscriber.poll(int(timeout_s * 1000)):
            return None
        return _decoded(self._decode_telemetry, self._subscriber.recv(), "telemetry")

    def send(self, command: AnyCommand, timeout_s: float = REPLY_TIMEOUT_S) -> Reply:
        """Give a command and wait for its reply.

        Raises
        ------
        ConnectionError
            If no supervisor answers in time, or its reply cannot be read.
        """
        tag = next(self._tags).to_bytes(8, "big")
        with self._context.socket(zmq.DEALER) as dealer:
            dealer.setsockopt(zmq.LINGER, 0)
            dealer.connect(f"ipc://{self._folder / COMMAND_SOCKET}")
            dealer.send_multipart([tag, self._encode(command)])
            if not dealer.poll(int(timeout_s * 1000)):
                msg = (
                    f"no supervisor answers at {self._folder} within {timeout_s:g} s; "
                    "start one with: fitctl run"
                )
                raise ConnectionError(msg)
            _, payload = dealer.recv_multipart()
        return _decoded(self._decode_reply, payload, f"the reply to {type(command).__name__}")

    def close(self) -> None:
        """Disconnect."""
        self._subscriber.close()
        self._context.term()


def _decoded(decode: Callable[[bytes], _T], payload: bytes, what: str) -> _T:
    try:
        return decode(payload)
    except (msgspec.MsgspecError, UnicodeDecodeError) as error:
        msg = f"{what} ({error}) is unreadable; is the supervisor of another version of fitctl?"
        raise ConnectionError(msg) from error
