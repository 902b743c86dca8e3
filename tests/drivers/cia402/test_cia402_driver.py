import math
import threading
import time

import can
import numpy as np
import pytest
from can.interfaces.slcan import slcanBus
from cia402_bench import Bench, bridged, wait_until

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.cia402.protocol import State
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceMismatch,
    DeviceTimeout,
    DeviceUnreachable,
)

STILL = (0.0, 0.0)


@pytest.fixture
def amplifiers(bench):
    amplifiers = Cia402Amplifiers(bench.siderostat)
    yield amplifiers
    amplifiers.close()


def other_master(bench):
    return slcanBus(f"socket://127.0.0.1:{bench.port}", bitrate=1000000, sleep_after_open=0)


def download(bus, index, subindex, data):
    command = protocol.expedited_command(protocol.SDO_DOWNLOAD, len(data))
    frame = protocol.encode_sdo(command, index, subindex, data)
    bus.send(can.Message(arbitration_id=0x601, data=frame, is_extended_id=False))
    while (message := bus.recv(2.0)) is not None:
        if message.arbitration_id == 0x581:
            return
    pytest.fail("no SDO answer")


def exchange_for(amplifiers, seconds):
    end_s = time.monotonic() + seconds
    while time.monotonic() < end_s:
        amplifiers.exchange(STILL)
        time.sleep(0.002)


def exchange_until(amplifiers, condition, timeout_s=3.0):
    deadline_s = time.monotonic() + timeout_s
    while time.monotonic() < deadline_s:
        reading = amplifiers.exchange(STILL)
        if reading is not None and condition(reading):
            return reading
        time.sleep(0.002)
    return pytest.fail("the reading did not come")


def reading_of(amplifiers, velocity_rad_s=STILL):
    """A reading, allowing for periods that a stall of the machine ate."""
    for _ in range(50):
        reading = amplifiers.exchange(velocity_rad_s)
        if reading is not None:
            return reading
    return pytest.fail("no reading in 50 periods")


def test_open_says_who_answers_and_moves_nothing(bench, amplifiers):
    identity = amplifiers.open()
    assert identity.model == "FIT two-axis servo drive (mock)"
    assert identity.serial == "20261121"
    assert bench.motors.enabled == [False, False]
    reading = reading_of(amplifiers)
    assert not reading.enabled
    assert reading.fault == ""


def test_velocity_commands_move_the_right_motor_the_right_way(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    assert bench.motors.enabled == [True, True]
    reading_of(amplifiers, [1.5, -0.25])
    # 0.001 rpm is the finest step on the wire.
    assert bench.motors.velocity_rad_s == pytest.approx([1.5, -0.25], abs=0.6e-3 * 2 * math.pi / 60)


def test_positions_are_the_motor_angles_in_whole_counts(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    first = reading_of(amplifiers, [20.0, -10.0])
    time.sleep(0.05)
    second = reading_of(amplifiers, [0.0, 0.0])
    count_rad = 2 * math.pi / bench.siderostat.encoder_counts_per_rev
    settled = reading_of(amplifiers)
    assert settled.position_rad == pytest.approx(bench.motors.position_rad(), abs=0.51 * count_rad)
    counts = np.array(settled.position_rad) / count_rad
    assert counts == pytest.approx(np.round(counts), abs=1e-6)
    assert second.position_rad[0] > first.position_rad[0]
    assert second.position_rad[1] < first.position_rad[1]
    assert first.time_s < second.time_s < time.monotonic()


def test_without_enable_a_velocity_command_moves_nothing(bench, amplifiers):
    amplifiers.open()
    reading_of(amplifiers, [5.0, 5.0])
    assert bench.motors.velocity_rad_s == [0.0, 0.0]


def test_enable_starts_at_rest_after_an_earlier_command(bench, amplifiers):
    amplifiers.open()
    reading_of(amplifiers, [5.0, 5.0])
    amplifiers.enable()
    assert bench.motors.velocity_rad_s == [0.0, 0.0]


def test_disable_stops_and_takes_current_away(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers, [5.0, 5.0])
    amplifiers.disable()
    assert bench.motors.enabled == [False, False]
    assert bench.motors.velocity_rad_s == [0.0, 0.0]
    assert not reading_of(amplifiers).enabled


def test_silence_after_disable_is_no_fault(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    amplifiers.disable()
    time.sleep(2 * bench.siderostat.device.master_heartbeat_timeout_s)
    assert reading_of(amplifiers).fault == ""


def test_a_fault_is_reported_stays_and_is_reset(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers, [5.0, 5.0])
    bench.fault("amplifier_fault", part="el")
    reading = exchange_until(amplifiers, lambda reading: "elevation: fault" in reading.fault)
    assert "0x2310 (continuous over-current)" in reading.fault
    assert not reading.enabled
    wait_until(lambda: bench.motors.enabled == [True, False])

    with pytest.raises(DeviceFault, match=r"elevation .*fault \(statusword 0x\w+\), error 0x2310"):
        amplifiers.enable()
    assert bench.motors.enabled == [False, False]

    bench.heal()
    amplifiers.reset_fault()
    assert reading_of(amplifiers).fault == ""
    assert bench.motors.enabled == [False, False]
    amplifiers.enable()
    assert bench.motors.enabled == [True, True]


def test_a_fault_whose_cause_stays_defeats_the_reset(siderostat):
    device = siderostat.device.model_copy(update={"response_timeout_s": 0.2})
    bench = Bench(siderostat.model_copy(update={"device": device}))
    amplifiers = Cia402Amplifiers(bench.siderostat)
    try:
        amplifiers.open()
        bench.fault("amplifier_fault", part="az", value=0x7305)
        with pytest.raises(DeviceFault, match=r"azimuth .*0x7305 \(incremental encoder 1\)"):
            amplifiers.reset_fault()
        bench.heal()
        amplifiers.reset_fault()
        assert reading_of(amplifiers).fault == ""
    finally:
        amplifiers.close()
        bench.close()


def test_the_drive_stops_by_itself_when_the_master_falls_silent(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers, [5.0, 5.0])
    wait_until(lambda: bench.motors.enabled == [False, False])
    assert bench.motors.velocity_rad_s == [0.0, 0.0]
    reading = exchange_until(amplifiers, lambda reading: bool(reading.fault))
    assert "0x8130 (heartbeat of the master lost)" in reading.fault
    amplifiers.reset_fault()
    time.sleep(2 * bench.siderostat.device.master_heartbeat_timeout_s)
    amplifiers.enable()
    assert bench.motors.enabled == [True, True]


def test_exchanging_keeps_the_drive_running(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    exchange_for(amplifiers, 3 * bench.siderostat.device.master_heartbeat_timeout_s)
    assert reading_of(amplifiers).fault == ""
    assert bench.motors.enabled == [True, True]


def test_a_cut_link_is_unreachable_at_once_and_can_be_opened_again(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers, [5.0, 5.0])
    bench.fault("disconnect")
    with pytest.raises(DeviceUnreachable, match="recover"):
        exchange_for(amplifiers, 0.1)
    amplifiers.close()
    wait_until(lambda: bench.motors.enabled == [False, False])
    wait_until(lambda: all(axis.state is State.FAULT for axis in bench.mock.axes))
    with pytest.raises(DeviceError):
        amplifiers.open()
    bench.heal()
    amplifiers.open()
    with pytest.raises(DeviceFault, match="0x8130"):
        amplifiers.enable()
    amplifiers.reset_fault()
    amplifiers.enable()
    assert bench.motors.enabled == [True, True]


def test_a_missing_drive_heartbeat_times_out(bench, amplifiers):
    amplifiers.open()
    other = other_master(bench)
    try:
        download(other, protocol.HEARTBEAT_PRODUCER, 0, b"\0\0")
        with pytest.raises(DeviceTimeout, match=r"heartbeat within 0\.3 s"):
            exchange_for(amplifiers, 2.0)
    finally:
        other.shutdown()


def test_a_drive_taken_out_of_operation_is_a_fault(bench, amplifiers):
    amplifiers.open()
    other = other_master(bench)
    try:
        pre_operational = can.Message(arbitration_id=0, data=[0x80, 1], is_extended_id=False)
        other.send(pre_operational)
        with pytest.raises(DeviceFault, match="NMT state 0x7F"):
            exchange_for(amplifiers, 2.0)
    finally:
        other.shutdown()


def test_positions_that_do_not_come_give_no_reading_after_one_period(bench, amplifiers):
    amplifiers.open()
    other = other_master(bench)
    try:
        out_of_service = (0x181 | protocol.PDO_DISABLED).to_bytes(4, "little")
        download(other, protocol.TPDO_COMMUNICATION, 1, out_of_service)
        started_s = time.monotonic()
        assert amplifiers.exchange(STILL) is None
        assert time.monotonic() - started_s >= 1 / bench.siderostat.servo.rate_hz
    finally:
        other.shutdown()


def test_a_drive_with_profile_velocity_only_is_driven_in_that_mode(siderostat):
    bench = Bench(siderostat, supported_modes=1 << (protocol.PROFILE_VELOCITY - 1))
    amplifiers = Cia402Amplifiers(bench.siderostat)
    try:
        amplifiers.open()
        amplifiers.enable()
        reading_of(amplifiers, [2.0, 0.0])
        assert [axis.mode for axis in bench.mock.axes] == [3, 3]
        wait_until(lambda: bench.motors.velocity_rad_s[0] == pytest.approx(2.0, abs=1e-4))
    finally:
        amplifiers.close()
        bench.close()


def test_a_drive_without_velocity_mode_does_not_fit(siderostat):
    bench = Bench(siderostat, supported_modes=1)
    try:
        with pytest.raises(DeviceMismatch, match="azimuth: mode 9 or 3"):
            Cia402Amplifiers(bench.siderostat).open()
    finally:
        bench.close()


def test_no_drive_under_this_node_id_times_out(bench):
    device = bench.siderostat.device.model_copy(update={"node_id": 5, "response_timeout_s": 0.1})
    amplifiers = Cia402Amplifiers(bench.siderostat.model_copy(update={"device": device}))
    with pytest.raises(DeviceTimeout, match="node 5: expected an answer to SDO 1000:00"):
        amplifiers.open()
    amplifiers.close()


@pytest.mark.parametrize(
    "device", [{"channel": "socket://127.0.0.1:1"}, {"interface": "no-such-interface"}]
)
def test_no_adapter_is_unreachable(siderostat, device):
    device = siderostat.device.model_copy(update=device)
    amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"device": device}))
    with pytest.raises(DeviceUnreachable, match="check that the adapter is on"):
        amplifiers.open()
    amplifiers.close()


def test_a_velocity_that_is_no_number_is_not_sent(amplifiers):
    amplifiers.open()
    with pytest.raises(ValueError, match="finite"):
        amplifiers.exchange((math.nan, 0.0))


def test_closing_twice_is_safe_and_a_closed_driver_says_so(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    amplifiers.close()
    amplifiers.close()
    assert bench.motors.enabled == [False, False]
    with pytest.raises(DeviceUnreachable, match="open it first"):
        amplifiers.exchange(STILL)


def test_no_thread_runs_beside_the_servo(amplifiers):
    before = threading.active_count()
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers)
    assert threading.active_count() == before


def test_any_other_python_can_interface_will_do(bench):
    with bridged(bench) as siderostat:
        amplifiers = Cia402Amplifiers(siderostat)
        try:
            amplifiers.open()
            amplifiers.enable()
            reading_of(amplifiers, [3.0, 0.0])
            wait_until(lambda: bench.motors.velocity_rad_s[0] == pytest.approx(3.0, abs=1e-4))
        finally:
            amplifiers.close()


class LaggingPositions:
    """Positions as the link delivers them: late by one of our frames, or one of them never."""

    def __init__(self) -> None:
        self.late = False
        self.lose = 0
        self.held: list[can.Message] = []

    def __call__(self, message):
        if message.arbitration_id in {protocol.SYNC_ID, 0x601}:
            released, self.held = self.held, []
            return [message, *released]
        if message.arbitration_id != 0x181:
            return [message]
        if self.lose:
            self.lose -= 1
            return []
        if self.late:
            self.held.append(message)
            return []
        return [message]


@pytest.fixture
def lagging(bench):
    """Positions' lag, and opened amplifiers with a period that no stall of the machine fills."""
    positions = LaggingPositions()
    with bridged(bench, positions) as siderostat:
        servo = siderostat.servo.model_copy(update={"rate_hz": 5.0})
        amplifiers = Cia402Amplifiers(siderostat.model_copy(update={"servo": servo}))
        amplifiers.open()
        try:
            yield positions, amplifiers
        finally:
            positions.late = False
            amplifiers.close()


def test_positions_that_come_late_are_dated_with_the_sync_that_they_answer(bench, lagging):
    positions, amplifiers = lagging
    positions.late = True
    starts_s = []
    for turn in range(4):
        bench.motors.turn_to(0.05 * turn)
        starts_s.append(time.monotonic())
        reading = amplifiers.exchange(STILL)
        wait_until(lambda: len(positions.held) == 1)
        if turn == 0:
            assert reading is None
            continue
        assert reading.position_rad[0] == pytest.approx(0.05 * (turn - 1), abs=1e-3)
        assert starts_s[turn - 1] < reading.time_s < starts_s[turn]


def test_after_lost_positions_readings_are_dated_right_again(lagging):
    positions, amplifiers = lagging
    reading_of(amplifiers)
    positions.lose = 1
    assert amplifiers.exchange(STILL) is None
    for _ in range(15):
        start_s = time.monotonic()
        reading = amplifiers.exchange(STILL)
        assert reading is not None
    assert reading.time_s > start_s


def test_a_slow_link_is_not_taken_for_lost_positions(lagging):
    positions, amplifiers = lagging
    positions.late = True
    amplifiers.exchange(STILL)
    for _ in range(25):
        wait_until(lambda: len(positions.held) == 1)
        start_s = time.monotonic()
        reading = amplifiers.exchange(STILL)
        assert reading is not None
        assert reading.time_s < start_s


def test_positions_go_on_where_the_encoder_counter_wraps(bench, amplifiers):
    count_rad = 2 * math.pi / bench.siderostat.encoder_counts_per_rev
    bench.motors.turn_to((2**31 - 10) * count_rad)
    amplifiers.open()
    before = reading_of(amplifiers)
    bench.motors.turn_to((2**31 + 10) * count_rad)
    after = reading_of(amplifiers)
    steps = np.subtract(after.position_rad, before.position_rad) / count_rad
    assert steps == pytest.approx([20.0, 20.0], abs=0.1)


def test_missing_statuswords_time_out_although_positions_come(bench, amplifiers):
    amplifiers.open()
    other = other_master(bench)
    try:
        out_of_service = (0x281 | protocol.PDO_DISABLED).to_bytes(4, "little")
        download(other, protocol.TPDO_COMMUNICATION + 1, 1, out_of_service)
        with pytest.raises(DeviceTimeout, match=r"statuswords within 0\.5 s"):
            exchange_for(amplifiers, 2.0)
    finally:
        other.shutdown()
