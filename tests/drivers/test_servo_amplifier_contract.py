"""What every back end of the siderostat's amplifiers does, whatever it speaks."""

import math
import time

import pytest
from amplifier_back_ends import BACK_ENDS

from fitctl.drivers.interface import DeviceError, DeviceFault, DeviceUnreachable

STILL = (0.0, 0.0)
SLOWLY = (4.0, -2.5)
FAST = (20.0, -20.0)
LONGEST_S = 5.0
QUICK_S = 0.01


@pytest.fixture(params=BACK_ENDS)
def bench(request, bench_of):
    return bench_of(request.param)


@pytest.fixture
def driver(bench):
    return bench.driver


@pytest.fixture
def enabled(driver):
    driver.open()
    driver.reset_fault()
    driver.enable()
    return driver


def until(driver, reached, velocity_rad_s=STILL):
    """Exchange at the driver's own pace until a reading is as wanted."""
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        reading = driver.exchange(velocity_rad_s)
        if reading is not None and reached(reading):
            return reading
    return pytest.fail("no such reading")


def reading_of(driver, velocity_rad_s=STILL):
    return until(driver, lambda _: True, velocity_rad_s)


def quick_reading_of(driver, velocity_rad_s):
    """A reading whose time is known within `QUICK_S`, which its exchange took at most."""
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        begun_s = time.monotonic()
        reading = driver.exchange(velocity_rad_s)
        if reading is not None and time.monotonic() - begun_s < QUICK_S:
            return reading
    return pytest.fail("no quick reading")


def exchange_for(driver, seconds, velocity_rad_s):
    end_s = time.monotonic() + seconds
    return until(driver, lambda reading: reading.time_s > end_s, velocity_rad_s)


def wait_until(condition):
    end_s = time.monotonic() + LONGEST_S
    while not condition():
        assert time.monotonic() < end_s, "did not happen in time"
        time.sleep(0.005)


def rests(bench):
    wait_until(lambda: not bench.motors.moving)
    before = bench.motors.position_rad()
    time.sleep(0.05)
    after = bench.motors.position_rad()
    return after == pytest.approx(before, abs=3 * bench.count_rad)


# ---------------------------------------------------------------- opening and closing


def test_open_says_who_answers_and_moves_nothing(bench, driver):
    assert driver.open().model
    reading = reading_of(driver, (5.0, 5.0))
    assert not reading.enabled
    assert reading.fault == ""
    assert bench.motors.enabled == [False, False]
    assert bench.motors.position_rad() == (0.0, 0.0)


def test_what_is_not_open_says_so(driver):
    for action in (driver.enable, driver.disable, driver.reset_fault):
        with pytest.raises(DeviceUnreachable, match="open"):
            action()
    with pytest.raises(DeviceUnreachable, match="open"):
        driver.exchange(STILL)


def test_close_is_always_safe(bench, driver):
    driver.close()
    driver.open()
    driver.close()
    driver.close()
    with pytest.raises(DeviceUnreachable):
        driver.exchange(STILL)
    driver.open()
    assert reading_of(driver).position_rad == pytest.approx((0, 0), abs=bench.count_rad)


def test_close_stops_and_disables(bench, enabled):
    exchange_for(enabled, 0.1, SLOWLY)
    enabled.close()
    wait_until(lambda: bench.motors.enabled == [False, False])
    assert rests(bench)


# ---------------------------------------------------------------- enable, disable


def test_enable_powers_both_axes_at_rest(bench, driver):
    driver.open()
    reading_of(driver, (5.0, 5.0))  # an earlier wish is no command
    driver.enable()
    assert bench.motors.enabled == [True, True]
    assert until(driver, lambda reading: reading.enabled).fault == ""
    assert rests(bench)


def test_disable_while_moving_stops_and_takes_power(bench, enabled):
    exchange_for(enabled, 0.1, SLOWLY)
    enabled.disable()
    assert bench.motors.enabled == [False, False]
    assert rests(bench)
    reading = until(enabled, lambda reading: not reading.enabled, (5.0, 5.0))
    assert reading.fault == ""
    assert rests(bench)


def test_disabled_and_enabled_again_it_goes_on(bench, enabled):
    enabled.disable()
    enabled.enable()
    until(enabled, lambda reading: reading.position_rad[0] > 0.5, SLOWLY)


# ---------------------------------------------------------------- velocity


@pytest.mark.parametrize("velocity_rad_s", [(6.0, 0.0), (0.0, -6.0), (-3.0, 1.0)])
def test_each_motor_turns_as_fast_as_told_and_in_the_right_sense(bench, enabled, velocity_rad_s):
    exchange_for(enabled, 0.15, velocity_rad_s)
    first = quick_reading_of(enabled, velocity_rad_s)
    exchange_for(enabled, 0.15, velocity_rad_s)
    second = quick_reading_of(enabled, velocity_rad_s)
    lasted_s = second.time_s - first.time_s
    for axis, velocity in enumerate(velocity_rad_s):
        turned = second.position_rad[axis] - first.position_rad[axis]
        # A stalled machine lets the command run out for a moment, and lets it run on: 2 % of noise.
        assert turned == pytest.approx(velocity * lasted_s, rel=0.1, abs=0.02)


def test_stop_while_moving(bench, enabled):
    exchange_for(enabled, 0.1, SLOWLY)
    assert bench.motors.moving
    exchange_for(enabled, 0.1, STILL)
    assert rests(bench)
    assert bench.motors.enabled == [True, True]


def test_a_velocity_beyond_any_range_is_held_and_keeps_its_sign(bench, enabled):
    enabled.exchange((1e12, -1e12))
    wait_until(lambda: bench.motors.moving)
    az, el = bench.motors.velocity_rad_s
    assert az > 0 > el


@pytest.mark.parametrize("name", BACK_ENDS)
def test_the_motors_turn_no_faster_than_their_limit(bench_of, name):
    driver = bench_of(name, "loops.right.siderostat.velocity_limit_rad_s=5.0").driver
    driver.open()
    driver.enable()
    exchange_for(driver, 0.15, FAST)
    first = quick_reading_of(driver, FAST)
    exchange_for(driver, 0.15, FAST)
    second = quick_reading_of(driver, FAST)
    lasted_s = second.time_s - first.time_s
    turned = [
        after - before
        for before, after in zip(first.position_rad, second.position_rad, strict=True)
    ]
    assert turned == pytest.approx([5.0 * lasted_s, -5.0 * lasted_s], rel=0.1)


@pytest.mark.parametrize("wrong", [math.nan, math.inf, -math.inf])
def test_a_velocity_that_is_no_number_is_refused_and_moves_nothing(bench, enabled, wrong):
    for velocity in ((wrong, 0.0), (0.0, wrong)):
        with pytest.raises(ValueError, match="finite"):
            enabled.exchange(velocity)
    reading_of(enabled)
    assert rests(bench)


# ---------------------------------------------------------------- encoders


def test_readings_are_the_motors_angles_in_whole_counts_and_dated(bench, enabled):
    before_s = time.monotonic()
    first = exchange_for(enabled, 0.1, SLOWLY)
    assert before_s < first.time_s < time.monotonic()
    until(enabled, lambda _: not bench.motors.moving)
    settled = exchange_for(
        enabled, 0.02, STILL
    )  # of motors that stand, however long the machine stood
    truth = bench.motors.position_rad()
    assert settled.position_rad == pytest.approx(truth, abs=1.5 * bench.count_rad)
    assert settled.position_rad[0] > 0.1
    assert settled.position_rad[1] < -0.1


def test_encoders_are_found_where_they_are(bench, driver):
    bench.motors.turn_to(12.0, -30.0)
    driver.open()
    assert reading_of(driver).position_rad == pytest.approx((12.0, -30.0), abs=bench.count_rad)


def test_time_goes_on_from_reading_to_reading(enabled):
    times_s = [reading_of(enabled, SLOWLY).time_s for _ in range(20)]
    assert times_s == sorted(times_s)
    assert len(set(times_s)) == len(times_s)


def test_a_stuck_axis_is_never_read_as_moving(bench, enabled):
    bench.fault("stuck_axis", "az")
    reading = exchange_for(enabled, 0.2, SLOWLY)
    assert reading.position_rad[0] == pytest.approx(0.0, abs=3 * bench.count_rad)


def test_a_jumped_encoder_is_an_error_a_fault_or_shown(bench, enabled):
    reading_of(enabled)
    bench.fault("encoder_jump", "el", value=900.0)

    def shows(reading):
        jumped = abs(reading.position_rad[1]) > 0.5 * 900 * bench.count_rad
        return jumped or "elevation" in reading.fault

    try:
        until(enabled, shows)
    except DeviceError as error:
        assert "elevation" in str(error)  # noqa: PT017 - one of three lawful outcomes


# ---------------------------------------------------------------- faults of an amplifier


def test_a_fault_shows_in_the_reading_and_takes_the_axis_power(bench, enabled):
    exchange_for(enabled, 0.1, SLOWLY)
    bench.fault("amplifier_fault", "el")
    reading = until(enabled, lambda reading: reading.fault != "", SLOWLY)
    assert "elevation" in reading.fault
    assert "azimuth" not in reading.fault
    assert not until(enabled, lambda reading: not reading.enabled).enabled
    wait_until(lambda: not bench.motors.enabled[1])


def test_while_its_cause_is_there_a_fault_can_neither_be_reset_nor_passed_over(bench, driver):
    driver.open()
    bench.fault("amplifier_fault", "az")
    with pytest.raises(DeviceFault, match="azimuth"):
        driver.reset_fault()
    with pytest.raises(DeviceFault, match="azimuth"):
        driver.enable()
    assert bench.motors.enabled == [False, False]


def test_a_fault_stays_until_it_is_reset(bench, enabled):
    bench.fault("amplifier_fault", "az")
    until(enabled, lambda reading: reading.fault != "")
    bench.heal()
    assert until(enabled, lambda reading: not reading.enabled).fault != ""
    enabled.reset_fault()
    assert bench.motors.enabled == [False, False]
    assert exchange_for(enabled, 0.05, STILL).fault == ""
    enabled.enable()
    until(enabled, lambda reading: reading.enabled)


def test_a_reset_without_a_fault_is_harmless(bench, enabled):
    enabled.reset_fault()
    assert bench.motors.enabled == [False, False]
    assert exchange_for(enabled, 0.05, STILL).fault == ""


# ---------------------------------------------------------------- the link


def exchange_until_error(driver, velocity_rad_s=STILL):
    end_s = time.monotonic() + LONGEST_S
    while time.monotonic() < end_s:
        try:
            driver.exchange(velocity_rad_s)
        except DeviceError as error:
            return error
    return pytest.fail("no error")


def test_nobody_there_is_said_at_once(bench, driver):
    bench.fault("disconnect")
    with pytest.raises(DeviceError) as caught:
        driver.open()
    assert bench.siderostat.device.endpoint in caught.value.endpoint
    assert caught.value.hint


def test_a_lost_link_is_an_error_and_the_motors_come_to_rest_by_themselves(bench, enabled):
    exchange_for(enabled, 0.1, FAST)
    bench.fault(bench.link_fault)
    error = exchange_until_error(enabled, FAST)
    assert error.expected
    assert error.got
    assert error.hint
    assert rests(bench)


def test_after_a_lost_link_it_is_opened_again_and_knows_where_it_is(bench, enabled):
    exchange_for(enabled, 0.1, FAST)
    bench.fault(bench.link_fault)
    exchange_until_error(enabled, FAST)
    assert rests(bench)
    bench.heal()
    enabled.open()
    enabled.reset_fault()
    truth = bench.motors.position_rad()
    assert reading_of(enabled).position_rad == pytest.approx(truth, abs=1.5 * bench.count_rad)
    enabled.enable()
    until(enabled, lambda reading: reading.enabled)


@pytest.mark.parametrize(
    ("kind", "settings"),
    [
        ("drop", {"probability": 0.3}),
        ("delay", {"value": 0.03}),
        ("delay", {"value": 0.03, "probability": 0.3}),
        ("corrupt", {"probability": 0.2}),
        ("duplicate", {}),
        ("reorder", {"probability": 0.3}),
        ("freeze", {"for_s": 0.15}),
        ("disconnect", {"for_s": 0.1}),
        ("reboot", {"value": 0.1}),
    ],
)
def test_whatever_the_wire_does_there_is_an_error_or_a_true_reading(bench, enabled, kind, settings):
    """Neither a hang nor a place where the motor was not."""
    exchange_for(enabled, 0.05, SLOWLY)
    began = bench.motors.position_rad()
    bench.fault(kind, **settings)
    end_s = time.monotonic() + 0.4
    try:
        while time.monotonic() < end_s:
            reading = enabled.exchange(SLOWLY)
            now = bench.motors.position_rad()
            if reading is None:
                continue
            for was, read, is_ in zip(began, reading.position_rad, now, strict=True):
                assert min(was, is_) - 0.3 < read < max(was, is_) + 0.3
    except DeviceError as error:
        assert error.hint  # noqa: PT017 - one of two lawful outcomes
    assert time.monotonic() < end_s + LONGEST_S
