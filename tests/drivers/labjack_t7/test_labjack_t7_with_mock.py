"""The T7's driver with the mock: what both are right about together, and each of the mock's faults."""

import contextlib
import threading
import time

import pytest
from instruments.labjack_bench import AT_ONCE_S, Bench, ask_every_20_ms, device_at, sampled

from fitctl.drivers.interface import (
    DeviceError,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.labjack_t7.driver import LabJackT7


@pytest.fixture
def bench(in_loop):
    async def start():
        bench = Bench(overhead_s=0.001)
        return bench, await bench.mock.start()

    bench, port = in_loop(start())
    bench.device = device_at(port)
    yield bench
    in_loop(bench.mock.stop())


@pytest.fixture
def wrong(bench, in_loop):
    """Begin a fault of the mock, or end all without a kind."""

    async def change(kind="", **settings):
        if kind:
            bench.begin(kind, **settings)
        else:
            bench.mock.faults.clear()

    return lambda *arguments, **settings: in_loop(change(*arguments, **settings))


@pytest.fixture
def opened(bench):
    driver = LabJackT7(bench.device)
    driver.open()
    yield driver
    driver.close()


def test_what_the_photodiodes_give_is_read_and_dated_within_the_round_trip(bench, opened):
    bench.volts[:] = [0.5, 1.5, 2.5, 9.5]
    sent_s = time.monotonic()
    opened.send_request()
    reading = sampled(opened)
    round_trip_s = time.monotonic() - sent_s
    assert reading.volts == pytest.approx([0.5, 1.5, 2.5, 9.5], abs=1e-3)
    assert abs(reading.time_s - bench.sampled_s[-1]) <= round_trip_s / 2


def test_a_frozen_t7_holds_up_nobody_and_answers_again(opened, wrong):
    wrong("freeze")
    with pytest.raises(DeviceTimeout):
        ask_every_20_ms(opened)
    wrong()
    opened.send_request()
    assert len(sampled(opened).volts) == 4


@pytest.mark.parametrize("kind", ["disconnect", "reboot"])
def test_a_lost_connection_is_an_error_until_it_is_opened_again(bench, opened, wrong, kind):
    wrong(kind, value=30.0 if kind == "reboot" else None)
    with pytest.raises(DeviceUnreachable):
        ask_every_20_ms(opened)
    with pytest.raises(DeviceUnreachable):
        opened.open()
    wrong()
    assert opened.open().model == "T7"
    opened.send_request()
    assert sampled(opened).volts == pytest.approx([5.0, 4.0, 3.0, 2.0], abs=1e-3)


@pytest.mark.parametrize("kind", ["not_a_number", "wrong_value"])
def test_a_spoilt_reading_is_a_protocol_error(opened, wrong, kind):
    wrong(kind, part="AIN1")
    opened.send_request()
    with pytest.raises(DeviceProtocolError, match="AIN1 to read"):
        sampled(opened)


def test_an_exception_is_refused_and_the_next_request_may_be_answered(opened, wrong):
    wrong("exception", value=6.0)
    opened.send_request()
    with pytest.raises(DeviceRefused, match="exception 06, device busy"):
        sampled(opened)
    wrong()
    opened.send_request()
    assert len(sampled(opened).volts) == 4


def test_a_turned_bit_is_an_error_a_lost_sample_or_a_voltage_within_the_range(bench, wrong):
    driver = LabJackT7(bench.device.model_copy(update={"response_timeout_s": 1.0}))
    for _ in range(10):
        wrong()
        driver.open()
        wrong("corrupt")
        driver.send_request()
        with contextlib.suppress(DeviceError):
            assert all(abs(value) <= 11.5 for value in sampled(driver).volts)
    driver.close()


def test_a_range_that_another_client_changes_is_noticed_and_opening_writes_it_again(
    bench, opened, wrong
):
    opened.send_request()
    sampled(opened)
    wrong("range_changed")
    since_s = time.monotonic()
    with pytest.raises(DeviceMismatch, match="43900 to read 10"):
        ask_every_20_ms(opened)
    assert time.monotonic() - since_s < 0.1 + 3 * AT_ONCE_S
    opened.open()
    opened.send_request()
    assert sampled(opened).volts == pytest.approx(bench.volts, abs=1e-3)


def test_many_requests_are_one_thread_and_no_memory(opened):
    before = threading.active_count()
    for _ in range(300):
        opened.send_request()
        sampled(opened)
    assert threading.active_count() == before
    end_s = time.monotonic() + 1.0
    while opened._outstanding:  # the settings' answer may come after the last sample
        opened.receive()
        assert time.monotonic() < end_s
