"""Each driver against its mock over a bad wire: answers are matched to their requests, and every call ends.

A call returns a value or raises a `DeviceError` within a time limit. The device had the returned value at some
time during the call. A command that raised no error has taken effect when the call returns.

Known limitations: the tests leave out what a protocol cannot distinguish. Answers over Modbus RTU, RS-232 and
the Ensemble's ASCII interface have no number. There, a duplicate arrives together with the original, and on a
serial line no answer arrives after the driver has stopped waiting for late ones.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import closing
from functools import partial
from random import Random
from typing import Any

import numpy as np

from benchmarks.swarm.wires.amplifier_benches import (
    BalAnalogBench,
    Cia402Bench,
    EnsembleBench,
    SlcanBench,
)
from benchmarks.swarm.wires.bench import PAUSES_S, Bench, Course, Mistaken, Modbus, rig_of
from benchmarks.swarm.wires.camera_bench import drawn_camera_run, run_camera
from benchmarks.swarm.wires.wire import KINDS, Trouble, Wire, WireTime, virtual
from fitctl.config import Rig
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.interface import DeviceError, Pose
from fitctl.drivers.labjack_t7.driver import LabJackT7
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.mocks.c887.controller import Controller as C887Controller
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.c887.server import CommandSplitter
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.mdt693.amplifier import Amplifier
from fitctl.mocks.mdt693.controller import Controller
from fitctl.mocks.modbus import pdu as modbus_pdu
from fitctl.mocks.modbus.rtu import frame as rtu_frame
from fitctl.mocks.modbus.rtu import parse_frame
from fitctl.mocks.modbus_dac.server import ModbusDacMock

_MDT693_S = 0.02  # from a command to its answer
_V_PER_S, _AROUND_S = 0.2, 40.0  # slope and period of photodiode voltages that encode the time
_UNSURE_S = 0.015  # uncertainty of that time
_NEAR_MM = 1e-4  # and degrees


class DacBench(Bench):
    """The D/A over Modbus/TCP."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        self._set_up(rig_of())
        self._modbus = Modbus(self._mock._tcp, self.wire.answer)
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
        rig = rig_of(
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
        rig = rig_of("fit-mock.toml", "mocks.loops.right.mdt693.readback_settling_s=0")
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
        self._number = 0
        self._controller = Controller(settings, self._amplifier)
        self._limit_v = piezo.limit_v
        self._pending = b""
        self.driver = Mdt693(piezo)
        self.calls = [self._volts, self._limit]
        self.most_s = 60 * piezo.response_timeout_s

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
        self._number += 1
        self._amplifier.set_external_input_v([1 + (self._number + i) % 5 for i in range(3)])
        volts = self.driver.stack_volts()
        true_v = np.array(self._amplifier.outputs_v)
        if not np.abs(volts - true_v).max() < 2.5:  # it measures with an offset and noise
            msg = f"stacks read {volts}, have {true_v}"
            raise Mistaken(msg)

    def _limit(self) -> None:
        if abs(self.driver.limit_v() - self._limit_v) > 1.0:
            msg = f"limit is not {self._limit_v}"
            raise Mistaken(msg)


class LabJackBench(Bench):
    """The converter of the photodiodes."""

    def __init__(self, time: WireTime, troubles: Iterator[Trouble | None]) -> None:
        super().__init__(time, troubles)
        rig = rig_of("fit-testbed.toml")
        mocks: Any = rig.mock_parts()[1]
        device = rig.metrology_loops["metrology"].sensor.device
        settings = mocks.loops["metrology"].labjack
        self._mock = LabJackT7Mock(device, settings, self._true_v)
        self._modbus = Modbus(self._mock._server, self.wire.answer)
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
        rig = rig_of("fit-testbed.toml", "mocks.hexapod.referenced=true")
        device: Any = rig.collector.hexapod  # pyrefly: ignore[missing-attribute]
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
    holder: list[Bench] = []
    # The mock's timers need the wire's event loop, but the bench makes the wire.
    wire = _Deferred(lambda: holder[0].wire)
    with virtual(time, wire):  # pyrefly: ignore[bad-argument-type]
        bench = BENCHES[name](time, iter(troubles))
        holder.append(bench)
        with closing(bench.driver):
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
    return troubles, [(random.randrange(100), random.choice(PAUSES_S)) for _ in range(60)]


def _camera_night(random: Random) -> dict[str, int]:
    return run_camera(*drawn_camera_run(random))


def _night(name: str, random: Random) -> dict[str, int]:
    return run_wire(name, *drawn_run(random))


NIGHTS: dict[str, Callable[[Random], dict[str, int]]] = {
    name: partial(_night, name) for name in BENCHES
} | {"camera": _camera_night}
"""By name of the driver: calls and troubles drawn at random; counts the outcomes of the calls."""
