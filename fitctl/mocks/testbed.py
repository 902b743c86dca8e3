"""The mock testbed: every mock device of a rig around its plants, in one process, on 127.0.0.1 only.

Nothing here knows a protocol: devices are wired to the plant as the cables would be. The D/A's outputs
are the piezo amplifier's external inputs; the amplifier's outputs are the stacks; the drive turns the
motors; the camera looks at the spots.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import LoopMocks, Rig
from fitctl.mocks.amplifiers import amplifier_mock, endpoint_keys
from fitctl.mocks.bench import Bench, FaultTable
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.mdt693.server import Mdt693Mock
from fitctl.mocks.modbus_dac.server import ModbusDacMock
from fitctl.model.plant import Plant
from fitctl.model.scene import Scene

_HOUSEKEEPING_S = 0.05


class LivePlant:
    """A plant at the wall clock's time; advanced whenever a device looks at it or acts on it.

    Parameters
    ----------
    plant : Plant
        One run only.
    started_s : float
        Host's monotonic time of the plant's zero.
    command_timeout_s : float
        Motors stop when no velocity command came for this long, as a drive in cyclic velocity mode
        does without its cycle. It also keeps a motor from running on while this process stands still.
    """

    def __init__(self, plant: Plant, started_s: float, command_timeout_s: float) -> None:
        self.plant = plant
        self.started_s = started_s
        self._velocity_rad_s = np.zeros(2)
        self._enabled = np.zeros(2, dtype=bool)
        self._command_timeout_s = command_timeout_s
        self._command_ends_s = 0.0

    def advance(self) -> None:
        """Bring the plant to now; motors stop where their last velocity command had run out."""
        now_s = time.monotonic() - self.started_s
        if now_s > self._command_ends_s and np.any(self.plant.inputs.velocity_rad_s):
            self.plant.advance(self._command_ends_s)
            self.plant.inputs.velocity_rad_s[:] = 0.0
        self.plant.advance(now_s)

    def spots_px(self, host_s: float) -> NDArray[np.float64]:
        """All spots at a recent host time, shape (spots, 2)."""
        return self.plant.spots_px(host_s - self.started_s)[0]

    def set_stack_v(self, volts: Sequence[float]) -> None:
        """Stack volts in the D/A's scale, from now on."""
        self.advance()
        self.plant.inputs.stack_v[0] = volts

    def position_rad(self) -> tuple[float, float]:
        """Motor angles now."""
        self.advance()
        az, el = self.plant.state.motor_rad[0]
        return float(az), float(el)

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Motor velocities, as far as the axes are enabled; good for the command time-out."""
        self._velocity_rad_s[:] = az, el
        self._apply()

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Power of one motor; without it the motor brakes and stays."""
        self._enabled[axis] = enabled
        self._apply()

    def _apply(self) -> None:
        self.advance()
        self._command_ends_s = time.monotonic() - self.started_s + self._command_timeout_s
        self.plant.inputs.velocity_rad_s[0] = np.where(self._enabled, self._velocity_rad_s, 0.0)


class LoopTestbed:
    """Mock devices of one loop: amplifiers, D/A and piezo amplifier, wired to its plant."""

    def __init__(self, rig: Rig, name: str, mocks: LoopMocks, live: LivePlant) -> None:
        loop = rig.stellar_loops[name]
        gain = loop.fsm.piezo.gain
        self.drive_name = loop.siderostat.device.driver
        self.drive = amplifier_mock(loop.siderostat, mocks, live)
        self.piezo = Mdt693Mock(
            mocks.mdt693,
            loop.fsm.piezo,
            lambda volts: live.set_stack_v([volt / gain for volt in volts]),
            port=mocks.mdt693_port,
        )
        self.dac = ModbusDacMock(
            loop.fsm.dac, mocks.dac, self.piezo.set_external_input_v, port=mocks.modbus_port
        )


class Testbed:
    """All mock devices of a rig.

    Parameters
    ----------
    rig : Rig
        Must have its ``plant`` and ``mocks`` sections.
    seed : int
        Of everything random in the plants.
    bench_at_any_port : bool
        Where the bench's own port is taken.
    picture : callable, optional
        What the camera sees in place of the plants' spots: ``picture(mid_exposure_s)``, the uint16 image,
        shape (height_px, width_px), of that host monotonic time.
    """

    def __init__(
        self,
        rig: Rig,
        seed: int,
        *,
        bench_at_any_port: bool = False,
        picture: Callable[[float], NDArray[np.uint16]] | None = None,
    ) -> None:
        truth, mocks = rig.mock_parts()
        started_s = time.monotonic()
        self._plants = {
            # As in the simulation: each loop's plant has a seed of its own from the run's.
            name: LivePlant(
                Plant(rig, name, [seed + 1000 * index]),
                started_s,
                mocks.loops[name].drive_command_timeout_s,
            )
            for index, name in enumerate(rig.loops)
        }
        self._loops = {
            name: LoopTestbed(rig, name, mocks.stellar_loops[name], live)
            for name, live in self._plants.items()
        }
        self._scene = Scene(
            rig.camera,
            [spot for loop in truth.stellar_loops.values() for spot in loop.spots],
            truth.hot_pixels,
        )
        self._pixel_key = next(iter(self._plants.values())).plant.pixel_keys[0]
        self._exposures = 0
        self._camera = GigeCameraMock(
            rig.true_camera, mocks.camera, picture or self._render, port=mocks.gvcp_port
        )
        self._fault_plan = mocks.faults
        devices = {"camera": self._camera.faults}
        for name, loop in self._loops.items():
            devices |= {
                f"{name}.drive": loop.drive.faults,
                f"{name}.dac": loop.dac.faults,
                f"{name}.mdt693": loop.piezo.faults,
            }
        self._faults = FaultTable(devices)
        plants = {name: live.plant for name, live in self._plants.items()}
        self._bench = Bench(
            plants, self._faults, started_s, mocks.bench_port, or_any_port=bench_at_any_port
        )
        self._housekeeping: asyncio.Task | None = None

    async def start(self) -> dict[str, Any]:
        """Start every device.

        Raises
        ------
        UnknownFault
            If the rig file's faults name one that a device does not have.

        Returns
        -------
        dict
            Endpoints by the rig file's keys, ready for ``--set``; the ``mocks`` keys are for those who
            want the pty or the bench.
        """
        self._faults.schedule(self._fault_plan)
        seen_s = time.monotonic()
        for live in self._plants.values():
            live.advance()  # compiles the kernels before anyone waits for an answer
        self._render(seen_s)  # and the camera's
        endpoints: dict[str, Any] = {
            "camera.device.address": "127.0.0.1",
            "camera.device.gvcp_port": await self._camera.start(),
            "mocks.bench_port": self._bench.start(),
        }
        for name, loop in self._loops.items():
            piezo = await loop.piezo.start()
            drive = await loop.drive.start()
            dac = await loop.dac.start()
            prefix = f"loops.{name}"
            endpoints |= endpoint_keys(loop.drive_name, name, drive)
            endpoints |= {
                f"{prefix}.fsm.dac.host": "127.0.0.1",
                f"{prefix}.fsm.dac.port": dac.tcp_port,
                f"{prefix}.fsm.piezo.port": f"socket://127.0.0.1:{piezo.tcp_port}",
                f"mocks.loops.{name}.dac_pty": dac.pty_path,
                f"mocks.loops.{name}.mdt693_pty": piezo.pty_path,
            }
        self._housekeeping = asyncio.create_task(self._keep_up())
        return endpoints

    async def stop(self) -> None:
        """Stop every device and close every socket and pty."""
        if self._housekeeping is not None:
            self._housekeeping.cancel()
            await asyncio.gather(self._housekeeping, return_exceptions=True)
        self._faults.close()
        await self._camera.stop()
        for loop in self._loops.values():
            await loop.drive.stop()
            await loop.dac.stop()
            await loop.piezo.stop()
        await self._bench.stop()

    def _render(self, mid_exposure_s: float) -> NDArray[np.uint16]:
        spots = [live.spots_px(mid_exposure_s) for live in self._plants.values()]
        self._exposures += 1
        return self._scene.frame(np.concatenate(spots), self._pixel_key, self._exposures)

    async def _keep_up(self) -> None:
        """Advance in small pieces also when nobody looks, so that nobody ever waits for an hour's steps."""
        while True:
            for live in self._plants.values():
                live.advance()
            await asyncio.sleep(_HOUSEKEEPING_S)
