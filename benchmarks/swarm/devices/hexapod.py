"""The hexapod of the collector."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.lines import Line
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import Rig
from fitctl.drivers.interface import (
    DeviceIdentity,
    HexapodReading,
    Pose,
)
from fitctl.model.plant import Plant
from fitctl.simulation.devices import (
    SimulatedHexapod,
)

Floats = NDArray[np.float64]
_REFERENCE_S = 5.0
_OFFSET_MM = 1.0


class SwarmHexapod(SimulatedHexapod):
    """The hexapod's controller on a serial line."""

    def __init__(
        self,
        plant: Plant,
        time: VirtualTime,
        rig: Rig,
        random: Random,
        sent: Callable[[Pose, float], None] = lambda _pose, _velocity_mm_s: None,
    ) -> None:
        _, mocks = rig.mock_parts()
        device = rig.collector.hexapod  # pyrefly: ignore[missing-attribute]
        super().__init__(plant.collector, time, device, mocks.hexapod)  # pyrefly: ignore[bad-argument-type]
        self.line = Line("hexapod", device.endpoint, time, random, 0.01, device.response_timeout_s)
        self._time = time
        self._sent = sent

    def open(self) -> DeviceIdentity:
        """Connect and check."""
        self.line.open()
        for _ in range(10):
            self.line.ask(lambda: None)
        return super().open()

    def reference(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Make a reference move, which takes seconds."""
        self.line.ask(self._begin_reference)
        began_s = self._time.now_s()
        while self.moves or self._time.now_s() < began_s + _REFERENCE_S:
            self._time.sleep(0.1)
            self.line.ask(lambda: None)
            if not is_wanted() or self._servos_off():
                self.stop()
                raise self._refusal("all axes referenced", "a stop", "reference it again")
        self._referenced = True

    def _begin_reference(self) -> None:
        if "stuck" not in self.line.wrong:
            super().reference()
        self._referenced = False

    def move_to(self, pose: Pose, velocity_mm_s: float) -> None:
        """Start a move."""
        self._sent(pose, velocity_mm_s)
        self.line.ask(partial(self._move, pose, velocity_mm_s))

    def _move(self, pose: Pose, velocity_mm_s: float) -> None:
        if self._servos_off():
            raise self._refusal("servos that are on", "off", "switch them on")
        if "stuck" not in self.line.wrong:
            super().move_to(pose, velocity_mm_s)

    def pose(self) -> HexapodReading:
        """Read the pose."""
        servos_off = self._servos_off()
        reading = self.line.ask(super().pose)
        if self.line.is_wrong("offset"):
            reading = reading._replace(
                pose=reading.pose._replace(x_mm=reading.pose.x_mm + _OFFSET_MM)
            )
        return reading._replace(servos_on=not servos_off)

    def _servos_off(self) -> bool:
        """Whether they are; if so, the platform brakes."""
        off = "servos off" in self.line.wrong
        if off and self.moves:
            super().stop()
        return off

    def stop(self) -> None:
        """Brake, and wait until the platform is at rest."""
        self.line.ask(super().stop)

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart at the present pose, without a reference."""
        super().stop()
        self._referenced = False
        self.line.connected = False

    @property
    def moves(self) -> bool:
        """Whether the platform is moving."""
        return self._time.now_s() < self._trajectory.ends_s
