import contextlib
import os
import pty
import select
import socket
import threading
import time
import tty

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from scripted_server import scripted_server

from fitctl.config import ConfigError, Fault, default_rig_path, load_rig
from fitctl.drivers.interface import (
    DeviceError,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.drivers.modbus_dac.protocol import WRITE_MULTIPLE_REGISTERS
from fitctl.mocks.modbus import rtu
from fitctl.mocks.modbus_dac.server import ModbusDacMock

RIG = load_rig(default_rig_path())
DAC = RIG.loops["right"].fsm.dac
SETTINGS = RIG.mocks.loops["right"].dac.model_copy(update={"watchdog_s": 30.0})
MID = np.full(3, 5.0)
COUNT_V = 10 / 65535


def write(dac, volts):
    dac.send_v(volts)
    dac.confirm()


def station_at(port, **changes):
    return DAC.model_copy(update={"port": port, **changes})


@pytest.fixture
def mock(in_loop):
    async def made():
        return ModbusDacMock(DAC, SETTINGS, lambda volts: None, port=0)

    device = in_loop(made())
    device.ends = in_loop(device.start())
    yield device
    in_loop(device.stop())


@pytest.fixture
def wrong(mock, in_loop):
    """Begin a fault of the mock, or end all without a kind."""

    async def change(kind="", **settings):
        if kind:
            mock.faults.set(Fault(device="right.dac", kind=kind, **settings))
        else:
            mock.faults.clear()

    return lambda *arguments, **settings: in_loop(change(*arguments, **settings))


@pytest.fixture(params=["tcp", "rtu"])
def station(request, mock):
    """The mock as the rig file would name it, by either wire."""
    return station_at(mock.ends.tcp_port, transport=request.param, serial_port=mock.ends.pty_path)


@pytest.fixture
def dac(station):
    driver = ModbusDac(station)
    driver.open()
    yield driver
    driver.close()


def scripted_station(answer):
    """A station that answers every request by `answer(function_code, data)`, in a right header."""

    def talk(link):
        while len(request := link.recv(300)) >= 8:
            pdu = answer(request[7], request[8:])
            length = (len(pdu) + 1).to_bytes(2, "big")
            link.sendall(request[:4] + length + request[6:7] + pdu)

    return scripted_server(talk)


def correctly(function_code, data):
    """What a station without identification answers."""
    if function_code == 3:
        return bytes.fromhex("03 06 80 00 80 00 80 00")
    if function_code == 16:
        return bytes([16]) + data[:4]
    return bytes([function_code | 0x80, 1])


def test_opening_tells_who_is_there_and_changes_no_output(mock, dac):
    assert dac.open().model == "mock D/A"
    assert mock.outputs_v == pytest.approx([5, 5, 5], abs=COUNT_V)
    assert dac.read_v() == pytest.approx([5, 5, 5], abs=COUNT_V)


def test_a_write_sets_the_outputs_before_it_returns(mock, dac):
    volts = np.array([0.0, 3.3, 10.0])
    write(dac, volts)
    assert mock.outputs_v == pytest.approx(volts, abs=0.51 * COUNT_V)
    assert dac.read_v() == pytest.approx(volts, abs=0.51 * COUNT_V)


@pytest.mark.parametrize("bad_v", [-0.001, 10.001, np.nan])
def test_volts_out_of_range_are_never_sent(mock, dac, bad_v):
    before = mock.outputs_v
    with pytest.raises(ValueError, match="channel 2 gives 0 to 10 V"):
        write(dac, np.array([1.0, bad_v, 1.0]))
    assert mock.outputs_v == before


def test_a_write_is_sent_at_once_and_its_answer_waited_for_when_asked(dac, wrong):
    wrong("delay", value=0.1)
    started_s = time.monotonic()
    dac.send_v(MID)
    assert time.monotonic() - started_s < 0.05
    dac.confirm()
    assert time.monotonic() - started_s > 0.1
    dac.confirm()  # nothing is left to wait for
    assert time.monotonic() - started_s < 0.2


def test_a_write_that_was_not_confirmed_is_confirmed_before_the_next_one(mock, dac, wrong):
    wrong("drop")
    dac.send_v(np.zeros(3))
    with pytest.raises(DeviceTimeout):
        dac.send_v(MID)
    assert mock.outputs_v == [0, 0, 0]  # nothing was sent after what nobody confirmed
    wrong()
    write(dac, MID)
    assert mock.outputs_v == pytest.approx(MID, abs=COUNT_V)


def test_an_answer_that_came_during_a_stall_is_an_answer(dac):
    dac.send_v(MID)
    threading.Event().wait(2 * DAC.response_timeout_s)
    dac.confirm()


def test_an_answer_in_two_pieces_is_one_answer():
    def talk(link):
        while len(request := link.recv(300)) >= 8:
            pdu = correctly(request[7], request[8:])
            message = request[:4] + (len(pdu) + 1).to_bytes(2, "big") + request[6:7] + pdu
            for piece in (message[:5], message[5:9], message[9:]):
                link.sendall(piece)
                threading.Event().wait(0.01)

    with scripted_server(talk) as port:
        driver = ModbusDac(station_at(port))
        driver.open()
        write(driver, MID)
        assert driver.read_counts() == [0x8000] * 3
        driver.close()


# ---------------------------------------------------------------- faults


def test_a_tripped_watchdog_is_refused_with_a_next_step_and_the_outputs_are_read_as_they_are(
    mock, dac, wrong
):
    write(dac, np.zeros(3))
    wrong("watchdog_trip")
    with pytest.raises(DeviceRefused, match=r"exception 04, device failure; .*watchdog"):
        write(dac, MID)
    with pytest.raises(DeviceRefused):
        dac.read_v()
    wrong()
    assert dac.read_v() == pytest.approx(MID, abs=COUNT_V)
    write(dac, np.zeros(3))
    assert mock.outputs_v == [0, 0, 0]


def test_a_watchdog_that_ran_out_unseen_shows_when_the_outputs_are_read(mock, dac, wrong):
    write(dac, np.zeros(3))
    wrong("watchdog_trip", for_s=1e-3)
    threading.Event().wait(0.01)
    assert dac.read_v() == pytest.approx(MID, abs=COUNT_V)


@pytest.mark.parametrize("kind", ["drop", "freeze"])
def test_silence_is_a_timeout_and_the_next_write_works(mock, dac, wrong, kind):
    wrong(kind)
    started_s = time.monotonic()
    with pytest.raises(DeviceTimeout, match=r"within 0\.25 s, got none"):
        write(dac, np.zeros(3))
    assert 0.2 < time.monotonic() - started_s < 2
    wrong()
    write(dac, MID)
    assert mock.outputs_v == pytest.approx(MID, abs=COUNT_V)


def test_a_late_answer_within_the_time_limit_is_an_answer(dac, wrong):
    wrong("delay", value=0.05)
    write(dac, np.array([1.0, 2.0, 3.0]))
    assert dac.read_v() == pytest.approx([1, 2, 3], abs=COUNT_V)


def test_an_answer_that_is_too_late_is_never_taken_for_the_next_ones(mock, dac, wrong):
    write(dac, np.zeros(3))
    wrong("delay", value=0.35)
    with pytest.raises(DeviceTimeout):
        dac.read_v()  # its answer, zeros, is still on its way
    wrong()
    write(dac, np.array([1.0, 2.0, 3.0]))
    assert dac.read_v() == pytest.approx([1, 2, 3], abs=COUNT_V)


def test_answers_that_come_twice_or_swapped_do_no_harm(dac, wrong):
    for kind, volts in (("duplicate", [1.0, 2.0, 3.0]), ("reorder", [4.0, 5.0, 6.0])):
        wrong(kind)
        write(dac, np.array(volts))
        assert dac.read_v() == pytest.approx(volts, abs=COUNT_V)


@contextlib.contextmanager
def repeating_line():
    """A station on a serial line whose every answer comes again just before the next one; gives the path."""
    ours, theirs = pty.openpty()
    tty.setraw(theirs)
    ending = threading.Event()

    def serve():
        counts, before = bytes(6), b""
        while not ending.is_set():
            if not select.select([ours], [], [], 0.01)[0]:
                continue
            request = os.read(ours, 300)
            counts = request[7:13] if request[1] == WRITE_MULTIPLE_REGISTERS else counts
            pdu = {3: bytes([3, 6]) + counts, 16: request[1:6]}.get(request[1], b"\xab\x01")
            answer = rtu.frame(request[0], pdu)
            os.write(ours, before)
            threading.Event().wait(0.002)
            os.write(ours, answer)
            before = answer

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(theirs)
    finally:
        ending.set()
        thread.join()
        os.close(ours)
        os.close(theirs)


def test_over_rtu_an_answer_that_comes_again_during_the_next_request_is_no_answer_to_it():
    with repeating_line() as path:
        dac = ModbusDac(station_at(1, transport="rtu", serial_port=path))
        dac.open()
        for volts in ([1.0, 2.0, 3.0], [4.0, 5.0, 6.0]):
            write(dac, np.array(volts))
            counts = dac.read_counts()  # while the answer to the write comes again
            assert np.array(counts) * COUNT_V == pytest.approx(volts, abs=COUNT_V)
        dac.close()


def test_a_turned_bit_is_an_error_or_harmless_and_never_another_voltage(station, wrong):
    volts = np.array([1.0, 2.0, 3.0])
    hurried = station.model_copy(update={"response_timeout_s": 0.25})
    driver = ModbusDac(hurried)
    seen = set()
    for _ in range(8):
        wrong()
        driver.open()
        write(driver, volts)
        wrong("corrupt")
        try:
            assert driver.read_v() == pytest.approx(volts, abs=COUNT_V)
        except DeviceError as error:
            seen.add(type(error))
    driver.close()
    assert seen
    assert seen <= {DeviceProtocolError, DeviceRefused, DeviceTimeout}


@pytest.mark.parametrize("kind", ["disconnect", "reboot"])
def test_a_lost_link_over_tcp_is_an_error_until_it_is_opened_again(mock, wrong, kind):
    dac = ModbusDac(station_at(mock.ends.tcp_port))
    dac.open()
    wrong(kind, value=30.0 if kind == "reboot" else None)
    for _ in range(3):
        started_s = time.monotonic()
        with pytest.raises(DeviceUnreachable):
            write(dac, MID)
        assert time.monotonic() - started_s < 0.3
    with pytest.raises(DeviceUnreachable):
        dac.open()
    wrong()
    dac.open()
    write(dac, MID)
    dac.close()


@pytest.mark.parametrize("kind", ["disconnect", "reboot"])
def test_an_unplugged_serial_line_is_silent_until_it_is_plugged_in_again(mock, wrong, kind):
    dac = ModbusDac(station_at(1, transport="rtu", serial_port=mock.ends.pty_path))
    dac.open()
    wrong(kind, value=30.0 if kind == "reboot" else None)
    with pytest.raises(DeviceTimeout):
        write(dac, MID)
    wrong()
    write(dac, MID)
    dac.close()


def test_a_serial_port_that_goes_away_is_unreachable(mock, in_loop):
    dac = ModbusDac(station_at(1, transport="rtu", serial_port=mock.ends.pty_path))
    dac.open()
    in_loop(mock.stop())
    with pytest.raises(DeviceUnreachable, match="broken connection"):
        write(dac, MID)
    with pytest.raises(DeviceUnreachable, match="open it again"):
        write(dac, MID)
    dac.close()


# ---------------------------------------------------------------- what is not as it should be


@pytest.mark.parametrize(
    ("changes", "says"),
    [({"first_register": 40}, "first_register"), ({"device_id": 9}, "device_id")],
)
def test_opening_the_wrong_registers_or_station_names_the_key_to_correct(mock, changes, says):
    driver = ModbusDac(station_at(mock.ends.tcp_port, **changes))
    with pytest.raises(DeviceRefused, match=says):
        driver.open()
    with pytest.raises(DeviceUnreachable):
        write(driver, MID)


@pytest.mark.parametrize(
    ("changes", "says"), [({"device_id": 9}, "device_id"), ({"baud_rate": 9600}, "baud_rate")]
)
def test_over_rtu_the_wrong_unit_or_baud_rate_is_silence(mock, changes, says):
    port = mock.ends.pty_path
    driver = ModbusDac(station_at(1, transport="rtu", serial_port=port, **changes))
    with pytest.raises(DeviceTimeout, match=says):
        driver.open()


@pytest.mark.parametrize(
    ("overrides", "says"),
    [
        (["transport='rtu'"], "serial_port must be a serial port"),
        (["transport='rtu'", "serial_port='/dev/ttyUSB0'", "device_id=0"], "device_id: must be"),
        (["serial_format='7E1'"], "serial_format"),
        (["first_register=65534"], "first_register"),
    ],
)
def test_a_rig_file_that_cannot_reach_it_is_refused(overrides, says):
    sets = [f"loops.right.fsm.dac.{override}" for override in overrides]
    with pytest.raises(ConfigError, match=says):
        load_rig(default_rig_path(), sets)


def test_a_serial_port_that_does_not_exist_is_unreachable():
    driver = ModbusDac(station_at(1, transport="rtu", serial_port="/dev/no-such-port"))
    with pytest.raises(DeviceUnreachable, match=r"/dev/no-such-port.*dac\.serial_port"):
        driver.open()
    driver.close()


def test_nobody_there_is_unreachable_and_close_is_always_safe():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    driver = ModbusDac(station_at(port))
    with pytest.raises(DeviceUnreachable, match=rf"127\.0\.0\.1:{port}.*dac\.host"):
        driver.open()
    driver.close()
    driver.close()


def test_a_station_without_identification_is_usable():
    with scripted_station(correctly) as port:
        driver = ModbusDac(station_at(port))
        assert driver.open().maker == "unknown"
        write(driver, MID)
        driver.close()


@pytest.mark.parametrize(
    "lie", ["10 00 00 00 02", "10 00 05 00 03", "06 00 00 00 03", "47 00", "83 02"], ids=str
)
def test_an_answer_that_does_not_fit_the_write_is_a_protocol_error(lie):
    def answer(function_code, data):
        return bytes.fromhex(lie) if function_code == 16 else correctly(function_code, data)

    with scripted_station(answer) as port:
        driver = ModbusDac(station_at(port))
        driver.open()
        with pytest.raises(DeviceProtocolError):
            write(driver, MID)
        with pytest.raises(DeviceUnreachable):
            write(driver, MID)


def test_pymodbus_own_server_is_a_station_too(in_loop):
    async def serve():
        registers = SimData(0, values=[0x8000] * 3, datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(DAC.device_id, registers), address=("127.0.0.1", 0))
        await server.listen()
        return server

    server = in_loop(serve())
    driver = ModbusDac(station_at(server.transport.sockets[0].getsockname()[1]))
    driver.open()
    assert driver.read_v() == pytest.approx(MID, abs=COUNT_V)
    write(driver, np.array([1.0, 2.0, 3.0]))
    assert driver.read_v() == pytest.approx([1, 2, 3], abs=COUNT_V)
    driver.close()
    in_loop(server.shutdown())


@settings(max_examples=40, deadline=None)
@given(st.binary(min_size=1, max_size=20), st.sampled_from([3, 16]))
def test_whatever_is_answered_nothing_but_device_errors_come_out(noise, spoilt):
    def answer(function_code, data):
        return noise if function_code == spoilt else correctly(function_code, data)

    with scripted_station(answer) as port:
        driver = ModbusDac(station_at(port, response_timeout_s=0.05))
        try:
            driver.open()
            write(driver, MID)
        except DeviceError:
            pass
        finally:
            driver.close()
