"""What each TCP connection has sent and nobody has read yet; too much of it ends the connection.

libzmq's own limit, a queue's high-water mark, does not serve here. It counts whole messages, so that one of
endlessly many parts fills the memory. And a connection that breaks while its queue is full and a ping waits
behind is an assertion of libzmq 4.3.5 that ends the process (stream_engine_base.cpp: ``_io_error`` is set only
while input is stopped). So the sockets of the network have no such mark (``RCVHWM`` is 0, and input is never
stopped); this is their limit instead, by what the kernel has counted.
"""

from __future__ import annotations

import os
import socket
import struct
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress

import zmq

_SO_COOKIE = 57  # Linux: a number that no other socket has had since the machine started
_BYTES_RECEIVED = struct.Struct("=128xQ")  # of struct tcp_info
_MOST_UNREAD_IN_ALL_BYTES = 64 * 2**20
# CURVE puts each frame into a command: 8 bytes of name, 8 of nonce, 16 of authentication, 1 of flags.
_CURVE_BYTES = 33
_SHORT_BYTES = 255


class Traffic:
    """Limits what connections send ahead; for one thread.

    Parameters
    ----------
    most_unread_bytes : mapping of int to int
        By port of ours, for each connection to it.
    """

    def __init__(self, most_unread_bytes: Mapping[int, int]) -> None:
        self._most_unread_bytes = most_unread_bytes
        self._read: dict[int, int] = {}  # bytes, by cookie
        self._senders: dict[int, str] = {}  # public keys, by cookie

    def count(self, frame: zmq.Frame, sender: str) -> None:
        """Count a frame that was read, of whose connection `sender` is the public key."""
        with suppress(OSError), _borrowed(int(frame.get(zmq.SRCFD))) as connection:
            cookie = _cookie(connection)
            self._read[cookie] = self._read.get(cookie, 0) + _on_the_wire(len(frame.buffer))
            self._senders[cookie] = sender

    def end_excessive(self) -> list[tuple[str, str]]:
        """End the connections that are over the limit.

        Returns
        -------
        list of tuple of str
            Public key of each sender, empty if nothing of it was ever read, and its address.
        """
        unread: list[tuple[int, int, int, int]] = []  # bytes, their limit, descriptor, cookie
        for descriptor in (int(name) for name in os.listdir("/proc/self/fd")):
            with suppress(OSError), _borrowed(descriptor) as connection:
                information = connection.getsockopt(socket.IPPROTO_TCP, socket.TCP_INFO, 136)
                (received,) = _BYTES_RECEIVED.unpack(information)
                limit = self._most_unread_bytes.get(connection.getsockname()[1])
                if limit is not None:
                    cookie = _cookie(connection)
                    unread.append((received - self._read.get(cookie, 0), limit, descriptor, cookie))
        there = {cookie for *_, cookie in unread}
        self._read = {cookie: read for cookie, read in self._read.items() if cookie in there}
        in_all = sum(size for size, *_ in unread)
        ended = []
        for size, limit, descriptor, cookie in sorted(unread, reverse=True):
            if size > limit or in_all > _MOST_UNREAD_IN_ALL_BYTES:
                in_all -= size
                with suppress(OSError), _borrowed(descriptor) as connection:
                    address = connection.getpeername()[0]
                    connection.shutdown(socket.SHUT_RDWR)
                    ended.append((self._senders.get(cookie, ""), address))
        self._senders = {
            cookie: sender for cookie, sender in self._senders.items() if cookie in there
        }
        return ended


def _on_the_wire(payload_bytes: int) -> int:
    """How many bytes ZMTP with CURVE needs for a frame."""
    body = payload_bytes + _CURVE_BYTES
    return body + (2 if body <= _SHORT_BYTES else 9)


def _cookie(connection: socket.socket) -> int:
    return int.from_bytes(connection.getsockopt(socket.SOL_SOCKET, _SO_COOKIE, 8), "little")


@contextmanager
def _borrowed(descriptor: int) -> Iterator[socket.socket]:
    """Libzmq's socket of this descriptor, which stays its own."""
    connection = socket.socket(socket.AF_INET, socket.SOCK_STREAM, 0, descriptor)
    try:
        yield connection
    finally:
        connection.detach()
