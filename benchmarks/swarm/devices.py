"""Devices as bad as real ones: those of :mod:`fitctl.simulation.devices` behind lines that fail.

A device acts by itself whatever becomes of its line: a drive turns on at its last velocity until it misses its
master, and a D/A that is not written to goes to its safe voltages.

Known limitations: a drive without its master stops at once, without a ramp; a reset takes no time.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from random import Random

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.lines import Line
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import Rig
from fitctl.drivers.interface import (
    AzEl,
    CameraCounts,
    DeviceFault,
    DeviceIdentity,
    DeviceMismatch,
    Frame,
    ServoReading,
)
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.model.stellar_part import StellarPart
from fitctl.simulation.devices import SimulatedAmplifiers, SimulatedCamera, SimulatedMirror

Floats = NDArray[np.float64]
_STILL: AzEl = (0.0, 0.0)
_MASTER_LOST = "heartbeat of the master lost"
_MOST_LATE_FRAMES = 20


def _identity(model: str) -> DeviceIdentity:
    return DeviceIdentity("fitctl", f"swarm {model}", "", "")


class SwarmAmplifiers:
    """Both axes' amplifiers behind a bus.

    Parameters
    ----------
    plant : StellarPart or MetrologyPart
    time : VirtualTime
    rig : Rig
    loop_name : str
    random : Random
    commanded : callable
        Hears the loop's name and each velocity that is sent.
    """

    def __init__(
        self,
        plant: StellarPart | MetrologyPart,
        time: VirtualTime,
        rig: Rig,
        loop_name: str,
        random: Random,
        commanded: Callable[[str, AzEl], None],
    ) -> None:
        siderostat = rig.loops[loop_name].siderostat
        device = siderostat.device
        self.name = loop_name
        self.line = Line(
            "siderostat", device.endpoint, time, random, 0.0004, device.response_timeout_s
        )
        self.powered = False
        self.fault = ""
        self.master_timeout_s = getattr(device, "master_heartbeat_timeout_s", 0.5)
        self._period_s = 1.0 / siderostat.servo.rate_hz
        self._alive_s = 3 * getattr(device, "drive_heartbeat_s", 0.1)
        self._time = time
        self._commanded = commanded
        self._inner = SimulatedAmplifiers(plant, time, siderostat.encoder_counts_per_rev)  # type: ignore[arg-type]
        self._last_master_s = -math.inf
        self._heard_s = 0.0
        self._watched = False
        self._late: ServoReading | None = None

    # ------------------------------------------------------------ the driver

    def open(self) -> DeviceIdentity:
        """Connect and configure, which takes many exchanges."""
        self.line.open()
        for _ in range(20):
            self.line.ask(self._nothing)
        self._heard_s = self._time.now_s()
        self._late = None
        self._inner.open()
        return _identity("amplifiers")

    def enable(self) -> None:
        """Power both axes."""
        for _ in range(4):
            self.line.ask(self._nothing)
        self.line.ask(self._power_up)
        if not self.powered:
            raise DeviceFault(
                "siderostat", self.line.endpoint, "both axes enabled", self.fault, "recover"
            )

    def disable(self) -> None:
        """Take power from both axes."""
        self.line.ask(self._power_down)

    def reset_fault(self) -> None:
        """Disable, and clear a latched fault."""
        self.line.ask(self._power_down)
        self.line.ask(self._clear)

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period, which waits for the encoders as long as a period lasts."""
        line, began_s = self.line, self._time.now_s()
        if not line.connected or "unplugged" in line.faults:
            raise line.broken()
        self._commanded(self.name, velocity_rad_s)
        delay_s = line.delay_s()
        if line.faults and self._lost(velocity_rad_s, delay_s, began_s):
            return None
        self._hear(velocity_rad_s)
        reading = self._read()
        if delay_s > self._period_s:
            self._time.sleep_until(began_s + self._period_s)
            late, self._late = self._late, reading
            return late
        self._time.sleep(delay_s)
        if not line.connected:
            raise line.broken()
        self._heard_s = self._time.now_s()
        return reading

    def close(self) -> None:
        """Disable if possible, and disconnect."""
        try:
            if self.line.connected:
                self.line.ask(self._power_down)
        finally:
            self.line.close()

    # ------------------------------------------------------------ the device

    def reset(self) -> None:
        """It restarts: no power, nothing configured, and its encoders count from where they were."""
        self._power_down()
        self.fault = ""
        self.line.connected = False

    def trip(self) -> None:
        """It finds a fault of its own, and takes the power from its motors."""
        self._power_down()
        self.fault = "overcurrent"

    @property
    def velocity_rad_s(self) -> AzEl:
        """What the motors turn by now, as commanded."""
        return self._inner._commanded_rad_s if self.powered else _STILL

    def _nothing(self) -> None:
        pass

    def _power_up(self) -> None:
        if self.fault:
            return
        self._inner.enable()
        self.powered = True
        self._hear(_STILL)

    def _power_down(self) -> None:
        self.powered = False
        self._inner._plant.advance(self._time.now_s())
        self._inner.disable()

    def _clear(self) -> None:
        self.fault = ""

    def _read(self) -> ServoReading:
        reading = self._inner.exchange(self._inner._commanded_rad_s)
        return reading._replace(enabled=self.powered, fault=self.fault)

    def _hear(self, velocity_rad_s: AzEl) -> None:
        """Obey, and watch from now on whether more comes."""
        self._last_master_s = self._time.now_s()
        if self.powered:
            self._inner.exchange(velocity_rad_s)
            if not self._watched:
                self._watched = True
                self._time.call_at(self._last_master_s + self.master_timeout_s, self._watch)

    def _watch(self) -> None:
        due_s = self._last_master_s + self.master_timeout_s
        self._watched = self.powered
        if not self.powered:
            return
        if self._time.now_s() < due_s - 1e-9:
            self._time.call_at(due_s, self._watch)
            return
        self._watched = False
        self._power_down()
        self.fault = _MASTER_LOST

    def _lost(self, velocity_rad_s: AzEl, delay_s: float, began_s: float) -> bool:
        """Whether a fault of the line keeps the answer from coming."""
        faults = self.line.faults
        if not {"deaf", "mute", "garbled", "refuses"} & faults.keys():
            return False
        if "deaf" not in faults:
            self._hear(velocity_rad_s)
        if "garbled" in faults:
            self._time.sleep(min(delay_s, self._period_s))
            raise self.line.garbled()
        self._time.sleep_until(began_s + self._period_s)
        if self._time.now_s() - self._heard_s > self._alive_s:
            raise self.line.timeout()
        return True


class SwarmDac:
    """The D/A behind Modbus, with a watchdog."""

    def __init__(
        self,
        mirror: SimulatedMirror,
        plant: StellarPart,
        time: VirtualTime,
        rig: Rig,
        loop_name: str,
        random: Random,
        written: Callable[[str, Floats, Floats], None],
    ) -> None:
        dac = rig.stellar_loops[loop_name].fsm.dac
        _, mocks = rig.mock_parts()
        self.name = loop_name
        self.line = Line("D/A", dac.endpoint, time, random, 0.0006, dac.response_timeout_s)
        self._mirror = mirror
        self._time = time
        self._written = written
        settings = mocks.loops[loop_name].dac  # type: ignore[union-attr]
        self._watchdog_s, self._safe_v = settings.watchdog_s, settings.safe_v
        self._written_s = -math.inf
        self._watched = False
        self._unconfirmed: tuple[Floats, float] | None = None

    def open(self) -> DeviceIdentity:
        """Connect."""
        self._unconfirmed = None
        self.line.open()
        self.read_v()
        return _identity("D/A")

    def send_v(self, volts: Floats) -> None:
        """Send the voltages, which take effect when they arrive; a write before is confirmed first."""
        self.confirm()
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        self._written(self.name, volts, self._mirror.read_v())
        self._unconfirmed = volts.copy(), self._time.now_s()

    def confirm(self) -> None:
        """Wait until the voltages have been taken."""
        unconfirmed, self._unconfirmed = self._unconfirmed, None
        if unconfirmed is not None:
            volts, _ = unconfirmed
            self.line.ask(lambda: self._set(volts))

    def read_v(self) -> Floats:
        """Read the outputs, three times."""
        self.confirm()
        for _ in range(2):
            self.line.ask(self._mirror.read_v)
        return self.line.ask(self._mirror.read_v)

    def close(self) -> None:
        """Disconnect."""
        self._unconfirmed = None
        self.line.close()

    def reset(self) -> None:
        """It restarts at its safe voltages."""
        self._mirror.send_v(np.full(3, self._safe_v))
        self.line.connected = False

    def _set(self, volts: Floats) -> None:
        self._mirror.send_v(volts)
        self._written_s = self._time.now_s()
        if not self._watched:
            self._watched = True
            self._time.call_at(self._written_s + self._watchdog_s, self._watch)

    def _watch(self) -> None:
        due_s = self._written_s + self._watchdog_s
        if self._time.now_s() < due_s - 1e-9:
            self._time.call_at(due_s, self._watch)
            return
        self._watched = False
        self._mirror.send_v(np.full(3, self._safe_v))


class SwarmPiezo:
    """The piezo amplifier on a serial line: slow, and every answer may be wrong."""

    def __init__(
        self, mirror: SimulatedMirror, time: VirtualTime, rig: Rig, loop_name: str, random: Random
    ) -> None:
        piezo = rig.stellar_loops[loop_name].fsm.piezo
        self.line = Line(
            "piezo amplifier", piezo.port, time, random, 0.03, piezo.response_timeout_s
        )
        self.stuck_stack: int | None = None
        self._limit_v = piezo.limit_v
        self._mirror = mirror

    def open(self) -> DeviceIdentity:
        """Connect and check."""
        self.line.open()
        for _ in range(3):
            self.limit_v()
        return _identity("piezo amplifier")

    def stack_volts(self) -> Floats:
        """Measure; a stuck stack reads its most."""
        volts = np.array([self.line.ask(self._mirror.stack_volts)[stack] for stack in range(3)])
        if self.stuck_stack is not None:
            volts[self.stuck_stack] = self._limit_v
        return volts

    def limit_v(self) -> float:
        """The limit switch."""
        limit_v = self.line.ask(self._mirror.limit_v)
        if not math.isclose(limit_v, self._limit_v):
            raise DeviceMismatch("piezo amplifier", self.line.endpoint, "its limit", "another")
        return limit_v

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """It restarts."""
        self.line.connected = False


class SwarmCamera(SimulatedCamera):
    """The camera behind its network: frames come late, all at once, or not at all."""

    def __init__(self, rig: Rig, time: VirtualTime, plant: Plant, random: Random) -> None:
        super().__init__(rig, time, plant)  # type: ignore[arg-type]
        device = rig.camera.device
        self.line = Line("camera", device.endpoint, time, random, 0.002, device.response_timeout_s)
        self._time = time
        self._streams = False
        self._lost = 0
        self._clear_dn = self._scene._flux_dn

    def dim(self, part: float) -> None:
        """The spots have so much of their light."""
        self._scene._flux_dn = self._clear_dn * part

    def undim(self) -> None:
        """The spots have all of their light."""
        self._scene._flux_dn = self._clear_dn

    def open(self) -> DeviceIdentity:
        """Take control."""
        self.line.open()
        for _ in range(30):
            self.line.ask(self._nothing)
        return _identity("camera")

    def start(self) -> None:
        """Begin the stream."""
        self.line.ask(super().start)
        self._lost = 0
        self._streams = True

    def next_frame(self, timeout_s: float) -> Frame | None:
        """The next frame, which a fault may keep."""
        faults, now_s = self.line.faults, self._time.now_s()
        if not self.line.connected or "unplugged" in faults or "garbled" in faults:
            self._time.sleep(min(timeout_s, 0.01))
            raise self.line.broken()
        exposed_s = self._start_s + self._frames * self._camera.period_s
        late_s = 0.002 * faults.get("slow", 0.0)
        arrives_s = exposed_s + self._camera.frame_delay_s + late_s
        if not self._streams or {"deaf", "mute", "refuses"} & faults.keys():
            self._time.sleep_until(now_s + timeout_s)
            return None
        behind = int((now_s - arrives_s) / self._camera.period_s)
        if behind > _MOST_LATE_FRAMES:  # nobody keeps more
            self._frames += behind
            self._lost += behind
            return self.next_frame(timeout_s)
        if arrives_s > now_s + timeout_s + 1e-9:
            self._time.sleep_until(now_s + timeout_s)
            return None
        self._time.sleep_until(arrives_s)
        self._frames += 1
        self._exposures += 1
        spots = self._plant.exposure_px(exposed_s)[0]
        noise_dn = self._plant.pixel_noise_dn(exposed_s)
        image = self._scene.frame(spots, self._pixel_key, self._exposures, noise_dn)
        return Frame(self._frames, exposed_s, self._time.now_s(), image)

    def counts(self) -> CameraCounts:
        """Frames, and those that were lost."""
        return CameraCounts(self._frames, self._lost, 0)

    def stop(self) -> None:
        """End the stream."""
        self._streams = False

    def close(self) -> None:
        """Give up control."""
        self._streams = False
        self.line.close()

    def reset(self) -> None:
        """It restarts, and streams no more."""
        self._streams = False
        self.line.connected = False

    def _nothing(self) -> None:
        pass
