"""The mock testbed: every mock device of a rig around its plant, in one process, on 127.0.0.1 only.

Nothing here knows a protocol: devices are wired to the plant as the cables would be. The D/A's outputs
are the piezo amplifier's external inputs; the amplifier's outputs are the stacks; the drive turns the
motors; the camera looks at the spots; the photodiodes give their volts to the LabJack's inputs; the
hexapod carries the collector.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Sequence
from functools import partial
from operator import itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Cia402Device, LoopMocks, Rig
from fitctl.mocks.amplifiers import amplifier_mock, endpoint_keys
from fitctl.mocks.bench import Bench, FaultTable
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.c887.server import C887ControllerMock
from fitctl.mocks.cia402.slcan import SlcanAdapter
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.mdt693.server import Mdt693Mock
from fitctl.mocks.modbus_dac.server import ModbusDacMock
from fitctl.model.image.pixel_noise import pixel_normals
from fitctl.model.image.scene import Scene
from fitctl.model.metrology.part import BeamState
from fitctl.model.plant import Plant
from fitctl.model.plant_step import PlantState

_HOUSEKEEPING_S = 0.05


class LivePlant:
    """A plant at the wall clock's time; advanced whenever a device looks at it or acts on it.

    Parameters
    ----------
    plant : Plant
        One run only.
    started_s : float
        Host's monotonic time of the plant's zero.
    """

    def __init__(self, plant: Plant, started_s: float) -> None:
        self.plant = plant
        self.started_s = started_s
        self._siderostats: list[LiveSiderostat] = []
        self._platform: Platform | None = None
        self._planned_s = 0.0
        self._diode_samples = 0

    def siderostat(self, loop_name: str, command_timeout_s: float) -> LiveSiderostat:
        """The motors of one loop; `command_timeout_s` as :class:`LiveSiderostat` has it."""
        made = LiveSiderostat(self, self.plant.loops[loop_name].inputs, command_timeout_s)
        self._siderostats.append(made)
        return made

    def now_s(self) -> float:
        """The plant's time that it is now."""
        return time.monotonic() - self.started_s

    def carry_collector(self, platform: Platform) -> None:
        """The collector stands on this hexapod's platform, whose time is :meth:`now_s`."""
        self._platform = platform

    def advance(self) -> None:
        """Bring the plant to now.

        On the way there motors stop where their last velocity command had run out, and the collector follows
        the hexapod.
        """
        now_s = self.now_s()
        changes: list[tuple[float, Callable[[], None]]] = [
            (motors.command_ends_s, motors.run_out)
            for motors in self._siderostats
            if motors.runs_out_by(now_s)
        ]
        if self._platform is not None and self.plant.collector is not None:
            follow = self.plant.collector.follow
            plans = self._platform.plans_since(self._planned_s)
            changes += [(began_s, partial(follow, plan)) for began_s, plan in plans]
            self._planned_s = plans[-1][0] if plans else self._planned_s
        for time_s, change in sorted(changes, key=itemgetter(0)):
            self.plant.advance(time_s)
            change()
        self.plant.advance(now_s)

    def exposure_px(self, middle_s: float) -> NDArray[np.float64]:
        """All spots at all instants of a recent exposure, by its host time, shape (instants * spots, 2)."""
        return self.plant.exposure_px(middle_s - self.started_s)[0]

    def pixel_noise_dn(self, host_s: float) -> float:
        """Standard deviation of the camera's dark pixels at a host time."""
        return self.plant.pixel_noise_dn(host_s - self.started_s)

    def diode_volts(self, loop_name: str, host_s: float) -> list[float]:
        """Volts of one loop's photodiodes with their noise at a recent host time: az+, az-, el+, el-."""
        self.advance()
        part = self.plant.metrology_loops[loop_name]
        self._diode_samples += 1
        noise = pixel_normals(part.noise_keys[0], self._diode_samples, 4)
        volts = part.diode_volts(host_s - self.started_s)[0] + part.sensor.noise_v * noise
        return list(volts.tolist())

    def set_laser(self, loop_name: str, power: float) -> None:
        """Power of one loop's laser over its nominal power, from now on."""
        self.advance()
        self.plant.metrology_loops[loop_name].inputs.laser[:] = power

    def set_stack_v(self, loop_name: str, volts: Sequence[float]) -> None:
        """Stack volts of one loop in the D/A's scale, from now on."""
        self.advance()
        self.plant.stellar_loops[loop_name].inputs.stack_v[0] = volts


class LiveSiderostat:
    """The two motors of a siderostat in a plant at the wall clock's time.

    Parameters
    ----------
    live : LivePlant
    inputs : PlantState or BeamState
        Of the siderostat's loop.
    command_timeout_s : float
        Motors stop when no velocity command came for this long, as a drive in cyclic velocity mode
        does without its cycle. It also keeps a motor from running on while this process stands still.

    Attributes
    ----------
    command_ends_s : float
        Until then, in the plant's time, the last velocity command holds.
    velocity_rad_s : array, shape (2,)
        Of the plant's motors.
    """

    def __init__(
        self, live: LivePlant, inputs: PlantState | BeamState, command_timeout_s: float
    ) -> None:
        self.command_ends_s = 0.0
        self.velocity_rad_s = inputs.velocity_rad_s[0]
        self._motor_rad = inputs.motor_rad[0]
        self._live = live
        self._commanded_rad_s = np.zeros(2)
        self._enabled = np.zeros(2, dtype=bool)
        self._command_timeout_s = command_timeout_s

    def runs_out_by(self, now_s: float) -> bool:
        """Whether motors turn by a command that holds no longer."""
        return now_s > self.command_ends_s and bool(np.any(self.velocity_rad_s))

    def run_out(self) -> None:
        """Stop the motors."""
        self.velocity_rad_s[:] = 0.0

    def position_rad(self) -> tuple[float, float]:
        """Motor angles now."""
        self._live.advance()
        az, el = self._motor_rad
        return float(az), float(el)

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Motor velocities, as far as the axes are enabled; good for the command time-out."""
        self._commanded_rad_s[:] = az, el
        self._apply()

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Power of one motor; without it the motor brakes and stays."""
        self._enabled[axis] = enabled
        self._apply()

    def _apply(self) -> None:
        self._live.advance()
        self.command_ends_s = self._live.now_s() + self._command_timeout_s
        self.velocity_rad_s[:] = np.where(self._enabled, self._commanded_rad_s, 0.0)


class _SharedAdapter:
    """The SLCAN adapter of a bus with several drives; its wire has faults of its own."""

    def __init__(self, drives: dict[str, Cia402Device]) -> None:
        self.drives = drives
        self.faults = Faults(WIRE_FAULTS)
        self.adapter = SlcanAdapter(next(iter(drives.values())).bitrate, self.faults)


class StarTestbed:
    """Mock D/A and piezo amplifier of one stellar loop, wired to its mirror's stacks."""

    def __init__(self, rig: Rig, name: str, mocks: LoopMocks, live: LivePlant) -> None:
        fsm = rig.stellar_loops[name].fsm
        straight = [1, 2, 3]
        dac_channels = fsm.dac.channels or straight
        piezo_channels = fsm.piezo.channels or straight

        def to_stacks(volts: Sequence[float]) -> None:
            live.set_stack_v(name, [volts[n - 1] / fsm.piezo.gain for n in piezo_channels])

        def to_amplifier(volts: Sequence[float]) -> None:
            cables = dict(zip(piezo_channels, dac_channels, strict=True))
            self.piezo.set_external_input_v([volts[cables[n] - 1] for n in straight])

        self.piezo = Mdt693Mock(mocks.mdt693, fsm.piezo, to_stacks, port=mocks.mdt693_port)
        self.dac = ModbusDacMock(fsm.dac, mocks.dac, to_amplifier, port=mocks.modbus_port)


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
        self._live = LivePlant(Plant(rig, [seed]), started_s)
        self._drive_names = {
            name: loop.siderostat.device.driver for name, loop in rig.loops.items()
        }
        self._siderostats = {
            name: self._live.siderostat(name, loop.drive_command_timeout_s)
            for name, loop in mocks.loops.items()
        }
        self._buses = [_SharedAdapter(drives) for drives in rig.can_buses if len(drives) > 1]
        on_buses = {name: bus.adapter for bus in self._buses for name in bus.drives}
        self._drives = {
            name: amplifier_mock(
                loop.siderostat, mocks.loops[name], self._siderostats[name], on_buses.get(name)
            )
            for name, loop in rig.loops.items()
        }
        self._slcan_ports = {name: loop.slcan_port for name, loop in mocks.loops.items()}
        self._stars = {
            name: StarTestbed(rig, name, loop, self._live)
            for name, loop in mocks.stellar_loops.items()
        }
        self._labjacks = {
            name: LabJackT7Mock(
                rig.metrology_loops[name].sensor.device,
                loop.labjack,
                partial(self._live.diode_volts, name),
                set_laser=partial(self._live.set_laser, name),
                seed=seed,
            )
            for name, loop in mocks.metrology_loops.items()
        }
        self._hexapod = None
        if rig.collector is not None and mocks.hexapod is not None:
            self._hexapod = C887ControllerMock(mocks.hexapod, self._live.now_s)
            self._live.carry_collector(self._hexapod.platform)
        self._scene = Scene(
            rig.camera,
            [spot for name in rig.stellar_loops for spot in truth.stellar_loops[name].spots],
            truth.hot_pixels,
            truth.exposure_instants,
        )
        self._exposures = 0
        self._mirrored = mocks.camera.mirrored
        self._quarter_turns = mocks.camera.quarter_turns
        self._camera = GigeCameraMock(
            rig.true_camera,
            mocks.camera,
            picture or self._render,
            port=mocks.gvcp_port,
            smears=truth.exposure_instants > 1,
        )
        self._fault_plan = mocks.faults
        devices = {"camera": self._camera.faults}
        devices |= {f"{name}.drive": drive.faults for name, drive in self._drives.items()}
        for name, star in self._stars.items():
            devices |= {f"{name}.dac": star.dac.faults, f"{name}.mdt693": star.piezo.faults}
        devices |= {f"{next(iter(bus.drives))}.adapter": bus.faults for bus in self._buses}
        devices |= {f"{name}.labjack": one.faults for name, one in self._labjacks.items()}
        if self._hexapod is not None:
            devices["hexapod"] = self._hexapod.faults
        self._faults = FaultTable(devices)
        self._bench = Bench(
            rig.name,
            self._live.plant,
            self._faults,
            started_s,
            mocks.bench_port,
            or_any_port=bench_at_any_port,
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
        self._live.advance()  # compiles the kernels before anyone waits for an answer
        self._render(seen_s)  # and the camera's
        endpoints: dict[str, Any] = {
            "camera.device.address": "127.0.0.1",
            "camera.device.gvcp_port": await self._camera.start(),
            "mocks.bench_port": self._bench.start(),
        }
        for name, drive in self._drives.items():
            endpoints |= endpoint_keys(self._drive_names[name], name, await drive.start())
        for bus in self._buses:
            port = await bus.adapter.start(self._slcan_ports[next(iter(bus.drives))])
            for name in bus.drives:
                endpoints |= endpoint_keys("cia402", name, port)
        for name, star in self._stars.items():
            piezo = await star.piezo.start()
            dac = await star.dac.start()
            endpoints |= {
                f"loops.{name}.fsm.dac.host": "127.0.0.1",
                f"loops.{name}.fsm.dac.port": dac.tcp_port,
                f"loops.{name}.fsm.piezo.port": f"socket://127.0.0.1:{piezo.tcp_port}",
                f"mocks.loops.{name}.dac_pty": dac.pty_path,
                f"mocks.loops.{name}.mdt693_pty": piezo.pty_path,
            }
        for name, labjack in self._labjacks.items():
            endpoints |= {
                f"loops.{name}.sensor.device.host": "127.0.0.1",
                f"loops.{name}.sensor.device.port": await labjack.start(),
            }
        if self._hexapod is not None:
            hexapod = await self._hexapod.start()
            endpoints |= {
                "collector.hexapod.port": f"socket://127.0.0.1:{hexapod.tcp_port}",
                "mocks.hexapod_pty": hexapod.pty_path,
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
        for drive in self._drives.values():
            await drive.stop()
        for bus in self._buses:
            await bus.adapter.stop()
        for star in self._stars.values():
            await star.dac.stop()
            await star.piezo.stop()
        for labjack in self._labjacks.values():
            await labjack.stop()
        if self._hexapod is not None:
            await self._hexapod.stop()
        await self._bench.stop()

    def _render(self, mid_exposure_s: float) -> NDArray[np.uint16]:
        self._exposures += 1
        picture = self._scene.frame(
            self._live.exposure_px(mid_exposure_s),
            self._live.plant.pixel_key,
            self._exposures,
            self._live.pixel_noise_dn(mid_exposure_s),
        )
        mirrored = picture[:, ::-1] if self._mirrored else picture
        return np.ascontiguousarray(np.rot90(mirrored, -self._quarter_turns))

    async def _keep_up(self) -> None:
        """Advance in small pieces also without a request, so that none waits for an hour's steps."""
        while True:
            self._live.advance()
            await asyncio.sleep(_HOUSEKEEPING_S)
