"""The TCP side of a mock: any number of clients on 127.0.0.1, cut off by the faults that cut connections."""

from __future__ import annotations

import asyncio
import math
from collections.abc import Callable
from typing import cast

from fitctl.mocks.faults import Faults, Wire


class Link(asyncio.Protocol):
    """One client of a :class:`TcpServer`; a subclass receives its bytes in ``data_received``.

    Attributes
    ----------
    transport : asyncio.Transport
    wire : Wire
        Sends to the client through the device's faults.
    """

    transport: asyncio.Transport
    wire: Wire

    def __init__(self, server: TcpServer) -> None:
        self._server = server

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """The client has connected; a device that is away, or has enough clients, aborts the connection."""
        self.transport = cast(asyncio.Transport, transport)
        self.wire = Wire(self._server.faults, self.write)
        self._server.links.add(self)
        if self._server.faults.away or len(self._server.links) > self._server.clients_max:
            self.transport.abort()

    def write(self, data: bytes) -> None:
        """Send bytes as they are."""
        if not self.transport.is_closing():
            self.transport.write(data)

    # A client that sends and never reads is not read from either, so that nothing piles up.
    def pause_writing(self) -> None:
        """Stop reading: the client does not read."""
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        """Read again."""
        self.transport.resume_reading()

    def connection_lost(self, exc: Exception | None) -> None:
        """The connection is closed."""
        self.wire.close()
        self._server.links.discard(self)


class TcpServer:
    """Listens on 127.0.0.1.

    Parameters
    ----------
    faults : Faults
        With `WIRE_FAULTS` among its kinds; `disconnect` and `reboot` abort all connections.
    new_link : callable
        Makes the protocol of a new connection.
    clients_max : float
        How many connections the device has at once; without a limit by default.

    Attributes
    ----------
    links : set of Link
        The open connections.
    """

    def __init__(
        self, faults: Faults, new_link: Callable[[], Link], clients_max: float = math.inf
    ) -> None:
        self.faults = faults
        self.clients_max = clients_max
        self.links: set[Link] = set()
        self._new_link = new_link
        self._listener: asyncio.Server | None = None
        faults.on_change(self._fault_changed)

    async def start(self, port: int) -> int:
        """Listen on `port`, or on a free one if it is 0; returns the port.

        Raises
        ------
        OSError
            If the port is taken.
        """
        loop = asyncio.get_running_loop()
        self._listener = await loop.create_server(self._new_link, "127.0.0.1", port)
        return int(self._listener.sockets[0].getsockname()[1])

    async def stop(self) -> None:
        """Disconnect every client and stop listening; safe to call twice."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._abort_links()
        await asyncio.sleep(0)  # transports close their sockets on the loop's next turn

    def _fault_changed(self, _kind: str) -> None:
        if self.faults.away:
            self._abort_links()

    def _abort_links(self) -> None:
        for link in list(self.links):
            link.transport.abort()
