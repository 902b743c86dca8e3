"""A drive, a master or a link that falls silent, and what both sides then do."""

import time
from types import SimpleNamespace

import can
import pytest
from can.interfaces.slcan import slcanBus
from cia402_bench import STILL, exchange_until, reading_of, wait_until

from fitctl.drivers.cia402 import link, protocol
from fitctl.drivers.cia402.driver import Cia402Amplifiers
from fitctl.drivers.cia402.protocol import State
from fitctl.drivers.interface import DeviceError, DeviceFault, DeviceTimeout, DeviceUnreachable


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


def test_silence_after_disable_is_no_fault(bench, amplifiers):
    amplifiers.open()
    amplifiers.enable()
    amplifiers.disable()
    time.sleep(2 * bench.siderostat.device.master_heartbeat_timeout_s)
    assert reading_of(amplifiers).fault == ""


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


def test_an_exchange_with_a_drive_that_has_a_bus_of_its_own_waits_a_period_for_its_answer(
    bench, amplifiers
):
    amplifiers.open()
    amplifiers.enable()
    reading_of(amplifiers)
    bench.fault("freeze")
    period_s, took_s = 1 / bench.siderostat.servo.rate_hz, []
    for _ in range(10):
        began_s = time.monotonic()
        amplifiers.exchange(STILL)
        took_s.append((time.monotonic() - began_s) / period_s)

    assert 0.9 < min(took_s) < 1.5  # a machine that stands still does not do so in each of them


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


def test_a_heartbeat_that_is_late_because_the_computer_stood_still_is_not_missing(
    bench, amplifiers
):
    amplifiers.open()
    exchange_for(amplifiers, 0.1)
    bench.stand_still(0.4)
    time.sleep(0.36)  # this thread stands still too, and looks before the drive can send
    exchange_for(amplifiers, 0.5)


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


def test_a_computer_that_stands_still_while_it_writes_breaks_no_connection(
    bench, amplifiers, monkeypatch
):
    """The adapter has taken the frames by then: pyserial would say that writing took too long."""
    amplifiers.open()
    port = amplifiers._opened().link._bus.serialPortOrig
    taken = port._socket

    class StandsStill:
        def send(self, data):
            count = taken.send(data)
            time.sleep(1.5 * link._SEND_TIMEOUT_S)
            return count

        def __getattr__(self, name):
            return getattr(taken, name)

    monkeypatch.setattr(port, "_socket", StandsStill())
    amplifiers.stage(STILL)


def test_an_adapter_that_takes_no_bytes_is_unreachable_within_the_time_limit(
    bench, amplifiers, monkeypatch
):
    amplifiers.open()
    monkeypatch.setattr(link, "select", SimpleNamespace(select=lambda *_: ([], [], [])))
    with pytest.raises(DeviceUnreachable, match="Could not write to the adapter"):
        amplifiers.stage(STILL)


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
