"""Simulated devices: behind the drivers' interfaces, on the plant, with their delays and quantization."""

from __future__ import annotations

import heapq
import math
from collections import deque
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import C887Device, C887Mock, Rig
from fitctl.drivers.interface import (
    AzEl,
    CameraCounts,
    DeviceIdentity,
    DeviceRefused,
    DiodeReading,
    Frame,
    HexapodReading,
    Pose,
    ServoReading,
    beyond_travel,
)
from fitctl.model.hexapod_motion import MotionLimits, Trajectory, at_rest, plan_move, plan_stop
from fitctl.model.image.pixel_noise import pixel_normals
from fitctl.model.image.scene import Scene
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.model.stellar_part import StellarPart

Floats = NDArray[np.float64]
_STILL: AzEl = (0.0, 0.0)
DIODE_BITS = 16  # of a LabJack T7's converter at its fastest; others are finer


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

    def __init__(
        self, plant: StellarPart | MetrologyPart, clock: VirtualClock, counts_per_rev: int
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._motor_rad = plant.state.motor_rad[0]
        self._motor_rad_s = plant.state.motor_rad_s[0]
        self._velocity_rad_s = plant.inputs.velocity_rad_s[0]
        self._commanded_rad_s: AzEl = _STILL
        self._position_rad: AzEl = _STILL
        self._at_rest = False
        self._rad_per_count = 2 * math.pi / counts_per_rev
        self._enabled = False

    def open(self) -> DeviceIdentity:
        """Nothing to connect; the next exchange reads where the motors are."""
        self._at_rest = False
        return _identity("amplifiers")

    def enable(self) -> None:
        """Follow velocity commands."""
        self._enabled = True

    def disable(self) -> None:
        """Stand still."""
        self._enabled = False
        self._velocity_rad_s[:] = self._commanded_rad_s = _STILL

    def reset_fault(self) -> None:
        """There are none."""

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading:
        """Command and read at the present virtual time.

        Motors that stand still stay where they are, so that the plant need not go on for their sake.
        """
        now_s = self._clock.now_s()
        if not self._at_rest or velocity_rad_s != _STILL:
            self._plant.advance(now_s)
            if self._enabled and velocity_rad_s != self._commanded_rad_s:
                self._velocity_rad_s[0], self._velocity_rad_s[1] = velocity_rad_s
                self._commanded_rad_s = velocity_rad_s
            self._read()
        return ServoReading(now_s, self._position_rad, self._enabled, "")

    def _read(self) -> None:
        """Count, and notice whether the motors have come to rest: to the last bit, for a rate only decays."""
        az_rad, el_rad = self._motor_rad.tolist()
        az_rad_s, el_rad_s = self._motor_rad_s.tolist()
        count = self._rad_per_count
        self._position_rad = (
            math.floor(az_rad / count) * count,
            math.floor(el_rad / count) * count,
        )
        coasted_rad = az_rad + az_rad_s, el_rad + el_rad_s  # in a second, which no motor coasts
        self._at_rest = self._commanded_rad_s == _STILL and coasted_rad == (az_rad, el_rad)

    def close(self) -> None:
        """Stand still."""
        self.disable()


class SimulatedMirror:
    """D/A and piezo amplifier in one: volts, quantized and limited, on the plant's stacks."""

    def __init__(self, plant: StellarPart, clock: VirtualClock, rig: Rig, loop_name: str) -> None:
        fsm = rig.stellar_loops[loop_name].fsm
        self._plant = plant
        self._clock = clock
        self._stack_v = plant.inputs.stack_v[0]
        self._step_v = fsm.dac.step_v
        self._gain = fsm.piezo.gain
        self._limit_v = fsm.piezo.limit_v
        self._most_v = fsm.piezo.limit_v / fsm.piezo.gain

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("mirror")

    def send_v(self, volts: Floats) -> None:
        """Set the stacks at the present virtual time."""
        self._plant.advance(self._clock.now_s())
        step_v, most_v = self._step_v, self._most_v
        self._stack_v[:] = [min(round(volt / step_v) * step_v, most_v) for volt in volts.tolist()]

    def confirm(self) -> None:
        """Done when it was sent."""

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


class SimulatedPhotodiodes:
    """Photodiodes behind an A/D converter at the other end of a link: noise, quantization and delay."""

    def __init__(self, plant: MetrologyPart, clock: VirtualClock, rig: Rig, loop_name: str) -> None:
        truth, _ = rig.mock_parts()
        self._plant = plant
        self._clock = clock
        self._round_trip_s = truth.metrology_loops[loop_name].link_round_trip_s
        self._range_v = rig.metrology_loops[loop_name].sensor.device.range_v
        self._step_v = 2 * self._range_v / 2**DIODE_BITS
        self._requested_s: deque[float] = deque()
        self._samples = 0  # never starts again: noise must not repeat

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        self._requested_s.clear()
        return _identity("photodiodes")

    def send_request(self) -> None:
        """Ask for a sample; it is of the middle of the round trip."""
        self._requested_s.append(self._clock.now_s())

    def receive(self) -> DiodeReading | None:
        """The newest sample that has arrived by now."""
        newest_s = None
        while self._requested_s and self._arrived(self._requested_s[0]):
            newest_s = self._requested_s.popleft() + self._round_trip_s / 2
        return None if newest_s is None else DiodeReading(newest_s, self._volts(newest_s))

    def close(self) -> None:
        """Nothing to disconnect."""

    def _arrived(self, requested_s: float) -> bool:
        return requested_s + self._round_trip_s <= self._clock.now_s() + 1e-9

    def _volts(self, time_s: float) -> tuple[float, float, float, float]:
        self._samples += 1
        noise = pixel_normals(self._plant.noise_keys[0], self._samples, 4)
        volts = self._plant.diode_volts(time_s)[0] + self._plant.sensor.noise_v * noise
        within_v = np.minimum(np.maximum(volts, -self._range_v), self._range_v)
        steps = np.rint(within_v / self._step_v)
        az_plus, az_minus, el_plus, el_minus = (steps * self._step_v).tolist()
        return az_plus, az_minus, el_plus, el_minus


class SimulatedHexapod:
    """The hexapod under the collector, which moves as its controller would plan it."""

    def __init__(
        self, plant: CollectorPart, clock: VirtualClock, device: C887Device, mock: C887Mock
    ) -> None:
        self._plant = plant
        self._clock = clock
        self._ends = device.travel.ends
        self._limits = MotionLimits(
            mock.velocity_limit_mm_s,
            mock.velocity_limit_deg_s,
            mock.acceleration_mm_s2,
            mock.acceleration_deg_s2,
        )
        self._trajectory = at_rest(np.zeros(6))
        self._referenced = mock.referenced
        self._reference_ends_s = -math.inf

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("hexapod")

    def reference(self, is_wanted: Callable[[], bool] = lambda: True) -> None:
        """Begin to go to where all axes are at zero; the real one returns when it is there."""
        self._go_to(Pose(), self._limits)
        self._referenced = True
        self._reference_ends_s = self._trajectory.ends_s

    def move_to(self, pose: Pose, velocity_mm_s: float) -> None:
        """Start a move from where it is, or give a running one a new target.

        Raises
        ------
        DeviceRefused
            If the hexapod is not referenced, or the pose is beyond the travel.
        """
        if not self._referenced:
            raise self._refusal("a referenced hexapod", "one that is not", "reference it first")
        for name, value, low, high in beyond_travel(pose, self._ends):
            raise self._refusal(
                f"{name} within {low:g} and {high:g}", f"{value:g}", "choose a nearer pose"
            )
        velocity_mm_s = min(velocity_mm_s, self._limits.velocity_mm_s)
        self._go_to(pose, self._limits._replace(velocity_mm_s=velocity_mm_s))

    def pose(self) -> HexapodReading:
        """Where it is."""
        now_s = self._clock.now_s()
        pose = Pose(*self._trajectory.pose_at(now_s).tolist())
        moving = now_s < self._trajectory.ends_s
        return HexapodReading(now_s, pose, moving, self._referenced, servos_on=True, error="")

    def stop(self) -> None:
        """Brake where it is; without the end of its reference move it is not referenced."""
        self._referenced = self._referenced and self._clock.now_s() >= self._reference_ends_s
        self._follow(plan_stop(self._trajectory, self._clock.now_s(), self._limits))

    def close(self) -> None:
        """A move that runs goes on."""

    def _go_to(self, pose: Pose, limits: MotionLimits) -> None:
        self._follow(plan_move(self._trajectory, self._clock.now_s(), pose, limits))

    def _follow(self, trajectory: Trajectory) -> None:
        self._plant.advance(self._clock.now_s())
        self._trajectory = trajectory
        self._plant.follow(trajectory)

    def _refusal(self, expected: str, got: str, hint: str) -> DeviceRefused:
        return DeviceRefused("hexapod", "simulation", expected, got, hint)


def simulated_hexapod(plant: Plant, clock: VirtualClock, rig: Rig) -> SimulatedHexapod | None:
    """The hexapod of a rig that has a collector."""
    _, mocks = rig.mock_parts()
    if rig.collector is None or plant.collector is None or mocks.hexapod is None:
        return None
    return SimulatedHexapod(plant.collector, clock, rig.collector.hexapod, mocks.hexapod)


class SimulatedCamera:
    """Frames of one scene; waiting for one moves the virtual clock on, servo period by servo period."""

    def __init__(self, rig: Rig, clock: VirtualClock, plant: Plant) -> None:
        truth, _ = rig.mock_parts()
        self.on_servo_period: list[tuple[float, Callable[[], None]]] = []
        self._camera = rig.true_camera
        self._clock = clock
        self._plant = plant
        self._scene = Scene(
            rig.camera,
            [spot for name in plant.stellar_loops for spot in truth.stellar_loops[name].spots],
            truth.hot_pixels,
            truth.exposure_instants,
        )
        self._pixel_key = plant.pixel_key
        self._exposures = 0  # never starts again, as the frames' numbers do: noise must not repeat
        self._frames = 0
        self._start_s = 0.0
        self._period_s = self._camera.period_s
        self._due: list[tuple[float, int]] = []  # a heap: when, and which

    def open(self) -> DeviceIdentity:
        """Nothing to connect."""
        return _identity("camera")

    def start(self) -> None:
        """The first exposure begins now."""
        self._frames = 0
        self._period_s = self._camera.period_s
        self._start_s = self._clock.now_s() + self._camera.exposure_s / 2
        now_s = self._clock.now_s()
        self._due = [(now_s + work[0], which) for which, work in enumerate(self.on_servo_period)]
        heapq.heapify(self._due)

    def next_frame(self, timeout_s: float) -> Frame | None:
        """Go on to the next frame's arrival, or by `timeout_s`."""
        exposed_s = self._start_s + self._frames * self._period_s
        arrives_s = exposed_s + self._camera.frame_delay_s
        now_s = self._clock.now_s()
        if arrives_s > now_s + timeout_s + 1e-9:
            if timeout_s > 0.0:
                self._go_on_to(now_s + timeout_s)
            return None
        self._go_on_to(arrives_s)
        self._frames += 1
        self._exposures += 1
        spots = self._plant.exposure_px(exposed_s)[0]
        noise_dn = self._plant.pixel_noise_dn(exposed_s)
        image = self._scene.frame(spots, self._pixel_key, self._exposures, noise_dn)
        return Frame(self._frames, exposed_s, self._clock.now_s(), image)

    def set_frame_rate(self, rate_hz: float) -> None:
        """Expose a new period after the last frame, and so on."""
        last = self._frames - 1
        self._start_s += last * self._period_s
        self._period_s = 1 / rate_hz
        self._start_s -= last * self._period_s

    def counts(self) -> CameraCounts:
        """Nothing is ever lost here."""
        return CameraCounts(self._frames, 0, 0)

    def stop(self) -> None:
        """Nothing to stop."""

    def close(self) -> None:
        """Nothing to disconnect."""

    def _go_on_to(self, time_s: float) -> None:
        due, works, sleep_until = self._due, self.on_servo_period, self._clock.sleep_until
        due_s, which = due[0]
        while due_s <= time_s:
            period_s, run = works[which]
            sleep_until(due_s)
            run()
            heapq.heapreplace(due, (due_s + period_s, which))
            due_s, which = due[0]
        sleep_until(time_s)
