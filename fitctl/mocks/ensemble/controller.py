"""A two-axis Aerotech Ensemble: its ASCII interface on TCP and on a pty, its axes turning motors."""

from __future__ import annotations

import asyncio
import math
import os
import tty
from contextlib import suppress
from typing import NamedTuple, cast

from fitctl.config import EnsembleDevice, EnsembleMock, Siderostat
from fitctl.drivers.ensemble.protocol import EOS, AxisFault, Parameter
from fitctl.mocks.ensemble.axis import Axis
from fitctl.mocks.ensemble.commands import Interpreter
from fitctl.mocks.ensemble.line import Client
from fitctl.mocks.faults import WIRE_FAULTS, FaultKind, Faults
from fitctl.mocks.motors import AXES, AXIS_FAULTS, FaultyMotors, Motors

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


class Endpoints(NamedTuple):
    """Where the mock can be spoken to."""

    tcp_port: int
    pty_path: str


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
        counts_per_rad = siderostat.encoder_counts_per_rev / (2 * math.pi)
        self._motors = FaultyMotors(motors, self.faults, counts_per_rad)
        self._units_per_rad = counts_per_rad / settings.counts_per_unit
        self._power_up()
        self._listener: asyncio.Server | None = None
        self._links: set[_Link] = set()
        self._pty: _Pty | None = None
        self._cycle_timer: asyncio.TimerHandle | None = None
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
        self._pty = _Pty(self)
        self._stepped_s = loop.time()
        self._run_cycle()
        return Endpoints(self._listener.sockets[0].getsockname()[1], self._pty.path)

    async def stop(self) -> None:
        """Take all power, disconnect everyone; safe to call twice."""
        self.faults.close()
        self._power_up()
        if self._cycle_timer is not None:
            self._cycle_timer.cancel()
            self._cycle_timer = None
        if self._pty is not None:
            self._pty.close()
            self._pty = None
        if self._listener is not None:
            self._listener.close()
            self._listener = None
        self._abort_links()
        await asyncio.sleep(0)  # transports close their sockets on the loop's next turn

    def new_client(self, link: _Link | _Pty) -> Client:
        """What serves a connection."""
        return Client(self.faults, self._answer, self._settings.reply_s, link.write)

    @property
    def away(self) -> bool:
        """Cut off or without power."""
        return any(self.faults.value(kind) is not None for kind in ("disconnect", "reboot"))

    @property
    def idle_timeout_s(self) -> float:
        """A connection is closed after so long without a byte."""
        return self._settings.idle_timeout_s

    @property
    def links(self) -> set[_Link]:
        """Those who are connected over TCP."""
        return self._links

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
        loop = asyncio.get_running_loop()
        self._cycle_timer = loop.call_later(CYCLE_S, self._run_cycle)

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
        if self.away:
            self._abort_links()

    def _abort_links(self) -> None:
        for link in list(self._links):
            link.transport.abort()


class _Link(asyncio.Protocol):
    """One client over TCP."""

    transport: asyncio.Transport

    def __init__(self, controller: EnsembleControllerMock) -> None:
        self._controller = controller
        self._idle: asyncio.TimerHandle | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self.transport = cast(asyncio.Transport, transport)
        self._client = self._controller.new_client(self)
        self._controller.links.add(self)
        self._wait_for_more()
        if self._controller.away:
            self.transport.abort()

    def data_received(self, data: bytes) -> None:
        self._wait_for_more()
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
        self._stop_waiting()
        self._client.close()
        self._controller.links.discard(self)

    def _wait_for_more(self) -> None:
        self._stop_waiting()
        loop = asyncio.get_running_loop()
        self._idle = loop.call_later(self._controller.idle_timeout_s, self.transport.close)

    def _stop_waiting(self) -> None:
        if self._idle is not None:
            self._idle.cancel()
            self._idle = None


class _Pty:
    """The serial port."""

    def __init__(self, controller: EnsembleControllerMock) -> None:
        # The clients' end stays open here too, so that ours sees no error when a client leaves.
        self._ours, self._theirs = os.openpty()
        os.set_blocking(self._ours, False)
        tty.setraw(self._theirs)
        self.path = os.ttyname(self._theirs)
        self._client = controller.new_client(self)
        asyncio.get_running_loop().add_reader(self._ours, self._take)

    def write(self, data: bytes) -> None:
        """Send; without flow control, what nobody reads is lost."""
        with suppress(BlockingIOError):
            os.write(self._ours, data)

    def close(self) -> None:
        asyncio.get_running_loop().remove_reader(self._ours)
        self._client.close()
        os.close(self._ours)
        os.close(self._theirs)

    def _take(self) -> None:
        with suppress(BlockingIOError):
            self._client.receive(os.read(self._ours, 4096))
