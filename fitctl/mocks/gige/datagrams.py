"""The mock camera's UDP: its faults act on what it sends, and it receives broadcasts on loopback."""

from __future__ import annotations

import asyncio
import contextlib
import socket
import zlib
from collections.abc import Callable
from typing import cast

from fitctl.mocks.faults import Faults, Wire

Address = tuple[str, int]
_BROADCASTS = ("255.255.255.255", "127.255.255.255")
_DATAGRAM_BYTES_MAX = 2048


class Datagrams:
    """A socket's way out.

    On the wire a packet has its destination and a checksum before it, as in UDP. The receiving host
    throws away what was damaged on the way, so that no program ever sees it.

    Parameters
    ----------
    faults : Faults
    sendto : callable
        Takes what does arrive, and where.
    """

    def __init__(self, faults: Faults, sendto: Callable[[bytes, Address], object]) -> None:
        self._sendto = sendto
        self._wire = Wire(faults, self._arrive)

    @property
    def dead(self) -> bool:
        """Nothing goes in or out now."""
        return self._wire.dead

    def send(self, packet: bytes, destination: Address) -> None:
        """Send a packet, or what the faults make of it; never waits."""
        host, port = destination
        body = socket.inet_aton(host) + port.to_bytes(2, "big") + packet
        self._wire.send(zlib.crc32(body).to_bytes(4, "big") + body)

    def close(self) -> None:
        """Forget what is still to be sent."""
        self._wire.close()

    def _arrive(self, datagram: bytes) -> None:
        checksum, body = datagram[:4], datagram[4:]
        if zlib.crc32(body) == int.from_bytes(checksum, "big"):
            destination = socket.inet_ntoa(body[:4]), int.from_bytes(body[4:6], "big")
            self._sendto(body[6:], destination)


class ControlSocket(asyncio.DatagramProtocol):
    """The GVCP socket on 127.0.0.1, and the one that receives DISCOVERY broadcasts; see :func:`listen`."""

    def __init__(self, answer: Callable[[bytes, Address], bytes | None], faults: Faults) -> None:
        self._answer = answer
        self._faults = faults
        self._out: Datagrams | None = None
        self._transport: asyncio.DatagramTransport | None = None
        self._listeners: list[socket.socket] = []
        self._closed = asyncio.get_running_loop().create_future()
        self.port = 0

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The socket is open."""
        self._transport = cast("asyncio.DatagramTransport", transport)
        self._out = Datagrams(self._faults, self._transport.sendto)
        self.port = transport.get_extra_info("sockname")[1]

    def datagram_received(self, data: bytes, addr: Address) -> None:
        """A command came."""
        if self._out is None or self._out.dead:
            return
        reply = self._answer(data, addr)
        if reply is not None:
            self._out.send(reply, addr)

    def connection_lost(self, exc: Exception | None) -> None:
        """The socket is closed."""
        self._closed.set_result(None)

    def hear_broadcasts(self) -> None:
        """Also take what is broadcast on the loopback interface, where the kernel lets us."""
        for address in _BROADCASTS:
            with contextlib.suppress(PermissionError):
                self._hear(address)

    async def close(self) -> None:
        """Close all sockets."""
        loop = asyncio.get_running_loop()
        for listener in self._listeners:
            loop.remove_reader(listener)
            listener.close()
        self._listeners.clear()
        if self._out is not None:
            self._out.close()
        if self._transport is not None:
            self._transport.close()
            await self._closed

    def _hear(self, address: str) -> None:
        listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM | socket.SOCK_NONBLOCK)
        try:
            # Before bind: not for a moment does it hear another interface.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_BINDTODEVICE, b"lo")
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind((address, self.port))
        except BaseException:
            listener.close()
            raise
        self._listeners.append(listener)
        asyncio.get_running_loop().add_reader(listener, self._heard, listener)

    def _heard(self, listener: socket.socket) -> None:
        with contextlib.suppress(BlockingIOError):
            self.datagram_received(*listener.recvfrom(_DATAGRAM_BYTES_MAX))


async def listen(
    answer: Callable[[bytes, Address], bytes | None], faults: Faults, port: int
) -> ControlSocket:
    """Listen on 127.0.0.1, and for broadcasts on the loopback interface.

    Parameters
    ----------
    answer : callable
        What to answer to a datagram of a sender; None for silence.
    faults : Faults
    port : int
        0 for any free one.

    Raises
    ------
    OSError
        If the port is taken.
    """
    loop = asyncio.get_running_loop()
    _, control = await loop.create_datagram_endpoint(
        lambda: ControlSocket(answer, faults), local_addr=("127.0.0.1", port)
    )
    control.hear_broadcasts()
    return control
