"""The instrument without wires: the same supervisor on the same plant, on the virtual clock.

The simulated devices stand behind the same interfaces as the drivers, with their delays and their
quantization; time goes on only while the supervisor waits for a frame.
"""

from __future__ import annotations

import heapq
import math
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import Rig
from fitctl.drivers.interface import (
    AzEl,
    CameraCounts,
    DeviceIdentity,
    Devices,
    Frame,
    LoopDevices,
    ServoReading,
)
from fitctl.logging.records import AnyRecord, ModeChange, Tick
from fitctl.model.plant import Plant
from fitctl.model.scene import Scene
from fitctl.supervisor.messages import Acquire, AnyCommand, Reply, Standby
from fitctl.supervisor.modes import Mode
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]
SETTLE_S = 10.0  # after vernier is reached, before its residual counts


def _identity(model: str) -> DeviceIdentity:
    return DeviceIdentity("fitctl", f"simulated {model}", "", "")


class InlineExecutor(Executor):
    """Runs everything at once: on the virtual clock, device work takes no time."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future:
        """Run `fn` now."""
        future: Future = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class SimulatedAmplifiers:
    """Velocity-mode amplifiers on the plant's motors, with encoders that count."""

    def __init__(self, plant: Plant, clock: VirtualClock, counts_per_rev: int) -> None:
        self._plant = plant
        self._clock = clock
        self._motor_rad = plant.state.motor_rad[0]
        self._velocity_rad_s = plant.inputs.velocity_rad_s[0]
        self._rad_per_count = 2 * math.pi / counts_per_rev
        self._enabled = False

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("amplifiers")

    def enable(self) -> None:
        """Follow velocity commands."""
        self._enabled = True

    def disable(self) -> None:
        """Stand still."""
        self._enabled = False
        self._velocity_rad_s[:] = 0.0

    def reset_fault(self) -> None:
        """There are none."""

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading:
        """Command and read at the present virtual time."""
        now_s = self._clock.now_s()
        self._plant.advance(now_s)
        if self._enabled:
            self._velocity_rad_s[0], self._velocity_rad_s[1] = velocity_rad_s
        az_rad, el_rad = self._motor_rad.tolist()
        count = self._rad_per_count
        position_rad = (math.floor(az_rad / count) * count, math.floor(el_rad / count) * count)
        return ServoReading(now_s, position_rad, self._enabled, "")

    def close(self) -> None:
        """Stand still."""
        self.disable()


class SimulatedMirror:
    """D/A and piezo amplifier in one: volts, quantized and limited, on the plant's stacks."""

    def __init__(self, plant: Plant, clock: VirtualClock, rig: Rig, loop_name: str) -> None:
        fsm = rig.loops[loop_name].fsm
        self._plant = plant
        self._clock = clock
        self._stack_v = plant.inputs.stack_v[0]
        self._step_v = fsm.dac.full_scale_v / (2**fsm.dac.bits - 1)
        self._gain = fsm.piezo.gain
        self._limit_v = fsm.piezo.limit_v
        self._most_v = fsm.piezo.limit_v / fsm.piezo.gain

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("mirror")

    def write_v(self, volts: Floats) -> None:
        """Set the stacks at the present virtual time."""
        self._plant.advance(self._clock.now_s())
        step_v, most_v = self._step_v, self._most_v
        self._stack_v[:] = [min(round(volt / step_v) * step_v, most_v) for volt in volts.tolist()]

    def read_v(self) -> Floats:
        """What the D/A is set to."""
        return self._stack_v.copy()

    def stack_volts(self) -> Floats:
        """What the stacks have."""
        return self._stack_v * self._gain

    def limit_v(self) -> float:
        """The limit of the rig file."""
        return self._limit_v

    def close(self) -> None:
        """Nothing to disconnect."""


class SimulatedCamera:
    """Frames of one scene; waiting for one moves the virtual clock on, servo period by servo period."""

    def __init__(self, rig: Rig, clock: VirtualClock, plants: dict[str, Plant]) -> None:
        truth, _ = rig.mock_parts()
        self.on_servo_period: list[tuple[float, Callable[[], None]]] = []
        self._camera = rig.true_camera
        self._clock = clock
        self._plants = plants
        self._scene = Scene(
            rig.camera,
            [spot for name in plants for spot in truth.loops[name].spots],
            truth.hot_pixels,
        )
        self._pixel_key = next(iter(plants.values())).pixel_keys[0]
        self._exposures = 0  # never starts again, as the frames' numbers do: noise must not repeat
        self._frames = 0
        self._start_s = 0.0
        self._due: list[tuple[float, int]] = []  # a heap: when, and which

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("camera")

    def start(self) -> None:
        """The first exposure begins now."""
        self._frames = 0
        self._start_s = self._clock.now_s() + self._camera.exposure_s / 2
        now_s = self._clock.now_s()
        self._due = [(now_s + work[0], which) for which, work in enumerate(self.on_servo_period)]
        heapq.heapify(self._due)

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Go on to the next frame's arrival, or by `timeout_s`."""
        exposed_s = self._start_s + self._frames * self._camera.period_s
        arrives_s = exposed_s + self._camera.frame_delay_s
        if arrives_s > self._clock.now_s() + timeout_s + 1e-9:
            self._go_on_to(self._clock.now_s() + timeout_s)
            return None
        self._go_on_to(arrives_s)
        self._frames += 1
        self._exposures += 1
        spots = np.concatenate([plant.spots_px(exposed_s)[0] for plant in self._plants.values()])
        image = self._scene.frame(spots, self._pixel_key, self._exposures)
        return Frame(self._frames, exposed_s, self._clock.now_s(), image)

    def counts(self) -> CameraCounts:
        """Nothing is ever lost here."""
        return CameraCounts(self._frames, 0, 0)

    def stop(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to disconnect."""

    def _go_on_to(self, time_s: float) -> None:
        due = self._due
        while due[0][0] <= time_s:
            due_s, which = due[0]
            period_s, run = self.on_servo_period[which]
            self._clock.sleep_until(due_s)
            run()
            heapq.heapreplace(due, (due_s + period_s, which))
        self._clock.sleep_until(time_s)


class SimulationResult(NamedTuple):
    """What a simulated run gave; RMS about the target over `judged_s`, nan if that is empty.

    The piston's RMS is about its mean: what path-length control has to follow.
    """

    acquired_s: float
    vernier_s: float
    rms_px: dict[str, float]
    measured_rms_px: dict[str, float]
    judged_s: float
    piston_rms_m: float
    mode_times: dict[str, float]
    frames: int
    speed_x: float


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
        self.plants = {
            # Each loop's plant gets a seed of its own from the run's.
            name: Plant(
                rig, name, [seed + 1000 * index], star_offset_px=offset, history_s=history_s
            )
            for index, name in enumerate(rig.loops)
        }
        self.camera = SimulatedCamera(rig, self.clock, self.plants)
        loops = {}
        for name, plant in self.plants.items():
            mirror = SimulatedMirror(plant, self.clock, rig, name)
            counts = rig.loops[name].siderostat.encoder_counts_per_rev
            loops[name] = LoopDevices(
                SimulatedAmplifiers(plant, self.clock, counts), dac=mirror, piezo=mirror
            )
        self.ticks: list[Tick] = []
        self.mode_changes: list[ModeChange] = []
        self._also = record
        self.devices = Devices(self.camera, loops)
        self.supervisor = Supervisor(rig, self.devices, self.clock, InlineExecutor(), self._take)
        self.camera.on_servo_period = [
            (work.period_s, work.period) for work in self.supervisor.periodic
        ]

    def _take(self, record: AnyRecord) -> None:
        if isinstance(record, Tick):
            self.ticks.append(record)
        elif isinstance(record, ModeChange):
            self.mode_changes.append(record)
        if self._also is not None:
            self._also(record)

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
    for plant in simulation.plants.values():
        plant.advance(plant.constants.step_s)  # compiles, before the time is taken
    started = shown = time.perf_counter()
    simulation.acquire()
    while simulation.clock.now_s() < duration_s:
        simulation.run(rig.camera.period_s)
        if time.perf_counter() - shown > 0.1:
            shown = time.perf_counter()
            on_progress(simulation.clock.now_s() / duration_s)
    speed_x = simulation.clock.now_s() / (time.perf_counter() - started)
    return {name: _judge(simulation, name, speed_x) for name in rig.loops}


def _judge(simulation: Simulation, name: str, speed_x: float) -> SimulationResult:
    changes = [change for change in simulation.mode_changes if change.loop == name]
    ticks = [tick for tick in simulation.ticks if tick.loop == name]
    end_s = simulation.clock.now_s()
    reached = {change.target: change.time_s for change in reversed(changes)}
    vernier_s = reached.get(Mode.VERNIER.name, math.nan)
    start_s = vernier_s + SETTLE_S
    judged = [t for t in ticks if t.time_s >= start_s and t.star_visible]
    true_px = true_residual_rms(
        simulation.plants[name], simulation.supervisor.loops[name].target_px, start_s, end_s
    )
    measured = np.array([[t.error_az_px, t.error_el_px] for t in judged]).reshape(-1, 2)
    return SimulationResult(
        acquired_s=reached.get(Mode.COARSE.name, math.nan),
        vernier_s=vernier_s,
        rms_px=pair(true_px),
        measured_rms_px=pair(rms(measured)),
        judged_s=max(0.0, end_s - start_s) if judged else 0.0,
        piston_rms_m=piston_rms_m(simulation.plants[name], start_s, end_s),
        mode_times=_mode_times(changes, end_s),
        frames=sum(tick.number >= 0 for tick in ticks),
        speed_x=speed_x,
    )


def true_residual_rms(plant: Plant, target_px: Floats, start_s: float, end_s: float) -> Floats:
    """RMS distance of the pointing spot from `target_px` in continuous time, shape (2,); nan if empty."""
    if not start_s < end_s:
        return np.full(2, math.nan)
    return rms(plant.history_px(start_s, end_s)[:, 0, 0, :] - target_px)


def piston_rms_m(plant: Plant, start_s: float, end_s: float) -> float:
    """RMS of the mirror's piston (Eq. 4) about its mean; nan if the time is empty."""
    if not start_s < end_s:
        return math.nan
    return float(np.std(plant.history_piston_m(start_s, end_s)[:, 0]))


def rms(values: Floats) -> Floats:
    """Root of the mean square down the first axis; nan without values."""
    if len(values) == 0:
        return np.full(values.shape[1:], math.nan)
    return np.asarray(np.sqrt(np.mean(values**2, axis=0)))


def pair(values: Floats) -> dict[str, float]:
    """Two axes by name."""
    return {"az": float(values[0]), "el": float(values[1])}


def _mode_times(changes: list[ModeChange], end_s: float) -> dict[str, float]:
    """Seconds spent in each mode."""
    times = dict.fromkeys((mode.name for mode in Mode), 0.0)
    mode, since_s = Mode.OFF.name, 0.0
    for change in changes:
        times[mode] += change.time_s - since_s
        mode, since_s = change.target, change.time_s
    times[mode] += end_s - since_s
    return times
