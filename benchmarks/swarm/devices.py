"""Devices that fail as real ones do: those of :mod:`fitctl.simulation.devices` behind lines with faults.

A device keeps running when its line fails. A drive keeps its last velocity until it misses the master's
heartbeat. A D/A that receives no writes goes to its safe voltages.

A CANopen drive that misses its master stops with a fault. The I/O station of analogue amplifiers drops the
enable lines until the next write. An Ensemble has no such watchdog, and turns until it reaches its own limits.

Known limitations: a drive without its master stops at once, without a ramp; a reset takes no time.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from functools import partial
from random import Random
from typing import Any

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
    DiodeReading,
    Frame,
    HexapodReading,
    Pose,
    ServoReading,
)
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.plant import Plant
from fitctl.model.stellar_part import StellarPart
from fitctl.simulation.devices import (
    SimulatedAmplifiers,
    SimulatedCamera,
    SimulatedHexapod,
    SimulatedMirror,
    SimulatedPhotodiodes,
)

Floats = NDArray[np.float64]
_STILL: AzEl = (0.0, 0.0)
_MASTER_LOST = "heartbeat of the master lost"
_REFERENCE_S = 5.0
_SILENCE = frozenset({"deaf", "mute", "refuses", "garbled"})
_MOST_LATE_FRAMES = 20
_USUAL_S = {"cia402": 0.0004, "bal_analog": 0.0006, "ensemble": 0.005}
_LOOK_S = 0.1


def _identity(model: str) -> DeviceIdentity:
    return DeviceIdentity("fitctl", f"swarm {model}", "", "")


class SwarmAmplifiers:
    """The amplifiers of both axes, on a bus.

    Parameters
    ----------
    plant : StellarPart or MetrologyPart
    time : VirtualTime
    rig : Rig
    loop_name : str
    random : Random
    commanded : callable
        Called with the loop's name and each velocity sent.
    powered_unread : callable
        Called with the loop's name if the driver powers the motors before it has read an encoder since opening.
    encoders_read : callable
        Called with the loop's name when the driver reads the encoders for the first time since opening.
    """

    def __init__(
        self,
        plant: StellarPart | MetrologyPart,
        time: VirtualTime,
        rig: Rig,
        loop_name: str,
        random: Random,
        commanded: Callable[[str, AzEl], None],
        powered_unread: Callable[[str], None],
        encoders_read: Callable[[str], None],
    ) -> None:
        siderostat = rig.loops[loop_name].siderostat
        device: Any = siderostat.device
        self.name = loop_name
        self._driver = device.driver
        self._enables_by_line = self._driver == "bal_analog"
        usual_s = _USUAL_S[self._driver]
        self.line = Line(
            "siderostat", device.endpoint, time, random, usual_s, device.response_timeout_s
        )
        self.powered = False
        self.fault = ""
        self.zero_rad: AzEl = _STILL  # motor angles at which the encoders read zero
        _, mocks = rig.mock_parts()
        mock = mocks.loops[loop_name]
        self._enables = False  # last state requested of the analogue amplifiers' enable lines
        self._limit_rad = math.inf
        self.master_timeout_s = _LOOK_S
        if self._driver == "cia402":
            self.master_timeout_s = device.master_heartbeat_timeout_s
        elif self._driver == "bal_analog":
            self.master_timeout_s = mock.bal_analog.watchdog_s  # type: ignore[union-attr]
        else:
            limit_units = mock.ensemble.software_limit_units  # type: ignore[union-attr]
            self._limit_rad = math.tau * limit_units
        self._period_s = 1.0 / siderostat.servo.rate_hz
        self._alive_s = 3 * getattr(device, "drive_heartbeat_s", 0.1)
        self._time = time
        self._commanded = commanded
        self._powered_unread = powered_unread
        self._encoders_read = encoders_read
        self._was_read = False
        self._inner = SimulatedAmplifiers(plant, time, siderostat.encoder_counts_per_rev)  # type: ignore[arg-type]
        self._last_master_s = -math.inf
        self._heard_s = 0.0
        self._watched = False
        self._on_the_way: deque[tuple[float, ServoReading]] = deque()  # with its time of arrival
        self._staged_rad_s: AzEl | None = None
        self._sync: tuple[float, float, ServoReading | None] | None = None

    # ------------------------------------------------------------ the driver

    def open(self) -> DeviceIdentity:
        """Connect and configure, in many exchanges."""
        self.line.open()
        self._enables = self._was_read = False
        for _ in range(20):
            self.line.ask(self._nothing)
        self._heard_s = self._time.now_s()
        self._on_the_way.clear()
        self._staged_rad_s = self._sync = None
        self._inner.open()
        return _identity("amplifiers")

    def enable(self) -> None:
        """Power both axes."""
        if not self._was_read:
            self._powered_unread(self.name)
        for _ in range(4):
            self.line.ask(self._nothing)
        self._enables = True
        self.line.ask(self._power_up)
        if not self.powered:
            self._enables = False
            raise DeviceFault(
                "siderostat", self.line.endpoint, "both axes enabled", self.fault, "recover"
            )

    def disable(self) -> None:
        """Remove power from both axes."""
        self._enables = False
        self.line.ask(self._power_down)

    def reset_fault(self) -> None:
        """Disable, and clear a latched fault."""
        self._enables = False
        self.line.ask(self._power_down)
        self.line.ask(self._clear)

    def stage(self, velocity_rad_s: AzEl) -> None:
        """Keep a command for the next synchronization."""
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        self._commanded(self.name, velocity_rad_s)
        self._staged_rad_s = velocity_rad_s

    def synchronize(self) -> None:
        """Send the staged command, if there is one. The drive applies it and reads its encoders."""
        velocity_rad_s, self._staged_rad_s = self._staged_rad_s, None
        if velocity_rad_s is None:
            return
        reading = None
        if "deaf" not in self.line.faults:
            reading = self._hear(velocity_rad_s)
        self._sync = self._time.now_s(), self.line.delay_s(), reading

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: wait at most that long for the encoder reading."""
        if self._sync is None:
            if self._staged_rad_s is None:
                self.stage(velocity_rad_s)
            self.synchronize()
        line, sync, self._sync = self.line, self._sync, None
        if not line.connected or sync is None:
            raise line.broken()
        sent_s, delay_s, reading = sync
        if line.faults and line.faults.keys() & _SILENCE:
            if "garbled" in line.faults:
                self._time.sleep_until(sent_s + min(delay_s, self._period_s))
                raise line.garbled()
            reading = None
        late, on_the_way = self._arrived(), self._on_the_way
        if reading is not None:
            arrives_s = max(sent_s + delay_s, on_the_way[-1][0] if on_the_way else 0.0)
            on_the_way.append((arrives_s, reading))
        within_s = sent_s + self._period_s
        self._time.sleep_until(min(within_s, on_the_way[0][0]) if on_the_way else within_s)
        reading = self._arrived() or late
        if not line.connected:
            raise line.broken()
        if reading is not None:
            if not self._was_read:
                self._was_read = True
                self._encoders_read(self.name)
            self._heard_s = self._time.now_s()
        elif self._time.now_s() - self._heard_s > self._alive_s:
            raise line.timeout()
        return reading

    def _arrived(self) -> ServoReading | None:
        """The newest reading that has arrived."""
        newest = None
        while self._on_the_way and self._on_the_way[0][0] <= self._time.now_s():
            _, newest = self._on_the_way.popleft()
        return newest

    def close(self) -> None:
        """Disable if possible, and disconnect."""
        try:
            if self.line.connected:
                self.line.ask(self._power_down)
        finally:
            self.line.close()

    # ------------------------------------------------------------ the device

    def reset(self) -> None:
        """Restart without power or configuration; the encoders keep their counts."""
        self._power_down()
        self.fault = ""
        self.line.connected = False

    def lose_power(self) -> None:
        """It restarts, and its encoders count from zero wherever the motors are."""
        self.reset()
        self.zero_rad = self._inner.exchange(_STILL).position_rad

    def trip(self) -> None:
        """Detect an internal fault and remove power from the motors."""
        self._power_down()
        self.fault = "overcurrent"

    @property
    def watches_nobody(self) -> bool:
        """Whether it keeps moving when its master falls silent."""
        return self._driver == "ensemble"

    @property
    def velocity_rad_s(self) -> AzEl:
        """The velocity at which the motors turn now, as commanded."""
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
        return self._as_driver_has_it(self._inner.exchange(self._inner._commanded_rad_s))

    def _as_driver_has_it(self, reading: ServoReading) -> ServoReading:
        # Analogue amplifiers have no line that reports an enabled axis.
        has_power = self._enables and not self.fault if self._enables_by_line else self.powered
        if has_power is reading.enabled and self.zero_rad is _STILL and not self.fault:
            return reading  # as at nearly every period
        (az_rad, el_rad), (zero_az_rad, zero_el_rad) = reading.position_rad, self.zero_rad
        position_rad = az_rad - zero_az_rad, el_rad - zero_el_rad
        return ServoReading(reading.time_s, position_rad, has_power, self.fault)

    def _hear(self, velocity_rad_s: AzEl) -> ServoReading:
        """Apply the velocity, restart the watchdog and read the encoders."""
        inner = self._inner
        self._last_master_s = self._time.now_s()
        if self._enables_by_line and self._enables and not (self.powered or self.fault):
            inner.enable()  # the watchdog dropped the enable lines; a write restores them
            self.powered = True
        if self.powered:
            reading = inner.exchange(velocity_rad_s)
            if not self._watched:
                self._watched = True
                self._time.call_at(self._last_master_s + self.master_timeout_s, self._watch)
        else:
            reading = inner.exchange(inner._commanded_rad_s)
        return self._as_driver_has_it(reading)

    def _watch(self) -> None:
        due_s = self._last_master_s + self.master_timeout_s
        self._watched = self.powered
        if not self.powered:
            return
        if self._time.now_s() < due_s - 1e-9:
            self._time.call_at(due_s, self._watch)
            return
        if self._driver == "ensemble":  # no watchdog: only its own limits stop the motors
            if max(map(abs, self._read().position_rad)) > self._limit_rad:
                self._inner.exchange(_STILL)
            self._time.call_at(self._time.now_s() + _LOOK_S, self._watch)
            return
        self._watched = False
        self._power_down()
        if self._driver == "cia402":
            self.fault = _MASTER_LOST


class SwarmDac:
    """The D/A converter on Modbus, with a watchdog."""

    def __init__(
        self,
        mirror: SimulatedMirror,
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
        """Send the voltages after confirming the previous write. They take effect when they arrive."""
        self.confirm()
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        self._written(self.name, volts, self._mirror.read_v())
        self._unconfirmed = volts.copy(), self._time.now_s()

    def confirm(self) -> None:
        """Wait until the station has accepted the voltages."""
        unconfirmed, self._unconfirmed = self._unconfirmed, None
        if unconfirmed is not None:
            volts, _ = unconfirmed
            self.line.ask(lambda: self._set(volts))

    def read_v(self) -> Floats:
        """Read the outputs, in three exchanges."""
        self.confirm()
        for _ in range(2):
            self.line.ask(self._mirror.read_v)
        return self.line.ask(self._mirror.read_v)

    def close(self) -> None:
        """Disconnect."""
        self._unconfirmed = None
        self.line.close()

    def reset(self) -> None:
        """Restart at the safe voltages."""
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
    """The piezo amplifier on a serial line: slow, and any answer may be wrong."""

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
        """Measure the stacks; a stuck stack reads the limit."""
        volts = np.array([self.line.ask(self._mirror.stack_volts)[stack] for stack in range(3)])
        if self.stuck_stack is not None:
            volts[self.stuck_stack] = self._limit_v
        return volts

    def limit_v(self) -> float:
        """Read the limit switch."""
        limit_v = self.line.ask(self._mirror.limit_v)
        if not math.isclose(limit_v, self._limit_v):
            raise DeviceMismatch("piezo amplifier", self.line.endpoint, "its limit", "another")
        return limit_v

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart."""
        self.line.connected = False


class SwarmPhotodiodes(SimulatedPhotodiodes):
    """The photodiodes' converter, on a network."""

    def __init__(
        self, plant: MetrologyPart, time: VirtualTime, rig: Rig, loop_name: str, random: Random
    ) -> None:
        super().__init__(plant, time, rig, loop_name)  # type: ignore[arg-type]
        device = rig.metrology_loops[loop_name].sensor.device
        self.line = Line(
            "photodiodes", device.endpoint, time, random, 0.001, device.response_timeout_s
        )
        self._usual_s = self._round_trip_s

    def open(self) -> DeviceIdentity:
        """Connect and configure."""
        self.line.open()
        for _ in range(6):
            self.line.ask(lambda: None)
        return super().open()

    def send_request(self) -> None:
        """Request a sample."""
        if not self.line.connected or "unplugged" in self.line.faults:
            raise self.line.broken()
        super().send_request()

    def receive(self) -> DiodeReading | None:
        """The newest sample, unless a fault withholds it."""
        faults = self.line.faults
        if not self.line.connected or "unplugged" in faults:
            raise self.line.broken()
        if "garbled" in faults:
            raise self.line.garbled()
        self._round_trip_s = self._usual_s * faults.get("slow", 1.0)
        silent = bool(faults.keys() & _SILENCE)
        reading = None if silent else super().receive()
        now_s = self._clock.now_s()
        if reading is not None or not self._requested_s:
            return reading
        if now_s - self._requested_s[0] > self.line.timeout_s:
            self._requested_s.clear()
            raise self.line.timeout()
        return None

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart."""
        self.line.connected = False


class SwarmHexapod(SimulatedHexapod):
    """The hexapod's controller on a serial line."""

    def __init__(self, plant: Plant, time: VirtualTime, rig: Rig, random: Random) -> None:
        _, mocks = rig.mock_parts()
        device = rig.collector.hexapod  # type: ignore[union-attr]
        super().__init__(plant.collector, time, device, mocks.hexapod)  # type: ignore[arg-type]
        self.line = Line("hexapod", device.endpoint, time, random, 0.01, device.response_timeout_s)
        self._time = time

    def open(self) -> DeviceIdentity:
        """Connect and check."""
        self.line.open()
        for _ in range(10):
            self.line.ask(lambda: None)
        return super().open()

    def reference(self) -> None:
        """Make a reference move, which takes seconds."""
        self.line.ask(lambda: None)
        ends_s = self._time.now_s() + _REFERENCE_S
        while self._time.now_s() < ends_s:
            self._time.sleep(0.1)
            self.line.ask(lambda: None)
        super().reference()

    def move_to(self, pose: Pose, velocity_mm_s: float) -> None:
        """Start a move."""
        self.line.ask(partial(super().move_to, pose, velocity_mm_s))

    def pose(self) -> HexapodReading:
        """Read the pose."""
        return self.line.ask(super().pose)

    def stop(self) -> None:
        """Brake, and wait until the platform is at rest."""
        self.line.ask(super().stop)

    def close(self) -> None:
        """Disconnect."""
        self.line.close()

    def reset(self) -> None:
        """Restart at the present pose, without a reference."""
        super().stop()
        self._referenced = False
        self.line.connected = False

    @property
    def moves(self) -> bool:
        """Whether the platform is moving."""
        return self._time.now_s() < self._trajectory.ends_s


class SwarmCamera(SimulatedCamera):
    """The camera on its network: frames arrive late, all at once, or not at all."""

    def __init__(self, rig: Rig, time: VirtualTime, plant: Plant, random: Random) -> None:
        super().__init__(rig, time, plant)  # type: ignore[arg-type]
        device = rig.camera.device
        self.line = Line("camera", device.endpoint, time, random, 0.002, device.response_timeout_s)
        self._time = time
        self._period_s = rig.camera.period_s
        self._streams = False
        self._lost = 0
        self._clear_dn = self._scene._flux_dn

    def dim(self, part: float) -> None:
        """Dim all spots to a part of their light."""
        self._scene._flux_dn = self._clear_dn * part

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
        """The next frame, unless a fault withholds it."""
        faults, now_s = self.line.faults, self._time.now_s()
        if not self.line.connected or "unplugged" in faults or "garbled" in faults:
            self._time.sleep(min(timeout_s, 0.01))
            raise self.line.broken()
        exposed_s = self._start_s + self._frames * self._period_s
        late_s = 0.002 * faults.get("slow", 0.0)
        arrives_s = exposed_s + self._camera.frame_delay_s + late_s
        if not self._streams or (faults and {"deaf", "mute", "refuses"} & faults.keys()):
            self._time.sleep_until(now_s + timeout_s)
            return None
        behind = int((now_s - arrives_s) / self._period_s)
        if behind > _MOST_LATE_FRAMES:  # no buffer keeps more
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
        """Count the frames, and the lost ones."""
        return CameraCounts(self._frames, self._lost, 0)

    def stop(self) -> None:
        """End the stream."""
        self._streams = False

    def close(self) -> None:
        """Give up control."""
        self._streams = False
        self.line.close()

    def reset(self) -> None:
        """Restart, without a stream."""
        self._streams = False
        self.line.connected = False

    def _nothing(self) -> None:
        pass
