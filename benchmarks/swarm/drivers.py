"""Each driver against its mock over a bad wire: answers are matched to their requests, and every call ends.

A call returns a value or raises a `DeviceError` within a time limit. The device had the returned value at some
time during the call. A command that raised no error has taken effect when the call returns.

Known limitations: the tests leave out what a protocol cannot distinguish. Answers over Modbus RTU, RS-232 and
the Ensemble's ASCII interface have no number. There, a duplicate arrives together with the original, and on a
serial line no answer arrives after the driver has stopped waiting for late ones.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from random import Random
from types import MappingProxyType
from typing import Any

import can
import numpy as np

from benchmarks.swarm.wires import KINDS, Trouble, Wire, WireTime, virtual
from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.drivers.bal_analog.driver import BalAnalogAmplifiers
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.ensemble.driver import EnsembleAmplifiers
from fitctl.drivers.interface import DeviceError, Pose, ServoReading
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.mocks.bal_analog.station import BalAnalogMockStation
from fitctl.mocks.c887.controller import Controller as C887Controller
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.c887.server import CommandSplitter
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import OK, CanFrame, decode_frame
from fitctl.mocks.ensemble.controller import CYCLE_S, EnsembleControllerMock, LineSplitter
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.mdt693.amplifier import Amplifier
from fitctl.mocks.mdt693.controller import Controller
from fitctl.mocks.modbus import pdu as modbus_pdu
from fitctl.mocks.modbus.rtu import frame as rtu_frame
from fitctl.mocks.modbus.rtu import parse_frame
from fitctl.mocks.modbus.tcp import ModbusTcpServer, pop_message
from fitctl.mocks.modbus_dac.server import ModbusDacMock

RIGS = default_rig_path().parent
_SLACK_S = 2e-3
_MDT693_S = 0.02  # from a command to its answer
_SPEED_RAD_S = 3.0
_V_PER_S, _AROUND_S = 0.2, 40.0  # slope and period of photodiode voltages that encode the time
_UNSURE_S = 0.015  # uncertainty of that time
_NEAR_MM = 1e-4  # and degrees
_PAUSES_S = (0.0, 0.002, 0.02, 0.3)


class Mistaken(AssertionError):
    """A driver returned a value that its device did not have, or a call took too long."""


class Motors:
    """Two ideal motors, at different angles."""

    def __init__(self, time: WireTime) -> None:
        self._time = time
        self._angle_rad = [7.0, -11.0]
        self._velocity_rad_s = (0.0, 0.0)
        self._enabled = [False, False]
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


class Course:
    """The values that a device had, and since when."""

    def __init__(self) -> None:
        self._values: list[tuple[float, Any]] = []

    def add(self, time_s: float, value: Any) -> None:
        """Record a new value from this time on."""
        self._values.append((time_s, value))

    def between(self, begin_s: float, end_s: float) -> list[Any]:
        """All values between two times."""
        values = self._values
        nexts = [time_s for time_s, _ in values[1:]] + [math.inf]
        return [
            value
            for (since_s, value), until_s in zip(values, nexts, strict=True)
            if since_s <= end_s and until_s >= begin_s
        ]


class Bench:
    """A driver, a mock behind a wire, and the calls to make.

    Attributes
    ----------
    driver : driver
    calls : list of callable
        Calls of the driver; each checks its own result.
    most_s : float
        Maximum duration of a call.
    """

    driver: Any
    calls: list[Callable[[], None]]
    most_s: float

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None], **options: Any) -> None:
        self.time = time
        self.wire = Wire(time, troubles, self.hear, self.reboot, **options)

    def hear(self, data: Any) -> None:
        """Pass data to the device."""
        raise NotImplementedError

    def reboot(self) -> None:
        """Restart the device."""
        raise NotImplementedError


def _rig(name: str = "fit-mock.toml", *settings: str) -> Rig:
    return load_rig(RIGS / name, list(settings))


class _Modbus:
    """Splits a TCP stream into requests and answers each."""

    def __init__(self, server: ModbusTcpServer, wire: Callable[[bytes], None]) -> None:
        self._server = server
        self._answer = wire
        self._pending = bytearray()

    def hear(self, data: bytes) -> None:
        self._pending += data
        while (request := pop_message(self._pending)) is not None:
            self._answer(self._server.respond(request))


class DacBench(Bench):
    """The D/A over Modbus/TCP."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        self._set_up(_rig())
        self._modbus = _Modbus(self._mock._tcp, self.wire.answer)
        self.driver = ModbusDac(self._dac)

    def _set_up(self, rig: Rig) -> None:
        mocks: Any = rig.mock_parts()[1]
        self._course = Course()
        self._dac = rig.stellar_loops["right"].fsm.dac
        settings = mocks.loops["right"].dac
        self._mock = ModbusDacMock(self._dac, settings, self._changed, port=0)
        self._changed(self._mock.outputs_v)
        self._number = 0
        self.calls = [self._write, self._write, self._read, self._send_only]
        self.most_s = 16 * self._dac.response_timeout_s + 1.0

    def _changed(self, volts: Sequence[float]) -> None:
        self._course.add(self.time.now_s, tuple(volts))

    def hear(self, data: bytes) -> None:
        """Pass Modbus requests to the device."""
        self._modbus.hear(data)

    def reboot(self) -> None:
        """Restart with safe outputs."""
        self._mock._fault_changed("reboot")

    def _next_v(self) -> np.ndarray:
        self._number += 1
        return np.array([0.1, 0.2, 0.3]) + 0.01 * (self._number % 900)

    def _send_only(self) -> None:
        self.driver.send_v(self._next_v())

    def _write(self) -> None:
        volts, begin_s = self._next_v(), self.time.now_s
        self.driver.send_v(volts)
        self.driver.confirm()
        self._check("confirmed", volts, begin_s)

    def _read(self) -> None:
        begin_s = self.time.now_s
        self._check("read", self.driver.read_v(), begin_s)

    def _check(self, what: str, volts: np.ndarray, begin_s: float) -> None:
        had = self._course.between(begin_s, self.time.now_s)
        if not any(np.abs(volts - one).max() <= self._dac.step_v for one in had):
            msg = f"D/A {what} {volts}, had {had}"
            raise Mistaken(msg)


class RtuBench(DacBench):
    """The D/A over Modbus RTU."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        rig = _rig(
            "fit-mock.toml",
            "loops.right.fsm.dac.transport=rtu",
            "loops.right.fsm.dac.serial_port=/dev/ttyUSB7",
        )
        timeout_s = rig.stellar_loops["right"].fsm.dac.response_timeout_s
        Bench.__init__(
            self, time, troubles, has_numbers=False, is_serial=True, most_late_s=1.9 * timeout_s
        )
        self._set_up(rig)
        self.driver = ModbusDac(self._dac)

    def hear(self, data: bytes) -> None:
        """Pass one frame to the device."""
        request = parse_frame(data)
        if request is None or request[0] != self._dac.device_id:
            return
        answer = modbus_pdu.answer(request[1], self._mock._rtu._model)
        self.wire.answer(rtu_frame(request[0], answer))


class Mdt693Bench(Bench):
    """The piezo amplifier on RS-232."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        rig = _rig()
        mocks: Any = rig.mock_parts()[1]
        piezo = rig.stellar_loops["right"].fsm.piezo
        super().__init__(
            time,
            troubles,
            has_numbers=False,
            is_serial=True,
            most_late_s=0.9 * piezo.response_timeout_s,
        )
        settings = mocks.loops["right"].mdt693
        self._amplifier = Amplifier(settings, piezo.gain, lambda _volts: None, time.time)
        self._amplifier.set_external_input_v([1.0, 4.0, 6.0])
        self._controller = Controller(settings, self._amplifier)
        self._limit_v = piezo.limit_v
        self._pending = b""
        self.driver = Mdt693(piezo)
        self.calls = [self._volts, self._limit]
        self.most_s = 60 * piezo.response_timeout_s
        time.sleep(60.0)  # until its measurements settle

    def hear(self, data: bytes) -> None:
        """Pass commands, each ended by a CR, to the device."""
        *commands, self._pending = (self._pending + data).split(b"\r")
        for command in commands:
            answer = self._controller.answer(command.decode("ascii", "replace"))
            self.time.call_later(_MDT693_S, self.wire.answer, answer.encode("ascii"))

    def reboot(self) -> None:
        """Restart as at power-up."""
        self._controller.power_up()
        self._pending = b""

    def _volts(self) -> None:
        volts = self.driver.stack_volts()
        true_v = np.array(self._amplifier.outputs_v)
        if not np.abs(volts - true_v).max() < 2.5:  # it measures with an offset and noise
            msg = f"stacks read {volts}, have {true_v}"
            raise Mistaken(msg)

    def _limit(self) -> None:
        if abs(self.driver.limit_v() - self._limit_v) > 1.0:
            msg = f"limit is not {self._limit_v}"
            raise Mistaken(msg)


class AmplifierBench(Bench):
    """The siderostat's amplifiers."""

    rig = "fit-mock.toml"
    options: Mapping[str, Any] = MappingProxyType({})

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        rig = _rig(self.rig, *self.settings())
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
        self.driver.enable()

    def _disable(self) -> None:
        self.driver.disable()

    def _reset(self) -> None:
        self.driver.reset_fault()

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
            reading.time_s - uncertain_s - _SLACK_S, reading.time_s + uncertain_s + _SLACK_S
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
        self._modbus = _Modbus(self._mock._server, self.wire.answer)
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
        self._mock = Cia402DriveMock(self.siderostat, self.motors, port=0, adapter=self)  # type: ignore[arg-type]
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


class LabJackBench(Bench):
    """The converter of the photodiodes."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        rig = _rig("fit-testbed.toml")
        mocks: Any = rig.mock_parts()[1]
        device = rig.metrology_loops["metrology"].sensor.device
        settings = mocks.loops["metrology"].labjack
        self._mock = LabJackT7Mock(device, settings, self._true_v)
        self._modbus = _Modbus(self._mock._server, self.wire.answer)
        self.driver = LabJackT7(device)
        self.calls = [self._sample] * 4 + [self._receive]
        self._asked_s: list[float] = []
        self.most_s = 20 * device.response_timeout_s + 1.0

    def hear(self, data: bytes) -> None:
        """Pass Modbus requests to the device."""
        self._modbus.hear(data)

    def reboot(self) -> None:
        """Restart with the input settings of power-up."""
        for setting, values in self._mock._values.items():
            values[:] = [setting.default] * len(values)

    def _true_v(self, time_s: float) -> Sequence[float]:
        """Voltages that encode the time."""
        return [0.2 * place + _V_PER_S * (time_s % _AROUND_S) for place in range(4)]

    def _sample(self) -> None:
        self._asked_s.append(self.time.now_s)
        self.driver.send_request()
        self._receive()

    def _receive(self) -> None:
        reading = self.driver.receive()
        if reading is None:
            return
        sampled_s = [
            reading.time_s
            + ((volts - 0.2 * place) / _V_PER_S - reading.time_s + _AROUND_S / 2) % _AROUND_S
            - _AROUND_S / 2
            for place, volts in enumerate(reading.volts)
        ]
        if max(sampled_s) - min(sampled_s) > _UNSURE_S:
            msg = f"photodiodes of different times: {reading.volts}"
            raise Mistaken(msg)
        # The driver dates a sample midway between answer and request, the last one before the sample.
        asked_s = [one for one in self._asked_s if one <= sampled_s[0] + _UNSURE_S]
        if not asked_s or not asked_s[-1] - _UNSURE_S <= reading.time_s <= self.time.now_s:
            msg = f"a sample of {sampled_s[0]:.4f} s is dated {reading.time_s:.4f} s"
            raise Mistaken(msg)


class HexapodBench(Bench):
    """The collector's hexapod on RS-232."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        rig = _rig("fit-testbed.toml", "mocks.hexapod.referenced=true")
        device: Any = rig.collector.hexapod  # type: ignore[union-attr]
        settings: Any = rig.mock_parts()[1].hexapod
        super().__init__(
            time,
            troubles,
            has_numbers=False,
            is_serial=True,
            most_late_s=1.9 * device.response_timeout_s,
        )
        self._settings = settings
        self._platform = Platform(settings, time.time)
        self._start()
        self._moves = 0
        self._most_mm_s = device.velocity_limit_mm_s
        self.driver = C887Hexapod(device)
        self.calls = [self._pose, self._pose, self._pose, self._move, self._stop, self._reference]
        self.most_s = 30 * device.response_timeout_s + device.reference_timeout_s

    def _start(self) -> None:
        self._controller = C887Controller(self._settings, self._platform)
        self._commands = CommandSplitter()
        self._answered_s = 0.0

    def hear(self, data: bytes) -> None:
        """Pass commands to the device, which answers in their order."""
        for command in self._commands.feed(data):
            answer = self._controller.answer(command)
            if answer is not None:
                at_s = max(self._answered_s, self.time.now_s) + self._settings.reply_s
                self._answered_s = at_s
                self.time.call_at(at_s, self.wire.answer, answer)

    def reboot(self) -> None:
        """Restart where it stands, without a reference."""
        self._platform.power_up()
        self._start()

    def _pose(self) -> None:
        begin_s = self.time.now_s
        reading = self.driver.pose()
        if not reading.referenced:  # the platform cannot say where it is
            return
        times_s = np.linspace(begin_s, self.time.now_s, 50)
        near = np.array([self._platform.true_pose_at(time_s) for time_s in times_s])
        low, high = near.min(axis=0) - _NEAR_MM, near.max(axis=0) + _NEAR_MM
        if not np.all((low <= reading.pose) & (reading.pose <= high)):
            msg = f"platform read at {reading.pose}, was within {low} and {high}"
            raise Mistaken(msg)

    def _move(self) -> None:
        self._moves += 1
        pose = Pose(0.01 * (self._moves % 90), -0.01 * (self._moves % 70), 0.0, 0.0, 0.0, 0.0)
        self.driver.move_to(pose, self._most_mm_s * (0.5 + 0.5 * (self._moves % 2)))
        target = self._platform.target()
        if not np.allclose(list(target.values()), pose, atol=_NEAR_MM):
            msg = f"platform sent to {pose}, goes to {target}"
            raise Mistaken(msg)

    def _stop(self) -> None:
        self.driver.stop()
        if any(self._platform.moving().values()):
            msg = "platform stopped, moves"
            raise Mistaken(msg)

    def _reference(self) -> None:
        self.driver.reference()
        if not self._platform.referenced:
            msg = "platform referenced, is not"
            raise Mistaken(msg)


BENCHES: dict[str, Callable[[WireTime, Iterator[Trouble | None]], Bench]] = {
    "D/A over Modbus/TCP": DacBench,
    "D/A over Modbus RTU": RtuBench,
    "MDT693": Mdt693Bench,
    "analogue amplifiers": BalAnalogBench,
    "Ensemble": EnsembleBench,
    "CiA 402": Cia402Bench,
    "CiA 402 over SLCAN": SlcanBench,
    "LabJack T7": LabJackBench,
    "C-887": HexapodBench,
}
"""By name of the driver."""


def run_wire(
    name: str, troubles: Sequence[Trouble | None], calls: Sequence[tuple[int, float]]
) -> dict[str, int]:
    """Make calls, each after a pause, over a wire with these troubles; count the outcomes by name of the error.

    Raises
    ------
    Mistaken
        If a driver matched an answer to the wrong request, or a call took too long.
    Exception
        Any other error of a call that is not a `DeviceError`.
    """
    time, ended = WireTime(), dict[str, int]()
    coming: Iterator[Trouble | None] = iter(troubles)
    holder: list[Bench] = []

    def troubles_once_open() -> Iterator[Trouble | None]:
        yield from coming

    # The mock's timers need the wire's event loop, but the bench makes the wire.
    wire = _Deferred(lambda: holder[0].wire)
    with virtual(time, wire):  # type: ignore[arg-type]
        bench = BENCHES[name](time, troubles_once_open())
        holder.append(bench)
        is_open = False
        for number, pause_s in calls:
            time.sleep(pause_s)
            call = bench.calls[number % len(bench.calls)] if is_open else bench.driver.open
            began_s, outcome = time.now_s, "value"
            try:
                call()
                is_open = True
            except DeviceError as error:
                outcome, is_open = type(error).__name__, False
            took_s = time.now_s - began_s
            if took_s > bench.most_s:
                msg = f"a call took {took_s:.2f} s, at most {bench.most_s:.2f} s"
                raise Mistaken(msg)
            ended[outcome] = ended.get(outcome, 0) + 1
        bench.driver.close()
    return ended


class _Deferred:
    """The wire of a bench, before the bench exists."""

    def __init__(self, wire: Callable[[], Wire]) -> None:
        self._wire = wire

    def __getattr__(self, name: str) -> Any:
        return getattr(self._wire(), name)


def drawn_run(random: Random) -> tuple[list[Trouble | None], list[tuple[int, float]]]:
    """Draw troubles and calls."""
    part = random.choice((0.02, 0.1, 0.3))
    kinds = random.sample(KINDS, random.randint(1, len(KINDS)))
    troubles = [
        Trouble(random.choice(kinds), 10 ** random.uniform(-3.5, 0.3))
        if random.random() < part
        else None
        for _ in range(2000)
    ]
    return troubles, [(random.randrange(100), random.choice(_PAUSES_S)) for _ in range(60)]
