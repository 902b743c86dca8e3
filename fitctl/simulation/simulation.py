"""The instrument without wires: the same supervisor on the same plant, on the virtual clock.

Time goes on only while the supervisor waits for a frame.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import Rig
from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import Devices, LoopDevices
from fitctl.logging.records import AnyRecord, ModeChange, Tick
from fitctl.messages.commands import Acquire, AnyCommand, Reply, Standby
from fitctl.messages.modes import Mode
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.simulation.devices import (
    InlineExecutor,
    SimulatedAmplifiers,
    SimulatedCamera,
    SimulatedMirror,
    SimulatedPhotodiodes,
    simulated_hexapod,
)
from fitctl.simulation.statistics import (
    SETTLE_S,
    SimulationResult,
    mode_times,
    pair,
    piston_rms_m,
    rms,
    true_residual_rms,
)
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]


class Simulation:
    """A rig on the virtual clock.

    Parameters
    ----------
    rig : Rig
    seed : int
        Of everything random.
    star_offset_px : array, shape (2,), optional
        Where the star is at the start; by default drawn from the seed.
    record : callable, optional
        Takes every record, as the recorder would.
    history_s : float, optional
        How long true positions are kept, by default as the rig says.
    """

    def __init__(
        self,
        rig: Rig,
        seed: int,
        *,
        star_offset_px: Floats | None = None,
        record: Callable[[AnyRecord], None] | None = None,
        history_s: float | None = None,
    ) -> None:
        self.rig = rig
        self.clock = VirtualClock()
        offset = None if star_offset_px is None else np.asarray(star_offset_px)[None]
        self.plant = Plant(rig, [seed], star_offset_px=offset, history_s=history_s)
        self.plants = self.plant.stellar_loops
        self.camera = SimulatedCamera(rig, self.clock, self.plant)
        self.hexapod = simulated_hexapod(self.plant, self.clock, rig)
        self.ticks: list[Tick] = []
        self.mode_changes: list[ModeChange] = []
        self._on_record = record
        loops = {name: self._loop_devices(name) for name in rig.loops}
        self.devices = Devices(self.camera, loops, self.hexapod)
        self.supervisor = Supervisor(
            rig, self.devices, self.clock, InlineExecutor(), self._receive, design_for
        )
        self.camera.on_servo_period = [
            (work.period_s, work.period) for work in self.supervisor.periodic
        ]

    def _loop_devices(self, name: str) -> LoopDevices:
        part, counts = (
            self.plant.loops[name],
            self.rig.loops[name].siderostat.encoder_counts_per_rev,
        )
        amplifiers = SimulatedAmplifiers(part, self.clock, counts)
        if isinstance(part, MetrologyPart):
            photodiodes = SimulatedPhotodiodes(part, self.clock, self.rig, name)
            return LoopDevices(amplifiers, photodiodes=photodiodes)
        mirror = SimulatedMirror(part, self.clock, self.rig, name)
        return LoopDevices(amplifiers, dac=mirror, piezo=mirror)

    def _receive(self, record: AnyRecord) -> None:
        if isinstance(record, Tick):
            self.ticks.append(record)
        elif isinstance(record, ModeChange):
            self.mode_changes.append(record)
        if self._on_record is not None:
            self._on_record(record)

    def command(self, command: AnyCommand) -> Reply:
        """Give a command and step once, so that it is obeyed."""
        replies: list[Reply] = []
        self.supervisor.post(command, replies.append)
        self.supervisor.step()
        return replies[0]

    def run(self, duration_s: float) -> None:
        """Step for `duration_s` of virtual time."""
        end_s = self.clock.now_s() + duration_s
        while self.clock.now_s() < end_s - 1e-9:
            self.supervisor.step()

    def acquire(self) -> None:
        """Power up and begin the search.

        Raises
        ------
        RuntimeError
            If the supervisor refuses, which it has no reason to.
        """
        for command in (Standby(), Acquire()):
            reply = self.command(command)
            if not reply.accepted:
                raise RuntimeError(reply.text)


def simulate(
    rig: Rig,
    seed: int,
    duration_s: float,
    *,
    on_progress: Callable[[float], None] = lambda _: None,
) -> dict[str, SimulationResult]:
    """Acquire and hold for `duration_s` of virtual time; one result for each loop.

    `on_progress` is called about ten times a second of real time with the part done.
    """
    simulation = Simulation(rig, seed, history_s=duration_s + 1.0)  # all of it is judged
    simulation.plant.advance(simulation.plant.step_s)  # compiles, before the time is taken
    started = shown = time.perf_counter()
    simulation.acquire()
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
        if time.perf_counter() - shown > 0.1:
            shown = time.perf_counter()
            on_progress(simulation.clock.now_s() / duration_s)
    speed_x = simulation.clock.now_s() / (time.perf_counter() - started)
    return {name: _result(simulation, name, speed_x) for name in rig.stellar_loops}


def _result(simulation: Simulation, name: str, speed_x: float) -> SimulationResult:
    changes = [change for change in simulation.mode_changes if change.loop == name]
    ticks = [tick for tick in simulation.ticks if tick.loop == name]
    end_s = simulation.clock.now_s()
    reached = {change.target: change.time_s for change in reversed(changes)}
    vernier_s = reached.get(Mode.VERNIER.name, math.nan)
    start_s = vernier_s + SETTLE_S
    judged = [t for t in ticks if t.time_s >= start_s and t.star_visible]
    true_px = true_residual_rms(
        simulation.plants[name], simulation.supervisor.stellar_loops[name].target_px, start_s, end_s
    )
    measured = np.array([[t.error_az_px, t.error_el_px] for t in judged]).reshape(-1, 2)
    return SimulationResult(
        acquired_s=reached.get(Mode.COARSE.name, math.nan),
        vernier_s=vernier_s,
        rms_px=pair(true_px),
        measured_rms_px=pair(rms(measured)),
        judged_s=max(0.0, end_s - start_s) if judged else 0.0,
        piston_rms_m=piston_rms_m(simulation.plants[name], start_s, end_s),
        mode_times=mode_times(changes, end_s),
        frames=sum(tick.number >= 0 for tick in ticks),
        speed_x=speed_x,
    )
