"""An MDT693's wire: one amplifier on a pty and on TCP at once."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from contextlib import suppress

from fitctl import config
from fitctl.drivers.mdt693.protocol import BITS_PER_BYTE, TERMINATOR
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults, Wire
from fitctl.mocks.mdt693.amplifier import CHANNELS, Amplifier
from fitctl.mocks.mdt693.controller import Controller
from fitctl.mocks.mdt693.line import CommandSplitter, Sender, write_to
from fitctl.mocks.pty import Endpoints, Pty

FAULTS = WIRE_FAULTS | {
    "silent": FaultKind("commands are carried out and not answered: the line back is broken"),
    "limit_switch": FaultKind("the voltage-limit switch is moved", "V", 75.0),
    "saturated_stack": FaultKind(
        "an output stays at its highest voltage, whatever the command", parts=tuple(CHANNELS)
    ),
}


class Mdt693Mock:
    """An MDT693A or MDT693B, whichever the settings say, on a pty and on 127.0.0.1 at once.

    The pty is an RS-232 port, TCP the terminal server before one. Bytes pass at the baud rate both
    ways. What goes wrong on command is in `FAULTS`: while it lasts, `disconnect` closes TCP connections
    at once, and on the pty, whose path must stay, is a pulled cable; `reboot` takes the stacks to 0 V.

    Known limitations
    -----------------
    - The outputs follow their inputs at once: no bandwidth, no current limit, no ripple. What is
      measured of them follows as the settings say.
    - The echo comes with the answer, not byte by byte while the command is typed.
    - Display, knob modes and push-to-turn are numbers that are kept, without effect. Nothing survives
      a restart.
    - An RS-232 line has one client; here pty and TCP clients each get the answers to their own
      commands, one command at a time. A pty's client with another baud rate is not understood; a
      real device would make noise of it.
    - The recorded A sends a NUL after some answers, the mock after none.

    Invented constants
    ------------------
    Serial number and friendly name; the wording of the help text; what `restore` resets (not echo,
    nor compatibility mode), to which values; power-up values; the same errors for a value out of range
    as for an unknown command; commands of at most 64 bytes; the answer to `D`; plain numbers as the
    answers to `msvoltage?`, `sysmin?` and `sysmax?`; arrow keys without an answer of their own but the
    prompt, and their step of 150 V / 65536; zero volts at the external inputs until set; noise and
    settling of what is measured (rig file).

    Parameters
    ----------
    settings : config.Mdt693Mock
    piezo : config.Mdt693Device
        The gain from external input to output; its port is not used.
    on_outputs : callable
        Gets the three stack voltages, once at start and whenever one changes.
    port : int
        TCP port to listen on; 0 for any free port.
    now_s : callable
        The time.

    Attributes
    ----------
    amplifier : Amplifier
    controller : Controller
        The device behind the wire.
    faults : Faults
    """

    def __init__(
        self,
        settings: config.Mdt693Mock,
        piezo: config.Mdt693Device,
        on_outputs: Callable[[Sequence[float]], None],
        *,
        port: int,
        now_s: Callable[[], float] = time.monotonic,
    ) -> None:
        self.amplifier = Amplifier(settings, piezo.gain, on_outputs, now_s)
        self.controller = Controller(settings, self.amplifier)
        self.faults = Faults(FAULTS)
        self.faults.on_change(self._fault_changed)
        self._settings = settings
        self._on_outputs = on_outputs
        self._port = port
        self._busy = asyncio.Lock()
        self._listener: asyncio.Server | None = None
        self._links: dict[asyncio.StreamWriter, asyncio.Task[None] | None] = {}
        self._pty: Pty | None = None
        self._pty_task: asyncio.Task[None] | None = None

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
        reader = asyncio.StreamReader()
        self._pty = pty = Pty(self._settings.baud_rate)
        reader.set_transport(pty)  # which it pauses while much is unread
        pty.read_into(reader.feed_data)
        self._pty_task = asyncio.create_task(
            self._serve(reader, pty.write, pty.is_at_our_baud_rate)
        )
        self._on_outputs(self.amplifier.outputs_v)
        return Endpoints(self._listener.sockets[0].getsockname()[1], pty.path)

    async def stop(self) -> None:
        """Close both ends and wait for what was under way; safe to call twice."""
        self.faults.close()
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        tasks = [task for task in [*self._links.values(), self._pty_task] if task is not None]
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
        self._pty_task = None
        if self._pty is not None:
            self._pty.close()
            self._pty = None

    async def _serve_tcp(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if self.faults.value("disconnect") is not None:
            writer.transport.abort()
            return
        self._links[writer] = asyncio.current_task()
        try:
            # A cancelled task would be reported as a failure by Python 3.11's stream server.
            with suppress(ConnectionError, asyncio.CancelledError):
                await self._serve(reader, lambda data: write_to(writer, data), lambda: True)
        finally:
            del self._links[writer]
            writer.transport.abort()

    async def _serve(
        self,
        reader: asyncio.StreamReader,
        write: Callable[[bytes], None],
        is_understood: Callable[[], bool],
    ) -> None:
        splitter = CommandSplitter()
        sender = Sender(self._settings.baud_rate, write)
        wire = Wire(self.faults, sender.send)
        try:
            while data := await reader.read(1024):
                if wire.dead or not is_understood():
                    splitter.clear()
                    continue
                for command in splitter.feed(data):
                    await self._execute(command, wire)
        finally:
            wire.close()
            sender.close()

    async def _execute(self, command: bytes, wire: Wire) -> None:
        arrival_s = len(command + TERMINATOR) * BITS_PER_BYTE / self._settings.baud_rate
        async with self._busy:
            await asyncio.sleep(arrival_s + self._settings.reply_s)
            if wire.dead:
                return
            answer = self.controller.answer(command.decode("latin-1"))
        if not self.faults.strikes("silent"):
            wire.send(answer.encode("latin-1"))

    def _fault_changed(self, kind: str) -> None:
        if kind == "limit_switch":
            moved_v = self.faults.value("limit_switch")
            self.amplifier.set_switch_v(
                self._settings.limit_switch_v if moved_v is None else moved_v
            )
        elif kind == "saturated_stack":
            hit = [one for one in CHANNELS if self.faults.value("saturated_stack", one) is not None]
            self.amplifier.set_saturated(hit)
        elif kind == "reboot":
            self.amplifier.set_powered(self.faults.value("reboot") is None)
            self.controller.power_up()
        elif kind == "disconnect":
            for writer in self._links:
                writer.transport.abort()
