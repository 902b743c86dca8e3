"""A two-axis Aerotech Ensemble: its ASCII interface on TCP and on a pty, its axes turning motors."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import cast

from fitctl.config import EnsembleDevice, EnsembleMock, Siderostat
from fitctl.drivers.ensemble.protocol import EOS, AxisFault, Parameter
from fitctl.mocks.ensemble.axis import Axis
from fitctl.mocks.ensemble.commands import Interpreter
from fitctl.mocks.ensemble.line import Client
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.motors import AXES, AXIS_FAULTS, FaultyMotors, Motors
from fitctl.mocks.pty import Endpoints, Pty
from fitctl.mocks.timers import Periodic, Watchdog

FAULTS = (
    WIRE_FAULTS
    | AXIS_FAULTS
    | {
        "following_error": FaultKind(
            "an axis is in position error; when this has ended, until it is acknowledged",
            parts=AXES,
        )
    }
)
CYCLE_S = 0.002
_LONGEST_STEP_S = 0.02
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
    - No end-of-travel or emergency stop inputs, no homing, no S-curves, no current limits; enabling
      takes no time. A software limit ends a move with the abort deceleration and a fault.
    - Any number of clients; the real one's socket takes one. Its answers come at `reply_s` whatever they
      are.
    - The pty has no baud rate.
    - The trajectory stands still while this process does.

    Invented constants
    ------------------
    The controller's cycle and loop gain, its default ramp and speed, the in-position window, six decimals
    in every number, and that FAULTACK is obeyed though the fault comes back.

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
        self._listener: asyncio.Server | None = None
        self.links: set[_Link] = set()
        self._pty: Pty | None = None
        self._pty_client: Client | None = None
        self._cycle = Periodic(self._run_cycle)
        self._stepped_s = 0.0
        self.faults.on_change(self._take_fault)

    async def start(self) -> Endpoints:
        """Listen, and begin to control.

        Raises
        ------
        OSError
            If the port is taken.
        """
        loop = asyncio.get_running_loop()
        self._listener = await loop.create_server(
            lambda: _Link(self), "127.0.0.1", self._settings.tcp_port
        )
        self._pty = Pty()
        self._pty_client = self.new_client(self._pty.write)
        self._pty.read_into(self._pty_client.receive)
        self._stepped_s = loop.time()
        self._run_cycle()
        self._cycle.set_period(CYCLE_S)
        return Endpoints(self._listener.sockets[0].getsockname()[1], self._pty.path)

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
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._abort_links()
        await asyncio.sleep(0)  # transports close their sockets on the loop's next turn

    def new_client(self, write: Callable[[bytes], None]) -> Client:
        """What serves a connection."""
        return Client(self.faults, self._answer, self._settings.reply_s, write)

    @property
    def idle_timeout_s(self) -> float:
        """A connection is closed after so long without a byte."""
        return self._settings.idle_timeout_s

    def _power_up(self) -> None:
        parameters = [self._parameters() for _ in AXES]
        self.axes = [Axis(table) for table in parameters]
        self._interpreter = Interpreter(self.axes, parameters, self._settings.axis_names)
        self._powered = [False, False]
        for axis in range(len(AXES)):
            self._motors.set_enabled(axis, False)

    def _parameters(self) -> dict[int, float]:
        """One axis' parameters; those without a name here are read by epics-motor's driver."""
        settings = self._settings
        reverse_direction, limit_setup, home_setup, home_offset = 1, 61, 75, 77
        return {
            Parameter.COUNTS_PER_UNIT: settings.counts_per_unit,
            Parameter.POSITION_ERROR_THRESHOLD: settings.position_error_units,
            Parameter.SOFTWARE_LIMIT_LOW: -settings.software_limit_units,
            Parameter.SOFTWARE_LIMIT_HIGH: settings.software_limit_units,
            Parameter.POSITION_FEEDBACK_TYPE: 1.0,
            Parameter.DEFAULT_RAMP_RATE: 10.0,
            Parameter.ABORT_DECEL_RATE: 1000.0,
            reverse_direction: 0.0,
            limit_setup: 0.0,
            home_setup: 0.0,
            home_offset: 0.0,
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
        period_s = min(now_s - self._stepped_s, _LONGEST_STEP_S)
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

    def _take_fault(self, kind: str) -> None:
        if kind == "reboot":
            self._power_up()
        for axis, part in zip(self.axes, AXES, strict=True):
            axis.causes = AxisFault(0)
            for name, cause in _CAUSES.items():
                if self.faults.value(name, part) is not None:
                    axis.causes |= cause
        if self.faults.away:
            self._abort_links()

    def _abort_links(self) -> None:
        for link in list(self.links):
            link.transport.abort()


class _Link(asyncio.Protocol):
    """One client over TCP."""

    transport: asyncio.Transport

    def __init__(self, controller: EnsembleControllerMock) -> None:
        self._controller = controller

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._client = self._controller.new_client(self.write)
        self._controller.links.add(self)
        self._idle = Watchdog(self.transport.close, self._controller.idle_timeout_s)
        self._idle.feed()
        if self._controller.faults.away:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        self._idle.feed()
        self._client.receive(data)

    def write(self, data: bytes) -> None:
        """Send."""
        if not self.transport.is_closing():
            self.transport.write(data)

    # Who sends and never reads is not read from either, so that nothing piles up.
    def pause_writing(self) -> None:
        self.transport.pause_reading()

    def resume_writing(self) -> None:
        self.transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        self._idle.stop()
        self._client.close()
        self._controller.links.discard(self)
