"""What the driver makes of each fault of the mock: a typed error or a sound reading, in bounded time."""

import time

import pytest

from fitctl.drivers.interface import (
    DeviceError,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceTimeout,
    DeviceUnreachable,
)

pytestmark = pytest.mark.long

# Twice response_timeout_s for a question after one that went wrong, and stalls of the machine.
SOON_S = 2.0


@pytest.fixture
def bench(start, request):
    bench = start(echo=getattr(request, "param", True))
    bench.mock.set_external_input_v([5.0, 2.0, 1.0])  # 75, 30 and 15 V at the stacks
    return bench


# Without echo nothing in an answer tells to which question it belongs.
with_and_without_echo = pytest.mark.parametrize(
    "bench", [True, False], ids=["echo", "no echo"], indirect=True
)


def reads_soundly(piezo):
    assert piezo.stack_volts() == pytest.approx([75.0, 30.0, 15.0], abs=1.0)
    assert piezo.limit_v() == 150.0


@pytest.mark.parametrize("kind", ["drop", "freeze", "silent"])
def test_no_answer_is_a_timeout_and_the_driver_finds_its_way_back(bench, kind):
    with bench.opened() as piezo:
        reads_soundly(piezo)
        bench.set_fault(kind)
        started_s = time.monotonic()
        with pytest.raises(DeviceTimeout, match=r"within 0\.4 s, got none; check that .* on"):
            piezo.limit_v()
        assert 0.3 < time.monotonic() - started_s < SOON_S
        bench.clear_faults()
        reads_soundly(piezo)


@with_and_without_echo
def test_a_delay_within_the_time_limit_only_costs_time(bench):
    with bench.opened() as piezo:
        # Longer than the silence that ends an answer without a prompt: a prompt that came late with the
        # answer before is no answer.
        bench.set_fault("delay", value=0.3)
        assert piezo.limit_v() == piezo.limit_v() == 150.0


@with_and_without_echo
def test_an_answer_that_comes_too_late_is_not_taken_for_the_next_one(bench):
    with bench.opened() as piezo:
        bench.set_fault("delay", value=0.6)
        with pytest.raises(DeviceTimeout):
            piezo.limit_v()
        bench.clear_faults()
        reads_soundly(piezo)


@with_and_without_echo
def test_a_corrupt_answer_never_becomes_a_reading(bench):
    refusals = 0
    with bench.opened() as piezo:
        bench.set_fault("corrupt")
        for _ in range(8):
            try:
                reads_soundly(piezo)
            except DeviceError:
                refusals += 1
        bench.clear_faults()
        reads_soundly(piezo)
    assert refusals >= 4


@with_and_without_echo
def test_a_bit_error_now_and_then_never_becomes_a_reading(bench):
    readings = 0
    with bench.opened() as piezo:
        bench.set_fault("corrupt", probability=0.05)
        for _ in range(8):
            try:
                reads_soundly(piezo)
                readings += 1
            except DeviceError:
                pass
    assert readings >= 1


@with_and_without_echo
def test_answers_that_come_twice_never_become_readings_of_something_else(bench):
    with bench.opened() as piezo:
        bench.set_fault("duplicate")
        for _ in range(2):
            with pytest.raises(DeviceProtocolError):
                reads_soundly(piezo)
        bench.clear_faults()
        reads_soundly(piezo)


def test_answers_out_of_order_only_come_later_because_one_is_asked_for_at_a_time(bench):
    with bench.opened() as piezo:
        bench.set_fault("reorder")
        reads_soundly(piezo)


def test_a_cut_tcp_connection_is_unreachable_until_it_can_be_opened_again(bench):
    with bench.opened(bench.tcp) as piezo:
        bench.set_fault("disconnect")
        for _ in range(2):
            with pytest.raises(DeviceUnreachable, match="broken link"):
                piezo.stack_volts()
        piezo.close()
        with pytest.raises(DeviceUnreachable, match="open it again"):
            piezo.stack_volts()
        with pytest.raises(DeviceUnreachable):
            piezo.open()
        bench.clear_faults()
        piezo.open()
        reads_soundly(piezo)


def test_a_pulled_rs_232_cable_is_silence(bench):
    with bench.opened() as piezo:
        bench.set_fault("disconnect")
        with pytest.raises(DeviceTimeout):
            piezo.stack_volts()
        bench.clear_faults()
        reads_soundly(piezo)


def test_a_reboot_takes_the_stacks_to_zero_and_comes_back_as_at_power_up(bench):
    with bench.opened() as piezo:
        bench.do(bench.controller.answer, "xvoltage=20")
        bench.set_fault("reboot", value=0.3)
        assert bench.amplifier.outputs_v == [0.0, 0.0, 0.0]
        with pytest.raises(DeviceTimeout):
            piezo.stack_volts()
        bench.clear_faults()
        piezo.open()
        reads_soundly(piezo)


def test_a_moved_limit_switch_is_a_mismatch_until_it_is_moved_back(bench):
    with bench.opened() as piezo:
        bench.set_fault("limit_switch", value=100.0)
        with pytest.raises(DeviceMismatch, match=r"limit switch at 150\.5 V, got 100 V; set"):
            piezo.limit_v()
        bench.clear_faults()
        reads_soundly(piezo)


def test_a_saturated_stack_is_read_as_what_it_is(bench):
    with bench.opened() as piezo:
        bench.set_fault("saturated_stack", part="y")
        assert piezo.stack_volts() == pytest.approx([75.0, 150.5, 15.0])
        bench.set_fault("saturated_stack")
        assert piezo.stack_volts() == pytest.approx([150.5, 150.5, 150.5])


def test_a_wrong_baud_rate_is_a_timeout_that_names_it(bench):
    with pytest.raises(DeviceTimeout, match=r"piezo\.baud_rate"), bench.opened(baud_rate=9600):
        pass


def test_an_answer_that_the_time_limit_cuts_off_is_none(start):
    bench = start(baud_rate=1200)  # its identity takes 1.4 s
    with pytest.raises(DeviceTimeout, match=r"an answer to id\?"), bench.opened(baud_rate=1200):
        pass
