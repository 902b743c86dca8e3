import socket
import threading
import time
from contextlib import contextmanager

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl.config import DacMock, default_rig_path, load_rig
from fitctl.drivers.interface import (
    DeviceError,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.modbus_dac.driver import ModbusDac
from fitctl.mocks.modbus_dac.server import ModbusDacMock

DAC = load_rig(default_rig_path()).loops["right"].fsm.dac
MID = np.full(3, 5.0)
COUNT_V = 10 / 65535


def station_at(port, **changes):
    return DAC.model_copy(update={"port": port, **changes})


@pytest.fixture
def mock(in_loop):
    async def made():
        return ModbusDacMock(DAC, DacMock(watchdog_s=30.0, safe_v=5.0), lambda volts: None, port=0)

    device = in_loop(made())
    device.port = in_loop(device.start())
    yield device
    in_loop(device.stop())


@pytest.fixture
def dac(mock):
    driver = ModbusDac(station_at(mock.port, response_timeout_s=0.5))
    driver.open()
    yield driver
    driver.close()


@contextmanager
def scripted_station(answer):
    """A station that answers every request by `answer(function_code, data)`, in a right header."""

    def serve():
        try:
            link, _ = listener.accept()
        except OSError:
            return
        with link:
            while len(request := link.recv(300)) >= 8:
                pdu = answer(request[7], request[8:])
                length = (len(pdu) + 1).to_bytes(2, "big")
                link.sendall(request[:4] + length + request[6:7] + pdu)

    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=serve)
        thread.start()
        yield listener.getsockname()[1]
        listener.shutdown(socket.SHUT_RDWR)
        thread.join(10)


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
    dac.write_v(volts)
    assert mock.outputs_v == pytest.approx(volts, abs=0.51 * COUNT_V)
    assert dac.read_v() == pytest.approx(volts, abs=0.51 * COUNT_V)


@pytest.mark.parametrize("bad_v", [-0.001, 10.001, np.nan])
def test_volts_out_of_range_are_never_sent(mock, dac, bad_v):
    before = mock.outputs_v
    with pytest.raises(ValueError, match="channel 2 gives 0 to 10 V"):
        dac.write_v(np.array([1.0, bad_v, 1.0]))
    assert mock.outputs_v == before


def test_a_refusal_is_named(mock, dac):
    mock.refuse_with = 6
    with pytest.raises(DeviceRefused, match="exception 06, device busy"):
        dac.write_v(MID)
    mock.refuse_with = 0
    dac.write_v(MID)


@pytest.mark.parametrize(
    ("changes", "says"),
    [({"first_register": 40}, "first_register"), ({"device_id": 9}, "device_id")],
)
def test_opening_the_wrong_registers_or_station_names_the_key_to_correct(mock, changes, says):
    driver = ModbusDac(station_at(mock.port, **changes))
    with pytest.raises(DeviceRefused, match=says):
        driver.open()
    with pytest.raises(DeviceUnreachable):
        driver.write_v(MID)


def test_silence_is_a_timeout_and_the_next_write_works(mock, dac):
    mock.silent = True
    started_s = time.monotonic()
    with pytest.raises(DeviceTimeout, match=r"within 0\.5 s, got none"):
        dac.write_v(np.zeros(3))
    assert 0.4 < time.monotonic() - started_s < 2
    mock.silent = False
    dac.write_v(MID)
    assert mock.outputs_v == pytest.approx(MID, abs=COUNT_V)


def test_a_lost_link_is_an_error_until_it_is_opened_again(mock, dac, in_loop):
    async def drop():
        mock.drop_links()

    in_loop(drop())
    for _ in range(3):
        started_s = time.monotonic()
        with pytest.raises(DeviceUnreachable):
            dac.write_v(MID)
        assert time.monotonic() - started_s < 0.3
    dac.open()
    dac.write_v(MID)


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
        driver.write_v(MID)
        driver.close()


@pytest.mark.parametrize(
    "lie", ["10 00 00 00 02", "10 00 05 00 03", "06 00 00 00 03", "47 00"], ids=str
)
def test_an_answer_that_does_not_fit_the_write_is_a_protocol_error(lie):
    def answer(function_code, data):
        return bytes.fromhex(lie) if function_code == 16 else correctly(function_code, data)

    with scripted_station(answer) as port:
        driver = ModbusDac(station_at(port))
        driver.open()
        with pytest.raises(DeviceProtocolError):
            driver.write_v(MID)
        with pytest.raises(DeviceUnreachable):
            driver.write_v(MID)


@settings(max_examples=40, deadline=None)
@given(st.binary(min_size=1, max_size=20), st.sampled_from([3, 16]))
def test_whatever_is_answered_nothing_but_device_errors_come_out(noise, spoilt):
    def answer(function_code, data):
        return noise if function_code == spoilt else correctly(function_code, data)

    with scripted_station(answer) as port:
        driver = ModbusDac(station_at(port, response_timeout_s=0.05))
        try:
            driver.open()
            driver.write_v(MID)
        except DeviceError:
            pass
        finally:
            driver.close()
