"""D/A converter and piezo amplifier of a mirror: a D/A that receives no writes goes to its safe voltages."""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.lines import Line, identity
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import Rig
from fitctl.drivers.interface import (
    DeviceIdentity,
    DeviceMismatch,
)
from fitctl.simulation.devices import (
    SimulatedMirror,
)

Floats = NDArray[np.float64]


class SwarmDac:
    """The D/A converter on Modbus, with a watchdog."""

    def __init__(
        self,
        mirror: SimulatedMirror,
        time: VirtualTime,
        rig: Rig,
        loop_name: str,
        random: Random,
        written: Callable[[str, Floats, Floats], None],
        made_safe: Callable[[str], None],
    ) -> None:
        dac = rig.stellar_loops[loop_name].fsm.dac
        _, mocks = rig.mock_parts()
        self.name = loop_name
        self.line = Line("D/A", dac.endpoint, time, random, 0.0006, dac.response_timeout_s)
        self._mirror = mirror
        self._time = time
        self._written = written
        self._made_safe = made_safe
        settings = mocks.loops[loop_name].dac  # pyrefly: ignore[missing-attribute]
        self._watchdog_s, self._safe_v = settings.watchdog_s, settings.safe_v
        self._written_s = -math.inf
        self._watched = False
        self._unconfirmed: tuple[Floats, float] | None = None

    def open(self) -> DeviceIdentity:
        """Connect."""
        self._unconfirmed = None
        self.line.open()
        self.read_v()
        return identity("D/A")

    def send_v(self, volts: Floats) -> None:
        """Send the voltages after confirming the previous write. They take effect when they arrive."""
        self.confirm()
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        self._written(self.name, volts, self._mirror.read_v())
        self._unconfirmed = volts.copy(), self._time.now_s()

    def confirm(self) -> None:
        """Wait until the station has accepted the voltages."""
        unconfirmed, self._unconfirmed = self._unconfirmed, None
        if unconfirmed is not None:
            volts, _ = unconfirmed
            self.line.ask(lambda: self._set(volts))

    def read_v(self) -> Floats:
        """Read the outputs, in three exchanges."""
        self.confirm()
        for _ in range(2):
            self.line.ask(self._outputs_v)
        return self.line.ask(self._outputs_v)

    def close(self) -> None:
        """Disconnect."""
        self._unconfirmed = None
        self.line.close()

    def reset(self) -> None:
        """Restart at the safe voltages."""
        self._make_safe()
        self.line.connected = False

    def _make_safe(self) -> None:
        self._mirror.send_v(np.full(3, self._safe_v))
        self._made_safe(self.name)

    def _outputs_v(self) -> Floats:
        self._refuse_if_tripped()
        return self._mirror.read_v()

    def _refuse_if_tripped(self) -> None:
        if "tripped" in self.line.wrong:
            self._make_safe()
            raise self.line.refused()

    def _set(self, volts: Floats) -> None:
        self._refuse_if_tripped()
        self._mirror.send_v(volts)
        self._written_s = self._time.now_s()
        if not self._watched:
            self._watched = True
            self._time.call_at(self._written_s + self._watchdog_s, self._watch)

    def _watch(self) -> None:
        due_s = self._written_s + self._watchdog_s
        if self._time.now_s() < due_s - 1e-9:
            self._time.call_at(due_s, self._watch)
            return
        self._watched = False
        self._make_safe()


class SwarmPiezo:
    """The piezo amplifier on a serial line: slow, and any answer may be wrong."""

    def __init__(
        self, mirror: SimulatedMirror, time: VirtualTime, rig: Rig, loop_name: str, random: Random
    ) -> None:
        piezo = rig.stellar_loops[loop_name].fsm.piezo
        self.line = Line(
            "piezo amplifier", piezo.port, time, random, 0.03, piezo.response_timeout_s
        )
        self._limit_v = piezo.limit_v
        self._mirror = mirror

    def open(self) -> DeviceIdentity:
        """Connect and check."""
        self.line.open()
        for _ in range(3):
            self.limit_v()
        return identity("piezo amplifier")

    def stack_volts(self) -> Floats:
        """Measure the stacks; one that is stuck has the highest voltage."""
        volts = np.array([self.line.ask(self._mirror.stack_volts)[stack] for stack in range(3)])
        if "stuck" in self.line.wrong:
            volts[int(self.line.wrong["stuck"])] = self._limit_v
        return volts

    def limit_v(self) -> float:
        """Read the limit switch, as the driver does: another limit than the rig file's is an error."""
        limit_v = self.line.ask(self._mirror.limit_v)
        if self.line.is_wrong("limit"):
            raise DeviceMismatch("piezo amplifier", self.line.endpoint, "its limit", "another")
        return limit_v

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart."""
        self.line.connected = False
