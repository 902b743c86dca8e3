"""A two-axis Aerotech Ensemble: its ASCII interface on TCP and on a pty, its axes turning motors."""

from __future__ import annotations

import asyncio
from collections import deque
from collections.abc import Callable

from fitctl.config import EnsembleDevice, EnsembleMock, Siderostat
from fitctl.drivers.ensemble.protocol import (
    COMMAND_BYTES_MAX,
    EOS,
    SOFTWARE_LIMITS,
    AxisFault,
    Parameter,
    Reply,
)
from fitctl.mocks.ensemble.axis import HOME_OFFSET, HOME_RAMP_RATE, HOME_SPEED, Axis
from fitctl.mocks.ensemble.commands import Interpreter
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults, Wire
from fitctl.mocks.motors import AXES, AXIS_FAULTS, FaultyMotors, Motors
from fitctl.mocks.pty import Endpoints, Pty
from fitctl.mocks.tcp import Link, TcpServer
from fitctl.mocks.timers import Periodic, Watchdog

FAULTS = (
    WIRE_FAULTS
    | AXIS_FAULTS
    | {
        "following_error": FaultKind(
            "an axis is in position error, after the end of the fault until it is acknowledged",
            parts=AXES,
        )
    }
)
CYCLE_S = 0.002
_FAULT_MASK = 0x50C42FCF | SOFTWARE_LIMITS
"""The newer controllers' default, and the software limits."""
_CAUSES = {
    "amplifier_fault": AxisFault.AMPLIFIER,
    "following_error": AxisFault.POSITION_ERROR,
}


class EnsembleControllerMock:
    """The controller, on 127.0.0.1 and on a pty.

    Commands and their limitations are in ``commands.py`` beside this. A free run goes on until another
    command, a fault or a software limit ends it, also when all clients are gone.

    Known limitations
    -----------------
    - Homed from power-up on, as by a program that a real controller would run then, unless the setting `homed`
      is false.
    - Nothing is connected to the inputs for end of travel and home: AXISSTATUS always has bits 22, 23 and
      24, which are the levels at the pins. With parameter 61 at 0 (active low) they are not active. Set to
      active high, a real controller would fault; this one does not. That bit 24 is pulled high as the other
      two are is inferred from the maker's newer controllers.
    - Bit 31 of AXISSTATUS is set while a fault of the mock presses the emergency stop. Words of real
      controllers in normal use have it set, so its sense may be the other one: nothing may conclude from it.
    - Bit 9 of AXISSTATUS, the direction of the active or last motion, is 1 for positive, as the maker's header
      has it ("clockwise (positive)"). epics-motor's driver takes 1 for negative: with
      ReverseMotionDirection 0 its record shows the opposite direction. Turning a disabled axis by hand
      does not change the bit (unknown).
    - While the computer stands still, the motors keep their last velocity, even if the trajectory ends in this
      time. A position error may follow.
    - No S-curves, no current limits; enabling takes no time.
    - Software limits act on a homed axis only, if FaultMask has their bits, and end a motion if one of
      FaultMaskDecel and FaultMaskDisable has them. So it is on the maker's newer controllers, by their public
      help; for the Ensemble it is unknown. Other bits of the masks have no effect.
    - A software limit ends a motion that leads out with the abort deceleration and a fault; at rest beyond
      a limit an axis can be acknowledged and moved back. The real one may keep the fault there, or move the
      axis inside (parameter 665, FaultAckMoveOutOfLimit): unknown.
    - Any number of clients; the real one's socket takes one. Its answers come at `reply_s` whatever they
      are.
    - The pty has no baud rate.
    - The trajectory stands still while this process does.

    Invented constants
    ------------------
    The controller's cycle and loop gain, its default ramps and speeds, the in-position window, the time over
    which VFBK is the mean of the encoder's velocity, six decimals in every number, and that
    FAULTACK is obeyed though the fault comes back.

    Parameters
    ----------
    siderostat : Siderostat[EnsembleDevice]
        Encoder of the rig.
    settings : EnsembleMock
    motors : Motors
        What it turns.

    Attributes
    ----------
    faults : Faults
    axes : list of Axis
    """

    def __init__(
        self, siderostat: Siderostat[EnsembleDevice], settings: EnsembleMock, motors: Motors
    ) -> None:
        self.faults = Faults(FAULTS)
        self._settings = settings
        self._motors = FaultyMotors(motors, self.faults, siderostat.encoder_counts_per_rev)
        self._units_per_rad = self._motors.counts_per_rad / settings.counts_per_unit
        self._power_up()
        self._server = TcpServer(
            self.faults, lambda: _Link(self._server, self._new_client, settings.idle_timeout_s)
        )
        self._pty: Pty | None = None
        self._pty_client: Client | None = None
        self._cycle = Periodic(self._run_cycle)
        self._stepped_s = 0.0
        self.faults.on_change(self._fault_changed)

    async def start(self) -> Endpoints:
        """Listen, and begin to control.

        Raises
        ------
        OSError
            If the port is taken.
        """
        port = await self._server.start(self._settings.tcp_port)
        self._pty = Pty()
        self._pty_client = self._new_client(Wire(self.faults, self._pty.write))
        self._pty.read_into(self._pty_client.receive)
        self._stepped_s = asyncio.get_running_loop().time()
        self._run_cycle()
        self._cycle.set_period(CYCLE_S)
        return Endpoints(port, self._pty.path)

    async def stop(self) -> None:
        """Take all power, disconnect everyone; safe to call twice."""
        self.faults.close()
        self._power_up()
        self._cycle.set_period(0)
        if self._pty_client is not None:
            self._pty_client.close()
        if self._pty is not None:
            self._pty.close()
            self._pty = None
        await self._server.stop()

    def _new_client(self, wire: Wire) -> Client:
        return Client(wire, self._answer, self._settings.reply_s)

    def _power_up(self) -> None:
        parameters = [self._parameters() for _ in AXES]
        self.axes = [Axis(table, homed=self._settings.homed) for table in parameters]
        self._interpreter = Interpreter(self.axes, parameters, self._settings.axis_names)
        self._powered = [False, False]
        for axis in range(len(AXES)):
            self._motors.set_enabled(axis, False)

    def _parameters(self) -> dict[int, float]:
        """One axis' parameters; those without a name here are read by epics-motor's driver."""
        settings = self._settings
        reverse_direction, limit_setup, home_setup = 1, 61, 75
        return {
            Parameter.COUNTS_PER_UNIT: settings.counts_per_unit,
            Parameter.POSITION_ERROR_THRESHOLD: settings.position_error_units,
            Parameter.SOFTWARE_LIMIT_LOW: -settings.software_limit_units,
            Parameter.SOFTWARE_LIMIT_HIGH: settings.software_limit_units,
            Parameter.FAULT_MASK: float(_FAULT_MASK),
            Parameter.FAULT_MASK_DISABLE: 0.0,
            Parameter.FAULT_MASK_DECEL: float(SOFTWARE_LIMITS),
            Parameter.POSITION_FEEDBACK_TYPE: 1.0,
            Parameter.DEFAULT_RAMP_RATE: 10.0,
            Parameter.ABORT_DECEL_RATE: 1000.0,
            reverse_direction: 0.0,
            limit_setup: 0.0,
            home_setup: 0.0,
            HOME_SPEED: 1.0,
            HOME_OFFSET: 0.0,
            HOME_RAMP_RATE: 10.0,
        }

    def _answer(self, line: str) -> bytes:
        self._step()
        reply, value = self._interpreter.answer(line)
        self._drive()
        ends = value or self._settings.always_send_eos
        return reply.value + value.encode("ascii") + (EOS if ends else b"")

    def _run_cycle(self) -> None:
        self._step()
        self._drive()

    def _step(self) -> None:
        now_s = asyncio.get_running_loop().time()
        period_s = now_s - self._stepped_s
        self._stepped_s = now_s
        for axis, counts in zip(self.axes, self._motors.position_counts(), strict=True):
            axis.step(counts / self._settings.counts_per_unit, period_s)

    def _drive(self) -> None:
        for number, axis in enumerate(self.axes):
            if axis.enabled != self._powered[number]:
                self._powered[number] = axis.enabled
                self._motors.set_enabled(number, axis.enabled)
        if any(self._powered):
            az, el = (axis.motor_velocity / self._units_per_rad for axis in self.axes)
            self._motors.command_velocity_rad_s(az, el)

    def _fault_changed(self, kind: str) -> None:
        if kind == "reboot":
            self._power_up()
        for axis, part in zip(self.axes, AXES, strict=True):
            axis.causes = AxisFault(0)
            for name, cause in _CAUSES.items():
                if self.faults.value(name, part) is not None:
                    axis.causes |= cause


_WAITING_MAX = 1000


class LineSplitter:
    """Bytes in, whole lines out; half a line waits for the rest.

    What is longer than any command is cut one byte beyond that length.
    """

    def __init__(self) -> None:
        self._pending = bytearray()

    def feed(self, data: bytes) -> list[bytes]:
        """Lines that are now complete, without their newline."""
        *whole, rest = data.split(EOS)
        lines = []
        for piece in whole:
            self._add(piece)
            lines.append(bytes(self._pending))
            self._pending.clear()
        self._add(rest)
        return lines

    def clear(self) -> None:
        """Forget half a line."""
        self._pending.clear()

    def _add(self, piece: bytes) -> None:
        self._pending += piece[: COMMAND_BYTES_MAX + 1 - len(self._pending)]


class Client:
    """One client's commands, done one after the other, each answered after the controller's time.

    Parameters
    ----------
    wire : Wire
    answer : callable
        Does a line and gives the bytes of its answer.
    reply_s : float
        From when a command's turn comes until its answer.
    """

    def __init__(self, wire: Wire, answer: Callable[[str], bytes], reply_s: float) -> None:
        self._splitter = LineSplitter()
        self._wire = wire
        self._answer = answer
        self._reply_s = reply_s
        self._waiting: deque[bytes] = deque(maxlen=_WAITING_MAX)
        self._timer: asyncio.TimerHandle | None = None

    def receive(self, data: bytes) -> None:
        """Take what the client sent."""
        if self._wire.dead:
            self._splitter.clear()
            self._waiting.clear()
            return
        self._waiting.extend(line for line in self._splitter.feed(data) if line.strip())
        self._next()

    def close(self) -> None:
        """Forget what is under way."""
        self._waiting.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._wire.close()

    def _next(self) -> None:
        if self._timer is None and self._waiting:
            line = self._waiting.popleft()
            if len(line) > COMMAND_BYTES_MAX:
                answer = Reply.NOT_UNDERSTOOD.value + EOS
            else:
                answer = self._answer(line.decode("ascii", "replace"))
            loop = asyncio.get_running_loop()
            self._timer = loop.call_later(self._reply_s, self._send, answer)

    def _send(self, answer: bytes) -> None:
        self._timer = None
        self._wire.send(answer)
        self._next()


class _Link(Link):
    """One client over TCP; closed after `idle_timeout_s` without a byte."""

    def __init__(
        self, server: TcpServer, new_client: Callable[[Wire], Client], idle_timeout_s: float
    ) -> None:
        super().__init__(server)
        self._new_client = new_client
        self._idle = Watchdog(self._expired, idle_timeout_s)

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        super().connection_made(transport)
        self._client = self._new_client(self.wire)
        self._idle.feed()

    def data_received(self, data: bytes) -> None:
        self._idle.feed()
        self._client.receive(data)

    def connection_lost(self, exc: Exception | None) -> None:
        self._idle.stop()
        self._client.close()
        super().connection_lost(exc)

    def _expired(self) -> None:
        self.transport.close()
