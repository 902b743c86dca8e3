"""An MDT693's wire: one amplifier on a pty and on TCP at once."""

from __future__ import annotations

import asyncio
import os
import tty
from collections.abc import Awaitable, Callable, Coroutine, Sequence
from contextlib import suppress
from dataclasses import dataclass

from fitctl import config
from fitctl.drivers.mdt693.protocol import ACKNOWLEDGED, NOT_DEFINED, REFUSED, TERMINATOR
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.mdt693.device import COMMAND_BYTES_MAX, Amplifier, CommandError, Dialect

FAULTS = dict(WIRE_FAULTS)
_GARBAGE = b"\xfe[ 1\x00?\r"  # as a wrong baud rate would look


@dataclass(frozen=True, slots=True)
class Endpoints:
    """Where the mock can be spoken to."""

    tcp_port: int
    pty_path: str


class CommandSplitter:
    """Bytes in, whole commands out; half a command waits for the rest."""

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Commands that are now complete, without CR and still with their LFs.

        What is longer than any command is cut one byte beyond that length, so that a flood without
        CR needs no memory and is still too long.
        """
        *ends, rest = data.split(TERMINATOR)
        commands = []
        for end in ends:
            self._keep(end)
            commands.append(bytes(self._pending))
            self._pending.clear()
        self._keep(rest)
        return commands

    def _keep(self, data: bytes) -> None:
        self._pending += data[: COMMAND_BYTES_MAX + 1 - len(self._pending)]


class Mdt693Mock:
    """An MDT693A or MDT693B, whichever the settings say, on a pty and on 127.0.0.1 at once.

    Fails on command: `silent`, `garbled`, :meth:`drop_links`, and `amplifier.set_limit_switch_v`.

    Known limitations
    -----------------
    - The output follows its inputs at once: no bandwidth, no current limit, no ripple; the measured
      voltages are exact to their 0.1 V.
    - The echo comes with the answer, not byte by byte while the command is typed.
    - Of the 693B it lacks intensity, friendly name, master scan, dacstep, sysmin and sysmax, rotary
      mode and push disable, arrow keys, and the front panel. Nothing survives a restart.
    - An RS-232 line has one client; here pty and TCP clients each get the answers to their own
      commands, one command at a time. The pty has no baud rate and cannot be unplugged.

    Invented constants
    ------------------
    The identity's lines but model and firmware; what `restore` resets; `CMD_NOT_DEFINED>` also for
    a value out of range; commands of at most 64 bytes; firmware 1 speaks as recorded from 1.05 and
    every other one as the manual describes firmware 2; zero volts at the external inputs until told.

    Parameters
    ----------
    settings : config.Mdt693Mock
        Model, firmware, voltage-limit switch, time to answer.
    piezo : config.Mdt693Device
        The gain from external input to output; its port is not used.
    on_outputs : callable
        Gets the three stack voltages, once at start and whenever one changes.
    port : int
        TCP port to listen on; 0 for any free port.
    dialect : Dialect or None
        To speak as another firmware of the B; None for that of `settings.firmware`.

    Attributes
    ----------
    amplifier : Amplifier
        The device behind the wire.
    silent : bool
        Neither act on commands nor answer them.
    garbled : bool
        Answer with noise.
    """

    def __init__(
        self,
        settings: config.Mdt693Mock,
        piezo: config.Mdt693Device,
        on_outputs: Callable[[Sequence[float]], None],
        *,
        port: int,
        dialect: Dialect | None = None,
    ) -> None:
        self.amplifier = Amplifier(settings, piezo, on_outputs, dialect)
        self.faults = Faults(FAULTS)
        self.silent = False
        self.garbled = False
        self._reply_s = settings.reply_s
        self._on_outputs = on_outputs
        self._port = port
        self._busy = asyncio.Lock()
        self._listener: asyncio.Server | None = None
        self._links: dict[asyncio.StreamWriter, asyncio.Task[None] | None] = {}
        self._pty: _Pty | None = None

    def set_external_input_v(self, volts: Sequence[float]) -> None:
        """The D/A's three outputs, at the external inputs; acts on the stacks before it returns."""
        self.amplifier.set_external_input_v(volts)

    async def start(self) -> Endpoints:
        """Listen on TCP, open a pty, and give the plant its first stack voltages.

        Raises
        ------
        OSError
            If the port is taken.
        """
        self._listener = await asyncio.start_server(self._serve_tcp, "127.0.0.1", self._port)
        self._pty = await _Pty.open(self._serve)
        self._on_outputs(self.amplifier.outputs_v)
        return Endpoints(self._listener.sockets[0].getsockname()[1], self._pty.path)

    async def stop(self) -> None:
        """Close both ends and wait for what was under way; safe to call twice."""
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        tasks = [task for task in self._links.values() if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        if self._pty is not None:
            await self._pty.close()
            self._pty = None

    def drop_links(self) -> None:
        """Close every TCP connection, as a terminal server does that restarts."""
        for writer in self._links:
            writer.transport.abort()

    async def _serve_tcp(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        async def send(data: bytes) -> None:
            writer.write(data)
            await writer.drain()

        self._links[writer] = asyncio.current_task()
        try:
            # A cancelled task would be reported as a failure by Python 3.11's stream server.
            with suppress(ConnectionError, asyncio.CancelledError):
                await self._serve(reader, send)
        finally:
            del self._links[writer]
            writer.transport.abort()

    async def _serve(
        self, reader: asyncio.StreamReader, send: Callable[[bytes], Awaitable[None]]
    ) -> None:
        splitter = CommandSplitter()
        while data := await reader.read(1024):
            for command in splitter.feed(data):
                if self.silent:
                    continue
                async with self._busy:
                    await asyncio.sleep(self._reply_s)
                    answer = self._answer(command)
                await send(answer)

    def _answer(self, command: bytes) -> bytes:
        if self.garbled:
            return _GARBAGE
        amplifier = self.amplifier
        echo = command + TERMINATOR if amplifier.echo else b""
        try:
            body = amplifier.execute(command.replace(b"\n", b"").decode("ascii", "replace"))
        except CommandError:
            return echo + (REFUSED if amplifier.speaks_a else NOT_DEFINED).encode("ascii")
        if body:
            # Firmware 1.05 was recorded with a second star, before the answer, while echo was on.
            lead = ACKNOWLEDGED if echo and amplifier.prompt == ACKNOWLEDGED else ""
            body = f"{lead}{body}\r"
        return echo + (body + amplifier.prompt).encode("ascii")


class _Pty:
    """A raw pty whose far end is given to clients by its path."""

    def __init__(self, master: int, slave: int) -> None:
        self.path = os.ttyname(slave)
        self._master = master
        self._slave = slave  # kept open, so that the master sees no error when a client leaves
        self._transport: asyncio.ReadTransport | None = None
        self._task: asyncio.Task[None] | None = None

    @classmethod
    async def open(
        cls,
        serve: Callable[
            [asyncio.StreamReader, Callable[[bytes], Awaitable[None]]], Coroutine[None, None, None]
        ],
    ) -> _Pty:
        master, slave = os.openpty()
        tty.setraw(slave)
        self = cls(master, slave)
        reader = asyncio.StreamReader()
        loop = asyncio.get_running_loop()
        self._transport, _ = await loop.connect_read_pipe(
            lambda: asyncio.StreamReaderProtocol(reader), os.fdopen(master, "rb", buffering=0)
        )
        self._task = loop.create_task(serve(reader, self._send))
        return self

    async def _send(self, data: bytes) -> None:
        # Without flow control, what nobody reads is lost.
        with suppress(BlockingIOError):
            os.write(self._master, data)

    async def close(self) -> None:
        if self._task is not None:
            self._task.cancel()
            await asyncio.gather(self._task, return_exceptions=True)
        if self._transport is not None:
            self._transport.close()
            await asyncio.sleep(0)  # the transport closes the master on the loop's next turn
        os.close(self._slave)
