"""Simulated devices: behind the drivers' interfaces, on the plant, with their delays and quantization."""

from __future__ import annotations

import heapq
import math
from collections.abc import Callable
from concurrent.futures import Executor, Future
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import Rig
from fitctl.drivers.interface import (
    AzEl,
    CameraCounts,
    DeviceIdentity,
    Frame,
    ServoReading,
)
from fitctl.model.plant import Plant
from fitctl.model.scene import Scene

Floats = NDArray[np.float64]


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
        self._commanded_rad_s: AzEl = (0.0, 0.0)
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
        self._velocity_rad_s[:] = self._commanded_rad_s = (0.0, 0.0)

    def reset_fault(self) -> None:
        """There are none."""

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading:
        """Command and read at the present virtual time."""
        now_s = self._clock.now_s()
        self._plant.advance(now_s)
        if self._enabled and velocity_rad_s != self._commanded_rad_s:
            self._velocity_rad_s[0], self._velocity_rad_s[1] = velocity_rad_s
            self._commanded_rad_s = velocity_rad_s
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
            [spot for loop in truth.stellar_loops.values() for spot in loop.spots],
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
        now_s = self._clock.now_s()
        if arrives_s > now_s + timeout_s + 1e-9:
            if timeout_s > 0.0:
                self._go_on_to(now_s + timeout_s)
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
        due, works, sleep_until = self._due, self.on_servo_period, self._clock.sleep_until
        while due[0][0] <= time_s:
            due_s, which = due[0]
            period_s, run = works[which]
            sleep_until(due_s)
            run()
            heapq.heapreplace(due, (due_s + period_s, which))
        sleep_until(time_s)
