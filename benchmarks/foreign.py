"""The simplest servers there are, and simple devices of other people's frameworks, to measure ours beside.

Each listens on the port that it is given until its process ends.
"""

from __future__ import annotations

import asyncio
import tempfile
from typing import cast

ANSWER = b"1.234\n"
QUESTION = b"V?\n"


def tcp_echo(port: int) -> None:
    """Plain asyncio streams: what comes goes back."""

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1024):
            writer.write(data)

    async def serve() -> None:
        async with await asyncio.start_server(echo, "127.0.0.1", port) as server:
            await server.serve_forever()

    asyncio.run(serve())


def udp_echo(port: int) -> None:
    """A plain asyncio datagram endpoint: what comes goes back."""

    class Echo(asyncio.DatagramProtocol):
        def connection_made(self, transport: asyncio.BaseTransport) -> None:
            self.transport = cast(asyncio.DatagramTransport, transport)

        def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
            self.transport.sendto(data, addr)

    async def serve() -> None:
        loop = asyncio.get_running_loop()
        await loop.create_datagram_endpoint(Echo, local_addr=("127.0.0.1", port))
        await asyncio.Event().wait()

    asyncio.run(serve())


def sinstruments(port: int) -> None:
    """A device of sinstruments (gevent) that answers a line with a line."""
    from sinstruments.simulator import BaseDevice, Server

    class Voltmeter(BaseDevice):
        def handle_message(self, message: bytes) -> bytes:
            return ANSWER

    class Entry:
        def load(self) -> type:
            return Voltmeter

    transports = [{"type": "tcp", "url": ["127.0.0.1", port]}]
    device = {"class": "Voltmeter", "name": "v", "transports": transports}
    Server(devices=[device], registry={"Voltmeter": Entry()}).serve_forever()


def tickit(port: int) -> None:
    """A device of tickit with a TCP adapter and one regular-expression command, under its scheduler."""
    from tickit.core.simulation import build_simulation

    with tempfile.NamedTemporaryFile("w", suffix=".yaml") as config:
        config.write(
            f"- type: {__name__}_tickit.Voltmeter\n  name: v\n  inputs: {{}}\n  port: {port}\n"
        )
        config.flush()
        simulation = build_simulation(config.name)
    asyncio.run(simulation.run())
