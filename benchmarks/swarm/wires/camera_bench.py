"""The camera's driver against its mock over a bad network, on virtual time.

Every exposure has a picture of its own, so that a frame of two frames' packets shows. The driver's own thread,
the heartbeat, runs beside its calls.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Coroutine, Sequence
from random import Random
from typing import Any
from unittest.mock import patch

import numpy as np
from greenlet import getcurrent
from numpy.typing import NDArray

from benchmarks.swarm.threads import VirtualTime
from benchmarks.swarm.wires.bench import PAUSES_S, Mistaken, rig_of
from benchmarks.swarm.wires.camera_wire import CAMERA, KINDS, RARE_KINDS, Address, Network, on
from benchmarks.swarm.wires.wire import Trouble
from fitctl.drivers.gige import protocol
from fitctl.drivers.gige.driver import GigeCamera
from fitctl.drivers.gige.gvcp import ATTEMPTS, ControlChannel
from fitctl.drivers.gige.protocol import Command, Register
from fitctl.drivers.interface import CameraCounts, DeviceError, Frame
from fitctl.mocks.gige.camera import GigeCameraMock
from fitctl.mocks.gige.memory import TICKS_PER_S, Feature

_START_S = 1000.0  # a machine that has run for a while
_RESPONSE_S, _HEARTBEAT_S = 0.15, 0.6
_ATTEMPT_S = _RESPONSE_S / ATTEMPTS
_EXCHANGE_S = 2 * _RESPONSE_S + 0.01  # with one of the heartbeat before it; poll() rounds up
_OWN_S = 0.5  # of a call, besides its exchanges
_FRAME_S = 0.06  # time limit of a call for a frame
_DRAIN_S = 0.05  # as fitctl.drivers.gige.driver
_SLACK_S = 0.003  # poll() rounds up to milliseconds
_NOTICED_S = _HEARTBEAT_S + 3 * _RESPONSE_S  # a restart of the camera, by the driver
_DATED_S = 1e-4
_STEP_DN = 7  # between the pictures of two exposures
_PARTS = (0.0, 0.01, 0.05, 0.2)  # of the datagrams that something happens to
_RARE = 0.02  # part of what happens that is of a rare kind


def _result(coroutine: Coroutine[Any, Any, Any]) -> Any:
    """What a coroutine returns that waits for nothing."""
    try:
        coroutine.send(None)
    except StopIteration as end:
        return end.value
    msg = "it waits"
    raise RuntimeError(msg)


class CameraBench:
    """The camera's driver, the mock behind a bad network, and the calls to make."""

    def __init__(self, network: Network) -> None:
        self._time = network.time
        self.network = network
        network.hear, network.reboot = self._hear, self._reboot
        rig = rig_of(
            "fit-mock.toml",
            f"camera.device.response_timeout_s={_RESPONSE_S}",
            f"camera.device.heartbeat_s={_HEARTBEAT_S}",
        )
        mocks: Any = rig.mock_parts()[1]
        camera = rig.camera
        self._pattern = np.arange(camera.width_px * camera.height_px, dtype=np.uint16).reshape(
            camera.height_px, camera.width_px
        )
        self._exposed_s: list[float] = []
        self._mock = GigeCameraMock(camera, mocks.camera, self._render, port=CAMERA[1])
        _result(self._mock.start())
        self._settings = camera
        self.driver = GigeCamera(camera)
        self.calls = [self._frame] * 8 + [
            self._newest_frame,
            self._restart,
            self._registers,
            self._heartbeat,
            self._rate,
        ]
        self._beats = self._rates = 0
        self._last: tuple[int, Frame, CameraCounts] | None = None
        self._healed = 0
        self._first = 0

    # ------------------------------------------------------------ the camera

    def _hear(self, packet: bytes, sender: Address) -> None:
        reply = self._mock.answer(packet, sender)
        if reply is not None:
            self.network.to_host(reply, sender[1], streamed=False)

    def _reboot(self) -> None:
        self._mock._power("reboot")

    def _render(self, middle_s: float) -> NDArray[np.uint16]:
        self._exposed_s.append(middle_s)
        picture: NDArray[np.uint16] = self._pattern + np.uint16(
            _STEP_DN * (len(self._exposed_s) - 1) % 65536
        )
        return picture

    # ------------------------------------------------------------ the calls

    def open(self) -> None:
        """Open the camera, and start its stream."""
        self.network.rebooted_s = math.inf
        identity = self.driver.open()
        if (identity.maker, identity.serial) != ("FIT", "FIT01"):
            msg = f"the camera says it is {identity}"
            raise Mistaken(msg)
        self._start()

    def _start(self) -> None:
        self._last, self._healed = None, 0
        self._first = len(self._exposed_s)
        self.driver.start()
        if not self._mock.acquisition.running and self.network.rebooted_s == math.inf:
            msg = "the stream was started, and does not run"
            raise Mistaken(msg)

    def _restart(self) -> None:
        self.driver.stop()
        self._start()

    def _frame(self) -> None:
        began_s = self._time.now_s()
        frame = self.driver.next_frame(_FRAME_S)
        took_s = self._time.now_s() - began_s
        if took_s > _FRAME_S + _DRAIN_S + _SLACK_S:
            msg = f"a frame was waited for {took_s:.3f} s, not {_FRAME_S:g} s"
            raise Mistaken(msg)
        if frame is not None:
            self._check(frame)
            return
        since_s = max(self.network.rebooted_s, self.network.away_until_s)
        if self._time.now_s() > since_s + _NOTICED_S:
            msg = f"the restart at {self.network.rebooted_s:.3f} s is not noticed"
            raise Mistaken(msg)

    def _newest_frame(self) -> None:
        for _ in range(50):
            frame = self.driver.next_frame(0.0)
            if frame is None:
                break
            self._check(frame)

    def _registers(self) -> None:
        channel = self._channel()
        wanted = {
            Feature.WIDTH: self._settings.width_px,
            Register.TICK_FREQUENCY_LOW: TICKS_PER_S,
            Register.STREAM_PACKET_SIZE: self._settings.device.packet_size_bytes,
        }
        for register, value in wanted.items():
            got = channel.read_register(register)
            if register == Register.STREAM_PACKET_SIZE:
                got &= protocol.PACKET_SIZE_MASK
            if got != value and self.network.rebooted_s == math.inf:
                msg = f"register {register.name} read as {got}, is {value}"
                raise Mistaken(msg)

    def _heartbeat(self) -> None:
        """Write a register, which must then have the value."""
        self._beats += 1
        value_ms = round(1000 * _HEARTBEAT_S) + self._beats
        self._channel().write_register(Register.HEARTBEAT_TIMEOUT_MS, value_ms)
        got_ms = round(1000 * self._mock._parts()[2].heartbeat_s)
        if got_ms != value_ms and self.network.rebooted_s == math.inf:
            msg = f"heartbeat set to {value_ms} ms, is {got_ms} ms"
            raise Mistaken(msg)

    def _rate(self) -> None:
        """Change the frame rate while frames come; the camera must then have it."""
        self._rates += 1
        rate_hz = self._settings.frame_rate_hz * (1.0, 0.96, 0.94)[self._rates % 3]
        self.driver.set_frame_rate(rate_hz)
        registers = self._mock._parts()[2]
        got_hz = registers.double(Feature.FRAME_RATE_HZ)
        if got_hz != rate_hz and self.network.rebooted_s == math.inf:
            msg = f"frame rate set to {rate_hz:g} Hz, is {got_hz:g} Hz"
            raise Mistaken(msg)

    def _channel(self) -> ControlChannel:
        return self.driver._opened()[0]

    # ------------------------------------------------------------ what must be true

    def _check(self, frame: Frame) -> None:
        """The frame is one exposure, dated and numbered as that, and losses are counted."""
        steps = frame.image - self._pattern
        exposure, remainder = divmod(int(steps[0, 0]), _STEP_DN)
        if not np.all(steps == steps[0, 0]) or remainder or exposure >= len(self._exposed_s):
            msg = f"frame {frame.number} is of several: {np.unique(steps)}"
            raise Mistaken(msg)
        clock: Any = self.driver._time
        bound_s = clock._best.error_bound_s(self._time.now_s()) + _DATED_S
        late_s = frame.mid_exposure_s - self._exposed_s[exposure]
        if abs(late_s) > bound_s:
            msg = f"frame {frame.number} is dated {1e3 * late_s:.2f} ms late, at most {1e3 * bound_s:.2f}"
            raise Mistaken(msg)
        counts = self.driver.counts()
        block = exposure - self._first + 1
        if self._last is None:
            right = counts.frames == 1 and 1 <= frame.number <= block
        else:
            before, last, counted = self._last
            step = exposure - before
            right = (
                step >= 1
                and frame.number == last.number + step
                and counts.frames == counted.frames + 1
                and counts.lost == counted.lost + step - 1
            )
        if not right or counts.lost != frame.number - counts.frames:
            msg = f"exposure {block} is frame {frame.number}, after {self._last}, with {counts}"
            raise Mistaken(msg)
        self._last = exposure, frame, counts
        network, port = self.network, self.driver._stream.port  # pyrefly: ignore[missing-attribute]
        self._healed += network.lost[port, block]
        most = sum(number for (to, one), number in network.troubled.items() if to == port and one)
        if not self._healed <= counts.packets_lost <= most:
            msg = f"{counts.packets_lost} lost packets counted, were {self._healed} to {most}"
            raise Mistaken(msg)


def run_camera(
    control: Sequence[Trouble | None],
    stream: Sequence[Trouble | None],
    calls: Sequence[tuple[int, float]],
) -> dict[str, int]:
    """Make calls, each after a pause, over a network with these troubles; count outcomes by error.

    Raises
    ------
    Mistaken
        If a frame, a date, a count or an answer is wrong, or a call takes too long.
    Exception
        Any other error of a call that is not a `DeviceError`.
    """
    time, ended = VirtualTime(), Counter[str]()
    time.run_until(_START_S)
    network = Network(time, iter(control), iter(stream), 0.9 * _ATTEMPT_S)
    failed: list[Exception] = []
    over: list[bool] = []

    def night() -> None:
        try:
            _make_calls(CameraBench(network), time, calls, ended)
        except Exception as error:
            failed.append(error)
        finally:
            over.append(True)

    with on(network):
        time.spawn(night, "driver")
        while not over:
            time.run_until(time.now_s() + 0.5)
        time.end()
    for error in (*failed, *(error for _, error in time.escaped)):
        raise error
    return ended


def _make_calls(
    bench: CameraBench, time: VirtualTime, calls: Sequence[tuple[int, float]], ended: Counter[str]
) -> None:
    mine, exchanges, exchange = getcurrent(), [0], ControlChannel.exchange

    def timed(channel: ControlChannel, command: Command, payload: bytes) -> bytes:
        if getcurrent() is not mine:
            return exchange(channel, command, payload)
        exchanges[0] += 1
        began_s = time.now_s()
        try:
            return exchange(channel, command, payload)
        finally:
            _in_time(command.name, time.now_s() - began_s, _EXCHANGE_S)

    is_open = False
    with patch.object(ControlChannel, "exchange", timed):
        for number, pause_s in calls:
            time.sleep(pause_s)
            call = bench.calls[number % len(bench.calls)] if is_open else bench.open
            began_s, outcome, exchanges[0] = time.now_s(), "value", 0
            try:
                call()
                is_open = True
            except DeviceError as error:
                outcome, is_open = type(error).__name__, False
            most_s = _OWN_S + exchanges[0] * _EXCHANGE_S
            _in_time("a call", time.now_s() - began_s, most_s)
            ended[outcome] += 1
        bench.driver.close()


def _in_time(what: str, took_s: float, most_s: float) -> None:
    if took_s > most_s:
        msg = f"{what} took {took_s:.2f} s, at most {most_s:.2f} s"
        raise Mistaken(msg)


def drawn_camera_run(
    random: Random,
) -> tuple[list[Trouble | None], list[Trouble | None], list[tuple[int, float]]]:
    """Draw troubles of the control channel, of the stream, and calls."""
    calls = [(random.randrange(100), random.choice(PAUSES_S)) for _ in range(60)]
    return _drawn_troubles(random, 4000), _drawn_troubles(random, 8000), calls


def _drawn_troubles(random: Random, most: int) -> list[Trouble | None]:
    part = random.choice(_PARTS)
    kinds = random.sample(KINDS, random.randint(1, len(KINDS)))
    rare = random.sample(RARE_KINDS, random.randint(1, len(RARE_KINDS)))

    def drawn() -> Trouble:
        kind = random.choice(rare if random.random() < _RARE else kinds)
        return Trouble(kind, 10 ** random.uniform(-3.5, 0.3))

    return [drawn() if random.random() < part else None for _ in range(most)]
