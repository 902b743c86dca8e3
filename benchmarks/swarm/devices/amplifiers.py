"""The amplifiers of a siderostat, which may lose their master.

A drive keeps its last velocity until it misses the master's heartbeat.

A CANopen drive that misses its master stops with a fault. The I/O station of analogue amplifiers drops the
enable lines until the next write. An Ensemble has no such watchdog, and turns until it reaches its own limits.

Known limitations: a drive without its master stops at once, without a ramp; a reset takes no time; one encoder
at a time is wrong, that of azimuth reads too much and that of elevation too little.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from random import Random
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.lines import Line, identity
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import Rig
from fitctl.drivers.interface import (
    AzEl,
    DeviceFault,
    DeviceIdentity,
    ServoReading,
)
from fitctl.model.metrology.part import MetrologyPart
from fitctl.model.stellar_part import StellarPart
from fitctl.simulation.devices import (
    SimulatedAmplifiers,
)

Floats = NDArray[np.float64]
_STILL: AzEl = (0.0, 0.0)
_MASTER_LOST = "heartbeat of the master lost"
_SILENCE = frozenset({"deaf", "mute", "refuses", "garbled"})
_USUAL_S = {"cia402": 0.0004, "bal_analog": 0.0006, "ensemble": 0.005}
_LOOK_S = 0.1


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
            self.master_timeout_s = mock.bal_analog.watchdog_s  # pyrefly: ignore[missing-attribute]
        else:
            limit_units = mock.ensemble.software_limit_units  # pyrefly: ignore[missing-attribute]
            self._limit_rad = math.tau * limit_units
        self._period_s = 1.0 / siderostat.servo.rate_hz
        self._alive_s = 3 * getattr(device, "drive_heartbeat_s", 0.1)
        self._time = time
        self._commanded = commanded
        self._powered_unread = powered_unread
        self._encoders_read = encoders_read
        self._was_read = False
        self._inner = SimulatedAmplifiers(plant, time, siderostat.encoder_counts_per_rev)  # pyrefly: ignore[bad-argument-type]
        self._last_master_s = -math.inf
        self._heard_s = 0.0
        self._watched = False
        self._on_the_way: deque[tuple[float, ServoReading]] = deque()  # with its time of arrival
        self._staged_rad_s: AzEl | None = None
        self._sync: tuple[float, float, ServoReading | None, dict[str, float]] | None = None

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
        return identity("amplifiers")

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
        reading, faults = None, self.line.of_this_call()
        if "deaf" not in faults:
            reading = self._hear(velocity_rad_s)
        self._sync = self._time.now_s(), self.line.delay_s(faults), reading, faults

    def exchange(self, velocity_rad_s: AzEl) -> ServoReading | None:
        """One servo period: wait at most that long for the encoder reading."""
        if self._sync is None:
            if self._staged_rad_s is None:
                self.stage(velocity_rad_s)
            self.synchronize()
        line, sync, self._sync = self.line, self._sync, None
        if not line.connected or sync is None:
            raise line.broken()
        sent_s, delay_s, reading, faults = sync
        if faults and faults.keys() & _SILENCE:
            if "garbled" in faults:
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
        """Detect an internal fault and remove power from the motors, until the fault is reset."""
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
        wrong_rad = self.line.wrong_by("encoder")
        if (
            has_power is reading.enabled
            and self.zero_rad is _STILL
            and not self.fault
            and wrong_rad is None
        ):
            return reading  # as at nearly every period
        (az_rad, el_rad), (zero_az_rad, zero_el_rad) = reading.position_rad, self.zero_rad
        if wrong_rad is not None and wrong_rad < 0.0:
            el_rad += wrong_rad
        elif wrong_rad is not None:
            az_rad += wrong_rad
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
            reading = inner.exchange(_STILL if "stuck" in self.line.wrong else velocity_rad_s)
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
