"""A C-887's wire: one controller, on TCP and on a pty at once."""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable

from fitctl import config
from fitctl.drivers.c887.protocol import LF, GcsError
from fitctl.mocks.c887.controller import COMMAND_BYTES_MAX, Controller
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults, Wire
from fitctl.mocks.pty import Endpoints, Pty
from fitctl.mocks.tcp import Link, TcpServer
from fitctl.model.hexapod_motion import Floats

FAULTS = WIRE_FAULTS | {
    "silent": FaultKind("commands are carried out and not answered: the line back is broken"),
    "moves_stopped": FaultKind("every move is stopped at once, as by another client's STP"),
    "servo_off": FaultKind("the servos are off, and cannot be switched on"),
    "motion_error": FaultKind(
        "a strut does not follow: error 1024, and the servos are off until they are switched on"
    ),
    "stuck": FaultKind("moves are accepted and the platform does not move"),
    "wrong_axis": FaultKind("X and Y are exchanged in every move"),
    "position_offset": FaultKind("the reported X is too large by this", "mm", 1.0),
    "false_error": FaultKind("ERR? answers this number, whatever happened", "error number", 1024.0),
    "reference_lost": FaultKind("all axes lose their reference"),
    "emergency_stop": FaultKind(
        "the emergency stop is pressed: motions end, the servos are off until it is released and they"
        " are switched on"
    ),
}


class C887ControllerMock:
    """A C-887 with a hexapod, on 127.0.0.1 and on a pty; the pty is its RS-232 port.

    Any number of clients; all share one error number. A command acts when it comes, and its answer goes out
    after `reply_s`, answers of one client in order. Clients' leaving stops nothing.

    Known limitations
    -----------------
    - No macros, wave generator, data recorder, coordinate systems (KSD, KEN ...), axes A and B, trajectories of
      points (parameter Trajectory Source), command levels, or anything stored: ``#8`` and ``#9`` answer 0.
    - No struts: every axis moves with its own trapezoid (``fitctl/model/hexapod_motion.py``) to the nanometre,
      without noise, settling or following error. The pivot is kept and has no effect on the motion.
    - All servos are on or off together, and referencing any axis references all.
    - A reference move goes to zero and is over after `reference_s`; it does not look for switches.
    - In a real hexapod the travel of each axis depends on the others by the struts' lengths. Here a pose can be
      reached where the squares of all axes' parts of their travel add up to at most 1.

    Invented constants
    ------------------
    Accelerations (rig file), #24 and STP braking ten times as hard as a move; rotations that VLS slows down
    in proportion; which error numbers follow a wrong count of parameters (24), an axis named twice (22), VLS,
    SPI, NLM, PLM and SSL in motion (93), the emergency stop (500), servos off in motion (none); FRF during FRF
    (no error); the bits of ``#4``; the number of decimals; the texts of ``*IDN?``, ``VER?``, ``HLP?`` and
    ``HPA?``.

    Parameters
    ----------
    settings : C887Mock
    now_s : callable
        The time.

    Attributes
    ----------
    faults : Faults
    platform : Platform
    """

    def __init__(
        self, settings: config.C887Mock, now_s: Callable[[], float] = time.monotonic
    ) -> None:
        self.faults = Faults(FAULTS)
        self.platform = Platform(settings, now_s)
        self._controller = Controller(settings, self.platform)
        self._settings = settings
        self._server = TcpServer(self.faults, lambda: _Link(self._server, self._new_client))
        self._pty: Pty | None = None
        self._pty_client: Client | None = None
        self.faults.on_change(self._fault_changed)

    def pose_at(self, time_s: float) -> Floats:
        """Where the platform really is at a recent time, shape (6,), mm and degrees."""
        return self.platform.true_pose_at(time_s)

    async def start(self) -> Endpoints:
        """Listen on TCP and open a pty.

        Raises
        ------
        OSError
            If the port is taken.
        """
        port = await self._server.start(self._settings.tcp_port)
        self._pty = pty = Pty(self._settings.baud_rate)
        client = self._pty_client = self._new_client(Wire(self.faults, pty.write))
        pty.read_into(lambda data: client.receive(data) if pty.is_at_our_baud_rate() else None)
        return Endpoints(port, pty.path)

    async def stop(self) -> None:
        """Disconnect everyone; safe to call twice."""
        self.faults.close()
        if self._pty_client is not None:
            self._pty_client.close()
        if self._pty is not None:
            self._pty.close()
            self._pty = None
        await self._server.stop()

    def _new_client(self, wire: Wire) -> Client:
        return Client(wire, self._answer, self._settings.reply_s)

    def _answer(self, command: bytes) -> bytes | None:
        answer = self._controller.answer(command)
        if self.faults.value("moves_stopped") is not None and any(self.platform.moving().values()):
            self.platform.stop()
        return None if self.faults.strikes("silent") else answer

    def _fault_changed(self, kind: str) -> None:
        begins = self.faults.value(kind) is not None
        platform = self.platform
        if kind == "reboot":
            platform.power_up()
        elif kind == "reference_lost" and begins:
            platform.stop(GcsError.NONE)
            platform.referenced = False
        elif kind == "moves_stopped" and begins:
            platform.stop()
        elif kind == "stuck":
            platform.stop(GcsError.NONE)
            platform.stuck = begins
        elif kind == "wrong_axis":
            platform.swapped = begins
        elif kind == "position_offset":
            self._controller.position_offset_mm = self.faults.value(kind) or 0.0
        elif kind == "false_error":
            self._controller.false_error = int(self.faults.value(kind) or 0)
        elif kind in _SERVOS_OFF:
            self._take_servos(kind, begins=begins)

    def _take_servos(self, kind: str, *, begins: bool) -> None:
        platform = self.platform
        if begins:
            platform.stop(_SERVOS_OFF[kind])
            platform.servos_on = False
        blocking = [
            number for name, number in _BLOCKING.items() if self.faults.value(name) is not None
        ]
        platform.blocked = blocking[0] if blocking else GcsError.NONE


_SERVOS_OFF = {
    "servo_off": GcsError.NONE,
    "motion_error": GcsError.MOTION_ERROR,
    "emergency_stop": GcsError.EMERGENCY_STOP,
}
_BLOCKING = {
    "emergency_stop": GcsError.EMERGENCY_STOP,
    "servo_off": GcsError.NOT_REFERENCED_OR_SERVO_OFF,
}


_CR = 0x0D


class CommandSplitter:
    """Bytes in, whole commands out; half a line waits for the rest.

    A control character is a command wherever it comes, also within a line; CR is nothing. What is longer
    than any command is cut one byte beyond that length.
    """

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Commands that are now complete: lines without LF, control characters; empty lines are none."""
        commands = []
        for byte in data:
            if byte == LF[0]:
                if self._pending.strip():
                    commands.append(bytes(self._pending))
                self._pending.clear()
            elif byte < ord(" ") and byte != _CR:
                commands.append(bytes([byte]))
            elif len(self._pending) <= COMMAND_BYTES_MAX:
                self._pending.append(byte)
        return commands

    def clear(self) -> None:
        """Forget half a line."""
        self._pending.clear()


class Client:
    """One client: its commands act as they come, its answers go out in order, each after the reply time.

    Parameters
    ----------
    wire : Wire
    answer : callable
        Executes a command and gives the bytes of its answer, or None.
    reply_s : float
    """

    def __init__(self, wire: Wire, answer: Callable[[bytes], bytes | None], reply_s: float) -> None:
        self._splitter = CommandSplitter()
        self._wire = wire
        self._answer = answer
        self._reply_s = reply_s
        self._free_s = 0.0
        self._timers: set[asyncio.TimerHandle] = set()

    def receive(self, data: bytes) -> None:
        """Execute what the client sent."""
        if self._wire.dead:
            self._splitter.clear()
            return
        for command in self._splitter.feed(data):
            answer = self._answer(command)
            if answer is not None:
                self._send_later(answer)

    def close(self) -> None:
        """Forget what is still to be sent."""
        for timer in self._timers:
            timer.cancel()
        self._timers.clear()
        self._wire.close()

    def _send_later(self, answer: bytes) -> None:
        def send() -> None:
            self._timers.discard(timer)
            self._wire.send(answer)

        loop = asyncio.get_running_loop()
        self._free_s = max(self._free_s, loop.time()) + self._reply_s
        timer = loop.call_at(self._free_s, send)
        self._timers.add(timer)


class _Link(Link):
    """One client over TCP."""

    def __init__(self, server: TcpServer, new_client: Callable[[Wire], Client]) -> None:
        super().__init__(server)
        self._new_client = new_client

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._client = self._new_client(self.wire)

    def data_received(self, data: bytes) -> None:
        self._client.receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._client.close()
        super().connection_lost(exc)
