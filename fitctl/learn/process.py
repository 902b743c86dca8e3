"""The learner's process: reads telemetry as a console does, and reports to the supervisor.

It has no part in the loop. Without it nothing is learnt, and nothing else changes.
"""

from __future__ import annotations

import threading
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray

from fitctl.config import ConfigError, Rig
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.controllers.design.choose import design_for
from fitctl.learn.learner import Learner
from fitctl.loop.learning import is_other_light
from fitctl.messages.client import Client
from fitctl.messages.commands import LearnerReport
from fitctl.messages.telemetry import LoopState, Telemetry
from fitctl.processes import give_way, limit_memory

Floats = NDArray[np.float64]
NICENESS = 10
"""With 19, a learner on a busy machine gets too little of the processor to follow the telemetry at all."""
MOST_BYTES = 1 << 30
"""Of the process's own data. Beyond it, a report fails, or the process ends and is started again."""
_POLL_S = 0.5


class LoopLearner:
    """A learner, and the design that its loop works with."""

    def __init__(self, rig: Rig, loop_name: str) -> None:
        self.loop_name = loop_name
        self._rig = rig
        self._learner = Learner(rig, loop_name)
        self._state: LoopState | None = None
        self._key = ""  # of the design in force
        loop = rig.stellar_loops[loop_name]
        self._rig_noise_px = sensor_noise_px(rig.camera, loop, loop.star_flux_dn)
        self._noise_px = self._rig_noise_px  # of the last design that was not learnt
        # With the key at its beginning.
        self._report: tuple[Future[LearnerReport], str] | None = None

    def hear(self, telemetry: Telemetry, state: LoopState) -> None:
        """One message."""
        self._state = state
        if state.learning is None or not state.learning.design_json:
            before_px, self._noise_px = self._noise_px, state.noise_px or self._rig_noise_px
            if is_other_light(before_px, self._noise_px):
                self._learner.forget()
        self._key = f"{state.design} {state.controller_digest} {state.noise_px}"
        self._learner.watch(self._key, telemetry.time_s)
        for tick in telemetry.ticks:
            if tick.loop == self.loop_name:
                self._learner.add(tick)

    def work(self, executor: ThreadPoolExecutor) -> LearnerReport | None:
        """Begin a report that is due, beside the messages; the one that is ready.

        One that was compared with a design that is not in force any more is left out.
        """
        ready = None
        if self._report is not None and self._report[0].done():
            (future, key), self._report = self._report, None
            ready = future.result() if key == self._key else None
        if self._report is None and self._state is not None and self._learner.due:
            begun = executor.submit(self._make, self._state, self._learner.begin_report())
            self._report = begun, self._key
        return ready

    def _make(self, state: LoopState, frames: Floats) -> LearnerReport:
        try:
            present = design_for(self._rig, self.loop_name, state.design, state.noise_px)
        except ConfigError as error:  # such as a design file that is gone
            return self._learner.failed(str(error), frames)
        if state.controller_digest not in {"", present.digest}:
            reason = (
                f"{state.controller_file} has changed since the loop loaded it; to learn, load it again with "
                "fitctl send controller"
            )
            return self._learner.failed(reason, frames)
        return self._learner.report(present, frames)


def serve_learning(client: Client, rig: Rig, stop: threading.Event) -> None:
    """Learn from a supervisor's telemetry until `stop`."""
    give_way(NICENESS)
    limit_memory(MOST_BYTES)
    learners = {
        name: LoopLearner(rig, name)
        for name, loop in rig.stellar_loops.items()
        if loop.learn != "off"
    }
    with ThreadPoolExecutor(1) as executor:
        while not stop.is_set():
            with suppress(ConnectionError):
                telemetry = client.receive(_POLL_S)
                if telemetry is None:
                    continue
                for state in telemetry.loops:
                    if learner := learners.get(state.name):
                        learner.hear(telemetry, state)
                for learner in learners.values():
                    report = learner.work(executor)
                    if report is not None:
                        client.send(report)
