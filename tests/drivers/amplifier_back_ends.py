"""Each amplifier back end as a driver, the mock behind it, and the motors behind that."""

from __future__ import annotations

import math
from collections.abc import Callable, Coroutine
from typing import Any, NamedTuple

from instruments.mock_bench import SimulatedMotors

from fitctl import config
from fitctl.daemon.devices import AMPLIFIERS
from fitctl.drivers.interface import ServoAmplifiers
from fitctl.mocks.amplifiers import amplifier_mock, endpoint_keys

RIGS = config.default_rig_path().parent
LOOP = "right"


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
