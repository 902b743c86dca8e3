"""Which mock stands where a loop's amplifiers do: one table from driver name to mock."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

from fitctl.config import LoopMocks, Siderostat
from fitctl.mocks.bal_analog.station import BalAnalogMockStation
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.ensemble.controller import EnsembleControllerMock
from fitctl.mocks.faults import Faults
from fitctl.mocks.motors import Motors


class AmplifierMock(Protocol):
    """What the testbed needs of each."""

    faults: Faults

    async def start(self) -> Any:
        """Listen; returns where."""
        ...

    async def stop(self) -> None:
        """Take all power and disconnect everyone."""
        ...


class _Kind(NamedTuple):
    make: Callable[[Siderostat[Any], LoopMocks, Motors], AmplifierMock]
    endpoints: Callable[[Any], Mapping[str, Any]]


def amplifier_mock(siderostat: Siderostat[Any], mocks: LoopMocks, motors: Motors) -> AmplifierMock:
    """The mock that speaks what the rig's driver speaks."""
    return _KINDS[siderostat.device.driver].make(siderostat, mocks, motors)


def endpoint_keys(driver: str, loop: str, listening: Any) -> dict[str, Any]:
    """Where a started mock listens, by the rig file's keys."""
    endpoints = _KINDS[driver].endpoints(listening)
    return {key.format(loop=loop): value for key, value in endpoints.items()}


def _ensemble(
    siderostat: Siderostat[Any], mocks: LoopMocks, motors: Motors
) -> EnsembleControllerMock:
    assert mocks.ensemble is not None  # noqa: S101 - the rig file is refused otherwise
    return EnsembleControllerMock(siderostat, mocks.ensemble, motors)


def _bal_analog(
    siderostat: Siderostat[Any], mocks: LoopMocks, motors: Motors
) -> BalAnalogMockStation:
    assert mocks.bal_analog is not None  # noqa: S101 - likewise
    return BalAnalogMockStation(siderostat, mocks.bal_analog, motors)


_KINDS = {
    "cia402": _Kind(
        lambda siderostat, mocks, motors: Cia402DriveMock(
            siderostat, motors, port=mocks.slcan_port
        ),
        lambda port: {"loops.{loop}.siderostat.device.channel": f"socket://127.0.0.1:{port}"},
    ),
    "ensemble": _Kind(
        _ensemble,
        lambda ends: {
            "loops.{loop}.siderostat.device.port": f"socket://127.0.0.1:{ends.tcp_port}",
            "mocks.loops.{loop}.ensemble_pty": ends.pty_path,
        },
    ),
    "bal_analog": _Kind(
        _bal_analog,
        lambda port: {
            "loops.{loop}.siderostat.device.host": "127.0.0.1",
            "loops.{loop}.siderostat.device.port": port,
        },
    ),
}
