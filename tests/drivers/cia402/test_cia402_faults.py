"""What the driver makes of everything that can go wrong with the drive and its link."""

import math
import time

import pytest
from cia402_bench import Bench, reading_of, wait_until

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.cia402.protocol import State
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.mocks.cia402.drive import FAULTS

STILL = (0.0, 0.0)
TURNING = (10.0, 10.0)
LIMIT_S = 3.0

ENDS_IN = {
    "drop": DeviceTimeout,
    "freeze": DeviceTimeout,
    "link_loss": DeviceTimeout,
    "disconnect": DeviceUnreachable,
    "reboot": DeviceUnreachable,
    "corrupt": DeviceError,
    "encoder_jump": DeviceFault,
}
READ_ON = {"delay": 0.03, "duplicate": None, "reorder": None}
IN_THE_READING = {
    "amplifier_fault": "azimuth: fault .*0x2310 (continuous over-current)",
    "following_error": "azimuth: fault .*0x8611 (following error)",
}
NOT_SEEN_BY_THE_DRIVE = {"stuck_axis"}


@pytest.fixture
def siderostat(siderostat):
    """Short time limits, so that what ends by them ends soon."""
    limits = {
        "response_timeout_s": 0.2,
        "drive_heartbeat_s": 0.05,
        "master_heartbeat_timeout_s": 0.25,
    }
    return siderostat.model_copy(update={"device": siderostat.device.model_copy(update=limits)})


@pytest.fixture
def enabled(bench):
    """Amplifiers with current, and a reading behind them."""
    amplifiers = Cia402Amplifiers(bench.siderostat)
    amplifiers.open()
    amplifiers.enable()
    while amplifiers.exchange(TURNING) is None:
        pass
    yield amplifiers
    amplifiers.close()


def error_from(amplifiers, velocity_rad_s=TURNING, within_s=LIMIT_S):
    """What exchanging ends in; None if it goes on."""
    end_s = time.monotonic() + within_s
    while time.monotonic() < end_s:
        try:
            amplifiers.exchange(velocity_rad_s)
        except DeviceError as error:
            return error
        time.sleep(0.002)
    return None


def test_every_fault_is_looked_at_here():
    known = {*ENDS_IN, *READ_ON, *IN_THE_READING, *NOT_SEEN_BY_THE_DRIVE}
    assert known == set(FAULTS)


@pytest.mark.parametrize("kind", ENDS_IN)
def test_it_ends_in_a_typed_error_and_the_motors_stand_without_us(bench, enabled, kind):
    bench.fault(kind)
    assert isinstance(error_from(enabled), ENDS_IN[kind])
    started_s = time.monotonic()
    enabled.close()
    assert time.monotonic() - started_s < LIMIT_S
    wait_until(lambda: bench.motors.velocity_rad_s == [0.0, 0.0])
    wait_until(lambda: bench.motors.enabled == [False, False])


@pytest.mark.parametrize("kind", sorted(set(ENDS_IN) - {"corrupt", "encoder_jump"}))
def test_when_it_is_over_the_amplifiers_are_had_again(bench, enabled, kind):
    bench.fault(kind, **({"value": 30.0} if kind == "reboot" else {}))
    assert error_from(enabled) is not None
    enabled.close()
    wait_until(lambda: bench.motors.enabled == [False, False])
    bench.heal()
    enabled.open()
    enabled.reset_fault()
    enabled.enable()
    assert bench.motors.enabled == [True, True]
    assert error_from(enabled, STILL, within_s=0.2) is None


@pytest.mark.parametrize("kind", ["drop", "freeze", "link_loss", "disconnect", "corrupt"])
def test_opening_a_drive_like_this_is_a_typed_error(bench, kind):
    bench.fault(kind)
    amplifiers = Cia402Amplifiers(bench.siderostat)
    with pytest.raises(DeviceError):
        amplifiers.open()
    amplifiers.close()


@pytest.mark.parametrize("kind", READ_ON)
def test_readings_go_on_and_are_dated_right(bench, enabled, kind):
    motors = bench.motors
    while motors.velocity_rad_s[0] == 0:
        enabled.exchange(TURNING)
    known_s, (known_rad, _el) = motors.where()
    velocity_rad_s = motors.velocity_rad_s[0]
    bench.fault(kind, value=READ_ON[kind])
    seen, before_s = 0, known_s
    for _ in range(40):
        reading = enabled.exchange(TURNING)
        now_s = time.monotonic()
        if reading is not None and reading.time_s > known_s:
            seen += 1
            latched_s = known_s + (reading.position_rad[0] - known_rad) / velocity_rad_s
            # A bus keeps the order of frames of one identifier; without it, dates are one period off.
            sync_s = before_s if kind == "reorder" else reading.time_s
            # Whatever the machine does: latched after its SYNC was sent, and before it was heard of.
            assert sync_s - 1e-3 < latched_s < now_s + 1e-3
            before_s = reading.time_s
        time.sleep(0.005)
    assert seen > 5


@pytest.mark.parametrize("kind", IN_THE_READING)
def test_the_drives_own_faults_come_in_the_reading(bench, enabled, kind):
    bench.fault(kind, part="az")
    end_s = time.monotonic() + LIMIT_S
    text = ""
    while "azimuth" not in text or "0x" not in text.partition("), ")[2]:
        assert time.monotonic() < end_s, text
        reading = enabled.exchange(TURNING)
        text = reading.fault if reading else ""
        time.sleep(0.002)
    state, code = IN_THE_READING[kind].split(" .*")
    assert state in text
    assert code in text
    assert not reading.enabled
    wait_until(lambda: bench.motors.enabled == [False, True])


def test_a_jumped_encoder_is_said_until_it_is_reset_and_commands_still_reach_the_drive(
    bench, enabled
):
    bench.fault("encoder_jump", part="el", value=-2000)
    error = error_from(enabled)
    assert "elevation moved by -" in error.got
    for velocity_rad_s in ((3.0, 0.0), STILL):
        assert isinstance(error_from(enabled, velocity_rad_s), DeviceFault)
        wanted = pytest.approx(list(velocity_rad_s), abs=1e-4)
        wait_until(lambda wanted=wanted: bench.motors.velocity_rad_s == wanted)
    enabled.reset_fault()
    assert error_from(enabled, STILL, within_s=0.2) is None


def test_readings_are_held_against_commands_while_both_motors_have_current(
    enabled, monkeypatch, siderostat
):
    sent = []
    record = enabled._encoders.sync_sent
    monkeypatch.setattr(
        enabled._encoders,
        "sync_sent",
        lambda time_s, commanded: (sent.append(commanded), record(time_s, commanded)),
    )
    enabled.exchange((3.0, -2.0))
    counts_per_rad = siderostat.encoder_counts_per_rev / (2 * math.pi)
    assert sent.pop() == pytest.approx((3.0 * counts_per_rad, -2.0 * counts_per_rad))
    enabled.disable()
    enabled.exchange(STILL)
    assert sent.pop() is None


def test_a_stuck_axis_is_read_where_it_stands(bench, enabled):
    bench.fault("stuck_axis", part="az")
    stands_rad = bench.motors.position_rad()[0]
    for _ in range(20):
        reading = reading_of(enabled, TURNING)
    count_rad = 2 * 3.14159 / bench.siderostat.encoder_counts_per_rev
    assert reading.position_rad[0] == pytest.approx(stands_rad, abs=count_rad)
    assert reading.position_rad[1] > 0
    assert reading.fault == ""


def test_turned_bits_end_in_an_error_or_pass_as_motion_that_a_motor_could_have_made(bench):
    reach_rad_s = 1.25 * bench.siderostat.velocity_limit_rad_s
    errors = 0
    for _ in range(3):
        amplifiers = Cia402Amplifiers(bench.siderostat)
        amplifiers.open()
        while amplifiers.exchange(STILL) is None:
            pass
        good_s = time.monotonic()
        bench.fault("corrupt", probability=0.1)
        try:
            for _ in range(200):
                sent_s = time.monotonic()
                reading = amplifiers.exchange(STILL)
                if reading is not None:
                    reach_rad = reach_rad_s * (time.monotonic() - good_s) + 0.01
                    assert max(map(abs, reading.position_rad)) < reach_rad
                    if reading.position_rad == STILL:
                        good_s = sent_s - 0.01
        except DeviceError:
            errors += 1
        bench.heal()
        amplifiers.close()
    assert errors


def test_the_drive_holds_its_own_limit_and_lets_the_axis_back(siderostat):
    device = siderostat.device.model_copy(update={"position_limit_rad": 1.0})
    bench = Bench(siderostat.model_copy(update={"device": device}))
    amplifiers = Cia402Amplifiers(bench.siderostat)
    try:
        amplifiers.open()
        amplifiers.enable()
        wait_until(lambda: amplifiers.exchange((5.0, 0.0)) and bench.motors.velocity_rad_s[0] > 0)
        wait_until(lambda: amplifiers.exchange((5.0, 0.0)) and bench.motors.velocity_rad_s[0] == 0)
        assert bench.motors.position_rad()[0] >= 1.0 - 0.01
        wait_until(lambda: amplifiers.exchange((-5.0, 0.0)) and bench.motors.velocity_rad_s[0] < 0)
        wait_until(lambda: bench.motors.position_rad()[0] < 0.9)
    finally:
        amplifiers.close()
        bench.close()


def test_a_drive_that_would_run_on_without_its_master_is_told_to_stop(bench):
    for axis in bench.mock.axes:
        axis.abort_option = protocol.ABORT_IS_NOTHING
    amplifiers = Cia402Amplifiers(bench.siderostat)
    amplifiers.open()
    amplifiers.enable()
    wait_until(lambda: all(axis.state is State.FAULT for axis in bench.mock.axes))
    amplifiers.close()
