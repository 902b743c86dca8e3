"""What the benches of the drivers share: a mock behind a wire, the values that it had, the calls to make."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from typing import Any

from benchmarks.swarm.wires.wire import Trouble, Wire, WireTime
from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.mocks.modbus.tcp import ModbusTcpServer, pop_message

RIGS = default_rig_path().parent
SLACK_S = 2e-3
PAUSES_S = (0.0, 0.002, 0.02, 0.3)
"""Between two calls."""


class Mistaken(AssertionError):
    """A driver returned a value that its device did not have, or a call took too long."""


class Course:
    """The values that a device had, and since when."""

    def __init__(self) -> None:
        self._values: list[tuple[float, Any]] = []

    def add(self, time_s: float, value: Any) -> None:
        """Record a new value from this time on."""
        self._values.append((time_s, value))

    def between(self, begin_s: float, end_s: float) -> list[Any]:
        """All values between two times."""
        values = self._values
        nexts = [time_s for time_s, _ in values[1:]] + [math.inf]
        return [
            value
            for (since_s, value), until_s in zip(values, nexts, strict=True)
            if since_s <= end_s and until_s >= begin_s
        ]


class Bench:
    """A driver, a mock behind a wire, and the calls to make.

    Attributes
    ----------
    driver : driver
    calls : list of callable
        Calls of the driver; each checks its own result.
    most_s : float
        Maximum duration of a call.
    """

    driver: Any
    calls: list[Callable[[], None]]
    most_s: float

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None], **options: Any) -> None:
        self.time = time
        self.wire = Wire(time, troubles, self.hear, self.reboot, **options)

    def hear(self, data: Any) -> None:
        """Pass data to the device."""
        raise NotImplementedError

    def reboot(self) -> None:
        """Restart the device."""
        raise NotImplementedError


def rig_of(name: str = "fit-mock.toml", *settings: str) -> Rig:
    """A rig with these settings."""
    return load_rig(RIGS / name, list(settings))


class Modbus:
    """Splits a TCP stream into requests and answers each."""

    def __init__(self, server: ModbusTcpServer, wire: Callable[[bytes], None]) -> None:
        self._server = server
        self._answer = wire
        self._pending = bytearray()

    def hear(self, data: bytes) -> None:
        """Answer the requests that are complete."""
        self._pending += data
        while (request := pop_message(self._pending)) is not None:
            self._answer(self._server.respond(request))
