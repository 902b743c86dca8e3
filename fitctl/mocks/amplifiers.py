"""Which mock stands where a loop's amplifiers do."""

from __future__ import annotations

import math
from typing import Any, Protocol

from fitctl.config import Siderostat, SiderostatMocks
from fitctl.config.wiring import STRAIGHT
from fitctl.mocks.bal_analog.station import BalAnalogMockStation
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import SlcanAdapter
from fitctl.mocks.ensemble.controller import EnsembleControllerMock
from fitctl.mocks.faults import Faults
from fitctl.mocks.motors import Motors, WiredMotors


class AmplifierMock(Protocol):
    """What the testbed needs of each."""

    faults: Faults

    async def start(self) -> Any:
        """Listen; returns where."""
        ...

    async def stop(self) -> None:
        """Take all power and disconnect everyone."""
        ...


def amplifier_mock(
    siderostat: Siderostat[Any],
    mocks: SiderostatMocks,
    motors: Motors,
    adapter: SlcanAdapter | None = None,
) -> AmplifierMock:
    """The mock that speaks what the rig's driver speaks; the rig file has its settings, if it needs any.

    A drive whose CAN bus has others too is on `adapter`.
    """
    wiring, gains, ends_rad = siderostat.wiring, mocks.velocity_gains, mocks.motor_ends_rad
    if (wiring, gains, ends_rad) != (None, None, None):
        motors = WiredMotors(
            motors, wiring or STRAIGHT, gains or [1.0, 1.0], ends_rad or [math.inf, math.inf]
        )
    match siderostat.device.driver:
        case "ensemble" if mocks.ensemble is not None:
            return EnsembleControllerMock(siderostat, mocks.ensemble, motors)
        case "bal_analog" if mocks.bal_analog is not None:
            return BalAnalogMockStation(siderostat, mocks.bal_analog, motors)
        case _:
            return Cia402DriveMock(siderostat, motors, port=mocks.slcan_port, adapter=adapter)


def endpoint_keys(driver: str, loop: str, listening: Any) -> dict[str, Any]:
    """Where a started mock listens, by the rig file's keys."""
    device = f"loops.{loop}.siderostat.device"
    match driver:
        case "ensemble":
            return {
                f"{device}.port": f"socket://127.0.0.1:{listening.tcp_port}",
                f"mocks.loops.{loop}.ensemble_pty": listening.pty_path,
            }
        case "bal_analog":
            return {f"{device}.host": "127.0.0.1", f"{device}.port": listening}
        case _:
            return {f"{device}.channel": f"socket://127.0.0.1:{listening}"}
