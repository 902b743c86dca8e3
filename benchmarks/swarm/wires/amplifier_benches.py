"""The siderostat's amplifiers against their mocks over a bad wire."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any

import can

from benchmarks.swarm.wires.bench import SLACK_S, Bench, Course, Mistaken, Modbus, rig_of
from benchmarks.swarm.wires.wire import Trouble, WireTime
from fitctl.drivers.bal_analog.driver import BalAnalogAmplifiers
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.ensemble.driver import EnsembleAmplifiers
from fitctl.drivers.interface import ServoReading
from fitctl.mocks.bal_analog.station import BalAnalogMockStation
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import OK, CanFrame, decode_frame
from fitctl.mocks.ensemble.controller import CYCLE_S, EnsembleControllerMock, LineSplitter

_SPEED_RAD_S = 3.0


class Motors:
    """Two ideal motors, at different angles."""

    def __init__(self, time: WireTime) -> None:
        self._time = time
        self._angle_rad = [7.0, -11.0]
        self._velocity_rad_s = (0.0, 0.0)
        self._enabled = [False, False]
        self.had_power = [Course(), Course()]
        for course in self.had_power:
            course.add(time.now_s, False)
        self._at_s = time.now_s

    def position_rad(self) -> tuple[float, float]:
        """Both angles."""
        now_s = self._time.now_s
        for axis, velocity in enumerate(self._velocity_rad_s):
            self._angle_rad[axis] += velocity * (now_s - self._at_s) * self._enabled[axis]
        self._at_s = now_s
        az_rad, el_rad = self._angle_rad
        return az_rad, el_rad

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Turn at these velocities."""
        self.position_rad()
        self._velocity_rad_s = (az, el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Switch the current on or off."""
        self.position_rad()
        self._enabled[axis] = enabled
        self.had_power[axis].add(self._time.now_s, enabled)


class AmplifierBench(Bench):
    """The siderostat's amplifiers."""

    rig = "fit-mock.toml"
    options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        rig = rig_of(self.rig, *self.settings())
        self.siderostat: Any = rig.loops["right"].siderostat
        self.mocks: Any = rig.mock_parts()[1].loops["right"]
        super().__init__(time, troubles, **self.options)
        self.motors = Motors(time)
        self._velocity = 0
        self.most_s = 60 * self.siderostat.device.response_timeout_s + 2.0
        self.calls = [self._exchange] * 6 + [self._enable, self._disable, self._reset]
        self._course = Course()
        self._watch()

    def settings(self) -> Sequence[str]:
        """``key.path=value`` texts that replace values of the rig file."""
        return ()

    def _watch(self) -> None:
        self._course.add(self.time.now_s, self.motors.position_rad())
        self.time.call_later(0.001, self._watch)

    def _enable(self) -> None:
        self._obeyed(self.driver.enable, powered=True)

    def _disable(self) -> None:
        self._obeyed(self.driver.disable, powered=False)

    def _reset(self) -> None:
        self._obeyed(self.driver.reset_fault, powered=False)

    def _obeyed(self, command: Callable[[], None], *, powered: bool) -> None:
        """Give a command, during which each axis must have come to have power, or to have none."""
        begin_s = self.time.now_s
        command()
        for axis, had_power in enumerate(self.motors.had_power):
            if powered not in had_power.between(begin_s, self.time.now_s):
                msg = f"axis {axis} {'enabled' if powered else 'disabled'}, is not"
                raise Mistaken(msg)

    def _exchange(self) -> None:
        self._velocity += 1
        rad_s = _SPEED_RAD_S * math.sin(0.3 * self._velocity)
        reading: ServoReading | None = self.driver.exchange((rad_s, -rad_s))
        if reading is None:
            return
        if not self.time.now_s - 5.0 < reading.time_s <= self.time.now_s:
            msg = f"a reading of {reading.time_s - self.time.now_s:.3f} s from now"
            raise Mistaken(msg)
        # An encoder rounds down, and the reading's time is uncertain by the response timeout.
        count_rad = 2 * math.tau / self.siderostat.encoder_counts_per_rev
        uncertain_s = self.siderostat.device.response_timeout_s
        near = self._course.between(
            reading.time_s - uncertain_s - SLACK_S, reading.time_s + uncertain_s + SLACK_S
        )
        for axis, position_rad in enumerate(reading.position_rad):
            angles_rad = [both[axis] for both in near] + [self.motors.position_rad()[axis]]
            if not min(angles_rad) - count_rad <= position_rad <= max(angles_rad) + count_rad:
                had = f"{min(angles_rad):.3f} to {max(angles_rad):.3f}"
                msg = f"axis {axis} read at {position_rad:.3f} rad, was at {had}"
                raise Mistaken(msg)


class BalAnalogBench(AmplifierBench):
    """Analogue amplifiers behind Modbus/TCP I/O."""

    rig = "fit-bal-analog.toml"

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        settings = self.mocks.bal_analog
        self._mock = BalAnalogMockStation(self.siderostat, settings, self.motors)
        self._modbus = Modbus(self._mock._server, self.wire.answer)
        self.driver = BalAnalogAmplifiers(self.siderostat)

    def hear(self, data: bytes) -> None:
        """Pass Modbus requests to the device."""
        self._modbus.hear(data)

    def reboot(self) -> None:
        """Restart with safe outputs."""
        self._mock._fault_changed("reboot")


class EnsembleBench(AmplifierBench):
    """An Ensemble on its ASCII interface."""

    rig = "ensemble.toml"
    options = MappingProxyType({"has_numbers": False})

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        settings = self.mocks.ensemble
        self._reply_s = settings.reply_s
        self._mock = EnsembleControllerMock(self.siderostat, settings, self.motors)
        self._mock._stepped_s = time.now_s
        self._mock._run_cycle()
        self._mock._cycle.set_period(CYCLE_S)
        self._lines = LineSplitter()
        self.driver = EnsembleAmplifiers(self.siderostat)

    def hear(self, data: bytes) -> None:
        """Pass commands, one on each line, to the device."""
        for line in self._lines.feed(data):
            if line.strip():
                answer = self._mock._answer(line.decode("ascii", "replace"))
                self.time.call_later(self._reply_s, self.wire.answer, answer)

    def reboot(self) -> None:
        """Restart without power, as at power-up."""
        self._mock._fault_changed("reboot")
        self._lines.clear()


class Cia402Bench(AmplifierBench):
    """A CANopen drive."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        self._mock = Cia402DriveMock(self.siderostat, self.motors, port=0, adapter=self)  # pyrefly: ignore[bad-argument-type]
        self._mock._control.set_period(0.002)
        self._mock._reset_communication()
        self.driver = Cia402Amplifiers(self.siderostat)

    def settings(self) -> Sequence[str]:
        """Use a virtual bus instead of SLCAN: the bus itself is the wire."""
        return ("loops.right.siderostat.device.interface=virtual",)

    def attach(self, received: Callable[[CanFrame], None]) -> None:
        """Called as the adapter: register the drive's receiver."""
        self._received = received

    def send_line(self, line: bytes) -> None:
        """Called as the adapter: the drive sends a frame."""
        frame = decode_frame(line.rstrip(b"\r"))
        self.wire.answer(
            can.Message(arbitration_id=frame.can_id, data=frame.data, is_extended_id=False)
        )

    def hear(self, data: Any) -> None:
        """Pass one frame to the device."""
        self._received(CanFrame(data.arbitration_id, bytes(data.data)))

    def reboot(self) -> None:
        """Restart without power, as at power-up."""
        self._mock._power_off()
        self._mock._reset_communication()


class SlcanBench(Cia402Bench):
    """A CANopen drive behind an SLCAN adapter: the wire is the adapter's own connection."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        self._unfinished = b""
        self._answers: bytes | None = None
        super().__init__(time, troubles)

    def settings(self) -> Sequence[str]:
        """As the rig file has it."""
        return ()

    def send_line(self, line: bytes) -> None:
        """A frame of the drive, with the answers of the segment that it comes in."""
        if self._answers is None:
            self.wire.answer(line)
        else:
            self._answers += line

    def hear(self, data: Any) -> None:
        """Pass frames on, and answer each line."""
        *lines, self._unfinished = (self._unfinished + data).split(OK)
        self._answers = b""
        for line in lines:
            self._answers += OK
            if line[:1] == b"t":
                frame = decode_frame(line)
                self._received(frame)
        answers, self._answers = self._answers, None
        self.wire.answer(answers)
