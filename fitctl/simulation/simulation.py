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
from fitctl.config import ARCSEC_PER_RAD, ConfigError, Rig
from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import Devices, LoopDevices
from fitctl.learn.learner import Learner
from fitctl.logging.records import AnyRecord, MetrologyTick, ModeChange, Tick
from fitctl.messages.commands import Acquire, AnyCommand, MoveCollector, Reply, Standby
from fitctl.messages.modes import METROLOGY_MODES, Mode
from fitctl.model.metrology.fringes import mean_visibility
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
    TILT_EVERY,
    MetrologyResult,
    RigResult,
    SimulationResult,
    mode_times,
    motion_start_s,
    of_enough,
    pair,
    piston_rms_m,
    rms,
    true_residual_rms,
)
from fitctl.stages.collector import CollectorDrive
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]


class Simulation:
    """A rig on the virtual clock: the supervisor and its loops with simulated devices, in this process.

    The same rig and seed give the same run, to the last bit.

    Parameters
    ----------
    rig : Rig
        With the sections ``plant`` and ``mocks``.
    seed : int
        Of everything random: noise, air, and the star's place.
    star_offset_px : array, shape (2,), optional
        Where the star is at the start, az and el from the target in px; by default drawn from the seed.
    record : callable, optional
        Gets every record of :mod:`fitctl.logging.records`, as the recorder would; frames too.
    history_s : float, optional
        How long true positions are kept, by default ``plant.history_s``.
    advises : bool
        Loops with ``learn = "advise"`` have a learner, too. Advice is for people, and most runs have none.

    Attributes
    ----------
    ticks : list of Tick
        Of all stellar loops, in order.
    mode_changes : list of ModeChange
    clock : VirtualClock
    plants : dict of str to StellarPart
        The truth, by loop.

    Raises
    ------
    ConfigError
        If the rig cannot be simulated, or a controller cannot be designed.

    Examples
    --------
    >>> from fitctl.config import default_rig_path, load_rig
    >>> simulation = Simulation(load_rig(default_rig_path()), seed=1)
    >>> simulation.acquire()
    >>> simulation.run(15.0)
    >>> simulation.ticks[-1].mode
    'VERNIER'
    """

    def __init__(
        self,
        rig: Rig,
        seed: int,
        *,
        star_offset_px: Floats | None = None,
        record: Callable[[AnyRecord], None] | None = None,
        history_s: float | None = None,
        advises: bool = False,
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
        self.learners = {
            name: Learner(rig, name)
            for name, loop in rig.stellar_loops.items()
            if loop.learn == "on" or (advises and loop.learn == "advise")
        }
        self.samples = dict.fromkeys(rig.metrology_loops, 0)
        self._on_record = record
        loops = {name: self._loop_devices(name) for name in rig.loops}
        self.devices = Devices(self.camera, loops, self.hexapod)
        self.supervisor = Supervisor(
            rig,
            self.devices,
            self.clock,
            InlineExecutor(),
            self._receive,
            design_for,
            record_frames=record is not None,
        )
        if self.supervisor.collector is not None and rig.collector and self.hexapod is not None:
            # A random course is the run's own.
            self.supervisor.collector.drive = CollectorDrive(
                rig.collector, self.hexapod, self.clock, seed
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
            if learner := self.learners.get(record.loop):
                learner.add(record)
        elif isinstance(record, MetrologyTick):
            self.samples[record.loop] += not math.isnan(record.beam_az_m)
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
            self._learn()

    def _learn(self) -> None:
        """Have the learners report, in no time: what they need to compute is no part of the virtual clock's."""
        for name, learner in self.learners.items():
            loop = self.supervisor.stellar_loops[name]
            design = loop.pointing.design
            title = loop.learning.design_json or design.title
            learner.watch(f"{title} {loop.noise_px}", self.clock.now_s())
            if learner.due:
                report = learner.report(design, learner.begin_report())
                self.supervisor.post(report, lambda _: None)

    def acquire(self) -> None:
        """Power up and begin the search.

        Raises
        ------
        RuntimeError
            If the supervisor refuses, which it has no reason to.
        """
        for command in (Standby(), Acquire()):
            self._command(command)

    def move_collector(self) -> None:
        """Reference the hexapod, and begin the collector's motion.

        Raises
        ------
        RuntimeError
            If the supervisor refuses.
        ConfigError
            If the hexapod does: the motion of the rig file is beyond it.
        """
        for command in (MoveCollector(action="reference"), MoveCollector(action="start")):
            self._command(command)
            collector = self.supervisor.collector
            if collector is not None and collector.error:
                msg = f"collector.motion: {collector.error}"
                raise ConfigError(msg)

    def _command(self, command: AnyCommand) -> None:
        reply = self.command(command)
        if not reply.accepted:
            raise RuntimeError(reply.text)


def simulate(rig: Rig, seed: int, duration_s: float) -> dict[str, SimulationResult]:
    """Acquire and hold for `duration_s` of virtual time; one result for each stellar loop."""
    loops = simulate_rig(rig, seed, duration_s).loops
    return {name: loop for name, loop in loops.items() if isinstance(loop, SimulationResult)}


def simulate_rig(
    rig: Rig,
    seed: int,
    duration_s: float,
    *,
    on_progress: Callable[[float], None] = lambda _: None,
) -> RigResult:
    """Acquire and hold for `duration_s` of virtual time, and move the collector from its start on.

    `on_progress` is called about ten times a second of real time with the part done.
    """
    motion_s = motion_start_s(rig)
    simulation = Simulation(rig, seed, history_s=duration_s + 1.0)  # all of it is judged
    simulation.plant.advance(simulation.plant.step_s)  # compiles, before the time is taken
    started = shown = time.perf_counter()
    simulation.acquire()
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
        if simulation.clock.now_s() >= motion_s:
            simulation.move_collector()
            motion_s = math.inf
        if simulation.supervisor.collector and simulation.supervisor.collector.drive.fault:
            raise simulation.supervisor.collector.drive.fault
        if time.perf_counter() - shown > 0.1:
            shown = time.perf_counter()
            on_progress(simulation.clock.now_s() / duration_s)
    speed_x = simulation.clock.now_s() / (time.perf_counter() - started)
    loops = {name: of_enough(_result_of(simulation, name, speed_x)) for name in rig.loops}
    return RigResult(loops, _visibility(simulation), speed_x)


def _counted_from_s(simulation: Simulation, name: str) -> float:
    """From when on a loop is judged: it has settled, and the collector moves where it will; nan without."""
    held = Mode.LOCKED if name in simulation.rig.metrology_loops else Mode.VERNIER
    held_s = _reached_s(simulation, name, held) + SETTLE_S
    motion_s = motion_start_s(simulation.rig)
    return held_s if math.isinf(motion_s) else max(held_s, motion_s)


def _reached_s(simulation: Simulation, name: str, mode: Mode) -> float:
    """When a loop first came to a mode, or nan."""
    times_s = (
        change.time_s
        for change in simulation.mode_changes
        if change.loop == name and change.target == mode.name
    )
    return next(times_s, math.nan)


def _result_of(
    simulation: Simulation, name: str, speed_x: float
) -> SimulationResult | MetrologyResult:
    if name in simulation.rig.metrology_loops:
        return _metrology_result(simulation, name, speed_x)
    return _result(simulation, name, speed_x)


def _metrology_result(simulation: Simulation, name: str, speed_x: float) -> MetrologyResult:
    part = simulation.plant.metrology_loops[name]
    start_s, end_s = _counted_from_s(simulation, name), simulation.clock.now_s()
    beam_m = part.history_offset_m(start_s, end_s)[:, 0] if start_s < end_s else np.empty((0, 2))
    beam_arcsec = beam_m / part.sensor.link_length_m * ARCSEC_PER_RAD
    return MetrologyResult(
        acquired_s=_reached_s(simulation, name, Mode.COARSE),
        locked_s=_reached_s(simulation, name, Mode.LOCKED),
        rms_arcsec=pair(rms(beam_arcsec)),
        judged_s=max(0.0, end_s - start_s) if start_s < end_s else 0.0,
        mode_times=mode_times(
            [change for change in simulation.mode_changes if change.loop == name],
            end_s,
            METROLOGY_MODES,
        ),
        samples=simulation.samples[name],
        speed_x=speed_x,
    )


def _visibility(simulation: Simulation) -> float:
    """Of the stars' true places, each from its loop's target, while both are judged."""
    fringes = simulation.rig.fringes
    if fringes is None:
        return math.nan
    start_s = max(_counted_from_s(simulation, name) for name in fringes.loops)
    if not start_s < simulation.clock.now_s():
        return math.nan
    one_px, other_px = (
        simulation.plants[name].history_px(start_s, simulation.clock.now_s())[::TILT_EVERY, 0, 0]
        - simulation.supervisor.stellar_loops[name].target_px
        for name in fringes.loops
    )
    sky_px_per_rad = simulation.plants[fringes.loops[0]].constants.sky_px_per_rad
    return mean_visibility((one_px - other_px) / sky_px_per_rad, fringes)


def _result(simulation: Simulation, name: str, speed_x: float) -> SimulationResult:
    changes = [change for change in simulation.mode_changes if change.loop == name]
    ticks = [tick for tick in simulation.ticks if tick.loop == name]
    end_s = simulation.clock.now_s()
    start_s = _counted_from_s(simulation, name)
    judged = [t for t in ticks if t.time_s >= start_s and t.star_visible]
    true_px = true_residual_rms(
        simulation.plants[name], simulation.supervisor.stellar_loops[name].target_px, start_s, end_s
    )
    measured = np.array([[t.error_az_px, t.error_el_px] for t in judged]).reshape(-1, 2)
    return SimulationResult(
        acquired_s=_reached_s(simulation, name, Mode.COARSE),
        vernier_s=_reached_s(simulation, name, Mode.VERNIER),
        rms_px=pair(true_px),
        measured_rms_px=pair(rms(measured)),
        judged_s=max(0.0, end_s - start_s) if judged else 0.0,
        piston_rms_m=piston_rms_m(simulation.plants[name], start_s, end_s),
        mode_times=mode_times(changes, end_s),
        frames=sum(tick.number >= 0 for tick in ticks),
        speed_x=speed_x,
    )
