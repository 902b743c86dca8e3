"""The driver and a drive that does as it is told, or is in fault."""

import math
import threading

import pytest
from cia402_bench import (
    STILL,
    Bench,
    bridged,
    exchange_until,
    is_to_drive,
    reading_of,
    wait_until,
)

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.interface import DeviceFault, DeviceMismatch, DeviceUnreachable


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


SDO_REQUEST, RPDO = 0x601, 0x201
ZERO_AZ = (SDO_REQUEST, bytes.fromhex("23 FF60 00 00000000"))
ZERO_EL = (SDO_REQUEST, bytes.fromhex("23 FF68 00 00000000"))
ZERO_BOTH = (RPDO, bytes(8))
CONTROLWORDS = (bytes.fromhex("4060"), bytes.fromhex("4068"))


@pytest.mark.parametrize("action", ["enable", "disable"])
def test_zero_velocity_is_written_and_sent_before_the_power_changes(bench, action):
    """Written, because the drive confirms it; sent, because an older velocity may wait for its SYNC."""
    to_drive = []

    def carry(message):
        if is_to_drive(message):
            to_drive.append((message.arbitration_id, bytes(message.data)))
        return [message]

    with bridged(bench, carry) as siderostat:
        amplifiers = Cia402Amplifiers(siderostat)
        try:
            amplifiers.open()
            if action == "disable":
                amplifiers.enable()
            reading_of(amplifiers, [1.5, -0.25])
            to_drive.clear()
            getattr(amplifiers, action)()
            frames = list(to_drive)
        finally:
            amplifiers.close()

    powers = [
        can_id == SDO_REQUEST and data[0] & 0xE0 == 0x20 and data[1:3] in CONTROLWORDS
        for can_id, data in frames
    ]
    before = frames[: powers.index(True)]
    assert {ZERO_AZ, ZERO_EL, ZERO_BOTH} <= set(before)


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
    with pytest.raises(DeviceUnreachable, match="open it again"):
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
