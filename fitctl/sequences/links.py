"""What a sequence needs of an instrument: a client's methods, which the simulated instrument has too."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from concurrent.futures import Future

from fitctl.config import Rig
from fitctl.messages.client import Client
from fitctl.messages.commands import AnyCommand, Reply
from fitctl.messages.telemetry import Telemetry
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.simulation import Simulation

_TURN_S = 0.01


class SimulatedLink:
    """The instrument on the virtual clock: waiting for telemetry is what moves the time on.

    As with a running rig, telemetry is received on one thread, and commands may be sent from any. `prepare`
    may change the simulation before it begins; `advises` is for a sequence that uses what was learnt.
    """

    def __init__(
        self,
        rig: Rig,
        seed: int,
        prepare: Callable[[Simulation], object] = lambda _: None,
        *,
        advises: bool = False,
    ) -> None:
        self._stepping = threading.Lock()
        self._buffer = TelemetryBuffer()
        self._period_s = self._due_in_s = 1.0 / rig.supervisor.telemetry_hz
        self._simulation = Simulation(
            rig, seed, record=self._buffer.add, history_s=1.0, advises=advises
        )
        prepare(self._simulation)
        self._state = ServiceState(
            pid=os.getpid(),
            wall_minus_monotonic_s=0.0,
            scheduling="virtual clock",
            records_lost=lambda: 0,
            records_offered=lambda: 0,
        )

    def now_s(self) -> float:
        """The virtual time."""
        return self._simulation.clock.now_s()

    def send(self, command: AnyCommand) -> Reply:
        """Give a command; the next step obeys it, of a thread that waits for telemetry or of this one."""
        supervisor = self._simulation.supervisor
        answered: Future[Reply] = Future()
        supervisor.post(command, answered.set_result)
        while not answered.done():
            if self._stepping.acquire(timeout=_TURN_S):
                try:
                    if not answered.done():
                        supervisor.step()
                finally:
                    self._stepping.release()
        return answered.result()

    def receive(self, timeout_s: float) -> Telemetry | None:
        """Go on until telemetry is due, or by `timeout_s`."""
        with self._stepping:
            run_s = min(timeout_s, self._due_in_s)
            self._simulation.run(run_s)
            self._simulation.ticks.clear()  # which a run is evaluated by; nothing is here
            self._due_in_s -= run_s
            if self._due_in_s > 0:
                return None
            self._due_in_s = self._period_s
            self._state.sequence += 1
            return self._buffer.telemetry(self._simulation.supervisor, self._state, self.now_s())

    def close(self) -> None:
        """Nothing is held open."""


Link = Client | SimulatedLink
"""Commands in, telemetry out, and the supervisor's time."""
