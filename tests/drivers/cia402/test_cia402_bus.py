"""Several drives on one CAN bus: one connection, one SYNC a period, and each drive by itself."""

import asyncio
import threading
import time
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest
from cia402_bench import STILL, IntegratingMotors, exchange_until, reading_of, wait_until
from serial.urlhandler import protocol_socket

from fitctl import config
from fitctl.clock import MonotonicClock
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.cia402 import link as link_module
from fitctl.drivers.cia402.bus import CanBus
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import DeviceFault, DeviceTimeout, DeviceUnreachable
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.cia402.slcan import SlcanAdapter
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.stages.periodic import PeriodicThread
from fitctl.stages.servo import SiderostatServo
from fitctl.stages.servo_group import ServoGroup

PERIOD_S = 0.002


class SharedBench:
    """Mock drives with the node ids 1, 2, ... on one adapter, and their drivers on one bus."""

    def __init__(self, siderostat, count):
        self._loop = asyncio.new_event_loop()
        self._thread = threading.Thread(target=self._loop.run_forever)
        self._thread.start()
        self.adapter_faults = Faults(WIRE_FAULTS)
        self.frames = []
        self.port = self._run(self._start(siderostat, count))
        self.bus = CanBus()
        self.drivers = [
            Cia402Amplifiers(self._settings(siderostat, node), self.bus)
            for node in range(1, count + 1)
        ]

    def _settings(self, siderostat, node):
        channel = f"socket://127.0.0.1:{getattr(self, 'port', 0)}"
        # Drives that are stopped with this process, as these are, find its heartbeats missing when it goes on.
        changes = {"channel": channel, "node_id": node, "master_heartbeat_timeout_s": 5.0}
        device = siderostat.device.model_copy(update=changes)
        return siderostat.model_copy(update={"device": device})

    async def _start(self, siderostat, count):
        self.adapter = SlcanAdapter(
            siderostat.device.bitrate, self.adapter_faults, self.frames.append
        )
        self.motors = [IntegratingMotors() for _ in range(count)]
        self.mocks = [
            Cia402DriveMock(self._settings(siderostat, node), motors, port=0, adapter=self.adapter)
            for node, motors in enumerate(self.motors, 1)
        ]
        for mock in self.mocks:
            await mock.start()
        return await self.adapter.start(0)

    def _run(self, coroutine):
        return asyncio.run_coroutine_threadsafe(coroutine, self._loop).result(5)

    def fault(self, number, kind):
        async def run():
            self.mocks[number].faults.set(config.Fault(device="drive", kind=kind))

        self._run(run())

    def heal(self):
        async def run():
            for faults in (self.adapter_faults, *(mock.faults for mock in self.mocks)):
                faults.clear()

        self._run(run())

    def cut_off(self):
        async def run():
            self.adapter_faults.set(config.Fault(device="adapter", kind="disconnect"))

        self._run(run())

    def period(self, *velocities):
        """One period of all drivers that are given a velocity."""
        started_s = time.monotonic()
        for driver, velocity in zip(self.drivers, velocities, strict=False):
            driver.stage(velocity)
        self.bus.synchronize()
        readings = [driver.exchange(v) for driver, v in zip(self.drivers, velocities, strict=False)]
        time.sleep(max(0.0, started_s + PERIOD_S - time.monotonic()))
        return readings

    def close(self):
        for driver in self.drivers:
            driver.close()

        async def stop():
            for mock in self.mocks:
                await mock.stop()
            await self.adapter.stop()

        self._run(stop())
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join(5)
        self._loop.close()


@contextmanager
def shared(siderostat, count=3):
    bench = SharedBench(siderostat, count)
    try:
        yield bench
    finally:
        bench.close()


@pytest.fixture
def bench(siderostat):
    with shared(siderostat) as bench:
        yield bench


def opened(bench):
    for driver in bench.drivers:
        driver.open()
    for driver in bench.drivers:  # from here on each drive watches our heartbeat
        driver.enable()
    return bench


def periods(bench, *velocities, count=25):
    """The last reading of each driver, allowing for periods that a stall of the machine ate."""
    last = [None] * len(velocities)
    for _ in range(count):
        last = [new or old for new, old in zip(bench.period(*velocities), last, strict=True)]
    return last


def test_drives_on_several_buses_are_servoed_by_one_thread_too(siderostat):
    with (
        shared(siderostat, 1) as one,
        shared(siderostat, 2) as other,
        servoed(one, other) as servos,
    ):
        for servo in servos:
            hold(servo)
        for servo, goal in zip(servos, (0.5, -0.5, 0.25), strict=True):
            servo.move_to(np.array([goal, 0.0]))
        motors = one.motors + other.motors
        wait_until(
            lambda: (
                [each.position_rad()[0] for each in motors]
                == pytest.approx([0.5, -0.5, 0.25], abs=5e-3)
            )
        )
        one.cut_off()
        wait_until(lambda: isinstance(servos[0].fault, DeviceUnreachable))
        assert [servo.fault for servo in servos[1:]] == [None, None]
        assert readings_within(servos[1], 0.1)
        one.heal()


def test_an_adapter_that_takes_long_to_connect_holds_up_no_other_bus(siderostat, monkeypatch):
    def slow(device):
        time.sleep(1.0)
        raise Endpoint("CAN", device.channel).error(DeviceUnreachable, "an adapter", "none")

    with (
        shared(siderostat, 1) as one,
        shared(siderostat, 1) as other,
        servoed(one, other) as servos,
    ):
        hold(servos[0])
        monkeypatch.setattr(link_module, "CanLink", slow)
        with pytest.raises(DeviceUnreachable, match="an adapter"):
            servos[1].open()
        assert servos[0].fault is None
        assert len(readings_within(servos[0], 0.1)) > 2


@pytest.mark.long
def test_a_connection_that_breaks_or_is_closed_holds_up_no_other_bus(siderostat, monkeypatch):
    closing_s = 2.0  # 0.3 s in pyserial, which a busy machine may stand still for
    slow = SimpleNamespace(sleep=lambda _seconds: time.sleep(closing_s))
    monkeypatch.setattr(protocol_socket, "time", slow)

    def oldest_reading_s(servo):
        """Within a second."""
        ages_s = []
        end_s = time.monotonic() + 0.5 * closing_s
        while time.monotonic() < end_s:
            ages_s.append(time.monotonic() - servo.read_state().reading.time_s)
            time.sleep(0.002)
        return max(ages_s)

    with (
        shared(siderostat, 1) as one,
        shared(siderostat, 1) as other,
        servoed(one, other) as servos,
    ):
        for end in (one.cut_off, servos[0].close):
            for servo in servos:
                hold(servo)
            end()
            assert oldest_reading_s(servos[1]) < 0.4 * closing_s
            assert servos[1].fault is None
            one.heal()


def test_each_drive_turns_at_its_own_velocity_and_is_read_by_its_own_driver(bench):
    opened(bench)
    velocities = [(1.0, -1.0), (2.0, 0.0), STILL]
    readings = periods(bench, *velocities)
    for motors, velocity in zip(bench.motors, velocities, strict=True):
        assert motors.velocity_rad_s == pytest.approx(velocity, abs=1e-3)
    for reading, motors in zip(readings, bench.motors, strict=True):
        assert reading.enabled
        assert reading.position_rad == pytest.approx(motors.position_rad(), abs=0.1)
    assert readings[0].position_rad[0] > 0.01
    assert readings[2].position_rad == (0.0, 0.0)


def test_all_drives_of_a_bus_act_and_are_read_at_one_sync(bench):
    opened(bench)
    periods(bench, STILL, STILL, STILL)
    readings = [None]
    for _ in range(50):  # a stall of the machine eats a period's answers
        arrived = None not in readings  # the mock has heard, and answered, what was sent before
        del bench.frames[:]
        readings = bench.period(STILL, STILL, STILL)
        if arrived and None not in readings:
            break
    sent = [frame.can_id for frame in bench.frames if frame.can_id != 0x77F]
    assert sent == [0x201, 0x202, 0x203, 0x080]
    assert len({reading.time_s for reading in readings}) == 1


def test_six_drives_fit_on_a_bus(siderostat):
    with shared(siderostat, 6) as bench:
        opened(bench)
        velocities = [(0.1 * number, 0.0) for number in range(6)]
        readings = periods(bench, *velocities)
        for reading, motors, velocity in zip(readings, bench.motors, velocities, strict=True):
            assert reading.enabled
            assert motors.velocity_rad_s == pytest.approx(velocity, abs=1e-3)


def test_drives_are_opened_one_after_the_other_while_the_others_are_servoed(bench):
    first, second, third = bench.drivers
    first.open()
    first.enable()
    turned = []
    due_s = 0.0

    def meanwhile():
        nonlocal due_s
        if (
            time.monotonic() < due_s
        ):  # each answer of the bus calls it, and so it would flood the bus
            return
        due_s = time.monotonic() + PERIOD_S
        bench.bus.meanwhile = None
        first.stage((1.0, 0.0))
        bench.bus.synchronize()
        turned.append(first.exchange((1.0, 0.0)))
        bench.bus.meanwhile = meanwhile

    bench.bus.meanwhile = meanwhile
    for driver in (second, third):
        driver.open()
        driver.enable()
    bench.bus.meanwhile = None
    readings = [reading for reading in turned if reading is not None]
    assert len(readings) > 2  # an opening takes a hundred questions
    assert readings[-1].position_rad[0] > readings[0].position_rad[0]
    assert all(reading.enabled and not reading.fault for reading in readings)
    assert all(reading.enabled for reading in periods(bench, STILL, STILL, STILL))


@contextmanager
def servoed(*benches):
    """All drivers under their servos, on one thread as in the supervisor; none is opened yet."""
    clock, loop = MonotonicClock(), load_rig(default_rig_path()).loops["right"]
    servos = [
        (SiderostatServo(f"loop{number}", loop, driver, clock, 0.02), bus)
        for number, (driver, bus) in enumerate(
            (driver, bench.bus) for bench in benches for driver in bench.drivers
        )
    ]
    thread = PeriodicThread(ServoGroup(servos, clock), clock)
    thread.start()
    try:
        yield [servo for servo, _ in servos]
    finally:
        for servo, _ in servos:
            servo.close()
        thread.stop()


@pytest.fixture
def servos(bench):
    with servoed(bench) as servos:
        for servo in servos:
            hold(servo)
        yield servos


def hold(servo):
    servo.open()
    servo.hold(servo.position_rad)


def readings_within(servo, duration_s):
    since_s = time.monotonic()
    time.sleep(duration_s)
    return [reading for reading in servo._history if reading.time_s > since_s]


def test_servos_of_a_bus_reach_their_own_set_points(servos, bench):
    goals = [(0.5, 0.0), (0.0, -0.5), (0.25, 0.25)]
    for servo, goal in zip(servos, goals, strict=True):
        servo.move_to(np.array(goal))
    for motors, goal in zip(bench.motors, goals, strict=True):
        wait_until(
            lambda motors=motors, goal=goal: motors.position_rad() == pytest.approx(goal, abs=5e-3),
            10.0,
        )


@pytest.mark.long
def test_a_silent_drive_is_a_fault_of_its_servo_and_the_others_go_on_at_their_rate(
    servos, bench, siderostat
):
    bench.fault(0, "freeze")
    wait_until(lambda: servos[0].fault is not None)
    assert isinstance(servos[0].fault, DeviceTimeout)
    # Beside a bus of as many drives that all answer, at the same time: what else the machine does slows both.
    with shared(siderostat) as other, servoed(other) as (answering, *_):
        hold(answering)
        counts = np.zeros(3)
        for _ in range(10):
            since_s = time.monotonic()
            time.sleep(0.1)
            counts += [
                sum(reading.time_s > since_s for reading in list(servo._history))
                for servo in (answering, *servos[1:])
            ]
    assert [servo.fault for servo in servos[1:]] == [None, None]
    assert min(counts[1:]) > 0.6 * counts[0]


@pytest.mark.long
def test_a_silent_drive_does_not_hold_up_the_others_while_another_drive_is_opened(servos, bench):
    """Both want to wait for an answer then, which together cost the third drive the whole time limit."""
    bench.fault(0, "freeze")
    wait_until(lambda: servos[0].fault is not None)
    begin_s = time.monotonic()
    servos[1].open()
    read_s = [at_s for reading in servos[2]._history if (at_s := reading.time_s) > begin_s]
    gaps_s = np.diff([begin_s, *read_s, time.monotonic()])
    assert max(gaps_s) < 0.5 * bench.drivers[0]._device.response_timeout_s


@pytest.mark.long
def test_a_drive_that_is_opened_again_leaves_the_others_servoed(servos, bench):
    bench.fault(0, "reboot")
    wait_until(lambda: servos[0].fault is not None)
    bench.heal()
    servos[1].move_to(np.array([0.5, 0.0]))
    servos[0].open()
    assert servos[0].fault is None
    wait_until(lambda: servos[0].read_state().reading is not None)
    assert [servo.fault for servo in servos] == [None] * 3
    wait_until(lambda: bench.motors[1].position_rad()[0] == pytest.approx(0.5, abs=5e-3))


@pytest.mark.long
def test_a_lost_adapter_is_a_fault_of_all_servos_and_each_is_opened_again(servos, bench):
    bench.cut_off()
    for servo in servos:
        wait_until(lambda servo=servo: isinstance(servo.fault, DeviceUnreachable))
    bench.heal()
    for servo in servos:
        servo.open()
    assert [servo.fault for servo in servos] == [None] * 3
    assert all(readings_within(servo, 0.1) for servo in servos)


def test_a_drive_that_is_gone_is_the_error_of_its_own_driver_only(bench):
    opened(bench)
    bench.fault(1, "link_loss")
    with pytest.raises(DeviceTimeout, match="node 2"):
        periods(bench, STILL, STILL, STILL, count=1000)
    bench.heal()
    bench.drivers[1].open()
    for driver in bench.drivers:  # of the others, the master's heartbeat was missing meanwhile
        driver.reset_fault()
        driver.enable()
    assert all(reading.enabled for reading in periods(bench, STILL, STILL, STILL))


def test_a_drive_in_fault_leaves_the_others_enabled(bench):
    opened(bench)
    bench.fault(2, "amplifier_fault")
    readings = periods(bench, STILL, STILL, STILL)
    assert [bool(reading.fault) for reading in readings] == [False, False, True]
    assert readings[0].enabled
    with pytest.raises(DeviceFault, match="node 3"):
        bench.drivers[2].reset_fault()


def test_a_lost_adapter_is_unreachable_for_every_drive_and_each_can_be_opened_again(bench):
    opened(bench)
    bench.cut_off()
    for driver in bench.drivers:
        with pytest.raises(DeviceUnreachable):
            exchange_until(driver, lambda _: False)
    bench.heal()
    opened(bench)
    assert all(reading.enabled for reading in periods(bench, STILL, STILL, STILL))


def test_the_bus_is_connected_as_long_as_a_drive_is_open(bench):
    opened(bench)
    first, second, third = bench.drivers
    first.close()
    third.close()
    assert reading_of(second).enabled
    assert len(bench.adapter.links) == 1
    second.close()
    wait_until(lambda: not bench.adapter.links)
    with pytest.raises(DeviceUnreachable, match="node 2"):
        second.exchange(STILL)


def test_a_velocity_that_is_no_number_is_never_sent_and_the_next_one_is(bench):
    opened(bench)
    with pytest.raises(ValueError, match="finite"):
        bench.drivers[0].exchange((float("nan"), 0.0))
    periods(bench, (0.5, 0.0), STILL, STILL)
    assert bench.motors[0].velocity_rad_s == pytest.approx((0.5, 0.0), abs=1e-3)
