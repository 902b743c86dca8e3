"""Each amplifier back end as a driver, the mock behind it, and the motors behind that."""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

from fitctl import config
from fitctl.daemon.devices import AMPLIFIERS
from fitctl.drivers.interface import ServoAmplifiers
from fitctl.mocks.amplifiers import amplifier_mock, endpoint_keys

RIGS = config.default_rig_path().parent
LOOP = "right"


class SimulatedMotors:
    """Two ideal motors: the angle is the time integral of the velocity, where there is current."""

    def __init__(self) -> None:
        self.velocity_rad_s = (0.0, 0.0)
        self.enabled = [False, False]
        self._angle_rad = [0.0, 0.0]
        self._at_s = time.monotonic()
        self._lock = threading.Lock()  # the mock's thread moves them, the test's looks

    def position_rad(self) -> tuple[float, float]:
        with self._lock:
            return self._move()

    def turn_to(self, az_rad: float, el_rad: float) -> None:
        with self._lock:
            self._move()
            self._angle_rad = [az_rad, el_rad]

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        with self._lock:
            self._move()
            self.velocity_rad_s = (az, el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        with self._lock:
            self._move()
            self.enabled[axis] = enabled

    @property
    def moving(self) -> bool:
        return any(
            on and abs(velocity) > 0.05  # a position loop hunts within half a count of its encoder
            for on, velocity in zip(self.enabled, self.velocity_rad_s, strict=True)
        )

    def _move(self) -> tuple[float, float]:
        now_s = time.monotonic()
        for axis, velocity in enumerate(self.velocity_rad_s):
            self._angle_rad[axis] += velocity * (now_s - self._at_s) * self.enabled[axis]
        self._at_s = now_s
        az_rad, el_rad = self._angle_rad
        return az_rad, el_rad


class BackEnd(NamedTuple):
    """Where a back end's settings are, what is else here, and how its link is lost."""

    rig: str
    overrides: tuple[str, ...]
    link_fault: str


BACK_ENDS = {
    "cia402": BackEnd("fit-mock.toml", ("mocks.loops.right.slcan_port=0",), "link_loss"),
    "ensemble": BackEnd(
        "ensemble.toml",
        (
            "mocks.loops.right.ensemble.tcp_port=0",
            # Two revolutions: what ends a motion that nobody else ends is soon there.
            "mocks.loops.right.ensemble.software_limit_units=2.0",
        ),
        "disconnect",
    ),
    "bal_analog": BackEnd(
        "fit-bal-analog.toml", ("mocks.loops.right.bal_analog.modbus_port=0",), "disconnect"
    ),
}


class Bench:
    """A driver and, in the loop of another thread, the mock that it is configured for."""

    def __init__(self, in_loop: Callable[[Coroutine], Any], name: str, *overrides: str) -> None:
        self._in_loop = in_loop
        self.link_fault = BACK_ENDS[name].link_fault
        self.motors = SimulatedMotors()
        rig_file = RIGS / BACK_ENDS[name].rig
        overrides = (*BACK_ENDS[name].overrides, *overrides)
        rig = config.load_rig(rig_file, overrides)
        _, mocks = rig.mock_parts()
        self.mock = amplifier_mock(rig.loops[LOOP].siderostat, mocks.loops[LOOP], self.motors)
        listening = in_loop(self.mock.start())
        self.endpoints = endpoint_keys(name, LOOP, listening)
        devices = [f"{key}={value}" for key, value in self.endpoints.items() if key[0] == "l"]
        self.siderostat = config.load_rig(rig_file, [*overrides, *devices]).loops[LOOP].siderostat
        self.driver: ServoAmplifiers = AMPLIFIERS[name](self.siderostat)

    @property
    def count_rad(self) -> float:
        return 2 * math.pi / self.siderostat.encoder_counts_per_rev

    def fault(self, kind: str, part: str = "", **settings: float) -> None:
        fault = config.Fault(device="right.drive", kind=kind, part=part, **settings)
        self._call(self.mock.faults.set, fault)

    def heal(self) -> None:
        self._call(self.mock.faults.clear)

    def close(self) -> None:
        self.driver.close()
        self._in_loop(self.mock.stop())

    def _call(self, action, *arguments) -> None:
        async def run() -> None:
            action(*arguments)

        self._in_loop(run())
