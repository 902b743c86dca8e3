"""The T7's driver against scripted stations, and with the mock."""

import contextlib
import math
import socket
import struct
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instruments.labjack_bench import AT_ONCE_S, DEVICE, ask_every_20_ms, device_at, sampled
from pydantic import ValidationError
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from scripted_server import scripted_server

from fitctl.config import LabJackT7Device
from fitctl.drivers.interface import (
    DeviceError,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.labjack_t7.driver import LabJackT7, probe_labjack
from fitctl.mocks.modbus.tcp import frame, pop_message

SAMPLE_BYTES = 25  # of an answer with four FLOAT32
PRODUCT_ID, FIRMWARE, SERIAL = 60000, 60004, 60028


def float32(value):
    return list(struct.unpack(">2H", struct.pack(">f", value)))


class Script:
    """A T7 of a few registers, whose every answer a test can replace.

    Attributes
    ----------
    words : dict
        Its 16-bit registers.
    respond : callable
        Gives the bytes that answer a message.
    requests : list of str
        The PDUs that came.
    """

    def __init__(self):
        self.words = {}
        self.requests = []
        self.respond = self.answer
        for address, words in {
            0: [word for value in (5.0, 4.0, 3.0, 2.0) for word in float32(value)],
            PRODUCT_ID: float32(7.0),
            FIRMWARE: float32(1.0312),
            60010: [0, 0],
            SERIAL: [0x1C03, 0xCE59],
        }.items():
            self.put(address, words)

    def put(self, address, words):
        self.words |= dict(enumerate(words, address))

    def volts(self, *volts):
        self.put(0, [word for value in volts for word in float32(value)])

    def answer(self, message):
        return frame(message.transaction, message.unit, self.pdu(message.pdu))

    def pdu(self, request):
        function, address, count = struct.unpack(">BHH", request[:5])
        if function == 16:
            self.put(address, struct.unpack(f">{count}H", request[6:]))
            return request[:5]
        places = range(address, address + count)
        if function != 3 or not all(place in self.words for place in places):
            return bytes([function | 0x80, 2])
        return struct.pack(f">BB{count}H", 3, 2 * count, *(self.words[place] for place in places))

    def talk(self, client):
        pending = bytearray()
        while data := client.recv(1000):
            pending += data
            while (message := pop_message(pending)) is not None:
                self.requests.append(message.pdu.hex(" "))
                client.sendall(self.respond(message))


def wait_until_arrived(driver, count):
    """Until so many bytes are with the driver's kernel; gives when they were found there."""
    end_s = time.monotonic() + 5.0
    while True:
        with contextlib.suppress(BlockingIOError):
            if len(driver._link._socket.recv(1000, socket.MSG_PEEK)) >= count:
                return time.monotonic()
        assert time.monotonic() < end_s
        time.sleep(0.001)


@pytest.fixture
def script():
    script = Script()
    with scripted_server(script.talk) as script.port:
        yield script


@pytest.fixture
def driver(script):
    driver = LabJackT7(device_at(script.port), check_every_s=math.inf)
    yield driver
    driver.close()


# ---------------------------------------------------------------- opening


def test_opening_reads_who_it_is_and_writes_every_setting_and_reads_it_back(driver, script):
    identity = driver.open()
    assert (identity.maker, identity.model) == ("LabJack", "T7")
    assert (identity.serial, identity.firmware) == ("470011481", "1.0312")
    assert script.requests == [
        "03 ea 6a 00 02",  # HARDWARE_INSTALLED
        "03 ea 60 00 02",  # PRODUCT_ID
        "03 ea 64 00 02",  # FIRMWARE_VERSION
        "03 ea 7c 00 02",  # SERIAL_NUMBER
        "10 ab 7c 00 02 04 41 20 00 00",  # AIN_ALL_RANGE: 10 V
        "03 ab 7c 00 02",
        "10 ab 7e 00 01 02 00 c7",  # AIN_ALL_NEGATIVE_CH: single-ended
        "03 ab 7e 00 01",
        "10 ab 7f 00 01 02 00 04",  # AIN_ALL_RESOLUTION_INDEX
        "03 ab 7f 00 01",
        "10 ab 80 00 02 04 00 00 00 00",  # AIN_ALL_SETTLING_US
        "03 ab 80 00 02",
        "03 00 00 00 08",  # AIN0 to AIN3
    ]


@pytest.mark.parametrize(
    ("address", "words", "changes", "says"),
    [
        (
            PRODUCT_ID,
            float32(4.0),
            {},
            r"a T7, PRODUCT_ID 7, got 4; check that sensor\.device\.host",
        ),
        (SERIAL, [0, 5], {"serial_number": 6}, r"serial number 6, got 5; .*serial_number"),
        (SERIAL, [0, 5], {"resolution_index": 9}, r"a T7-Pro.*resolution_index to 8 or less"),
    ],
)
def test_another_device_than_the_rig_file_says_is_a_mismatch_and_no_setting_is_written(
    script, address, words, changes, says
):
    script.put(address, words)
    driver = LabJackT7(device_at(script.port, **changes))
    with pytest.raises(DeviceMismatch, match=says):
        driver.open()
    assert not [request for request in script.requests if request.startswith("10")]
    with pytest.raises(DeviceUnreachable, match="open it again"):
        driver.send_request()


def test_the_t7_of_the_rig_files_serial_number_and_a_pro_are_right(script):
    script.put(60010, [0, 1])
    changes = {"serial_number": 0x1C03CE59, "resolution_index": 12, "response_timeout_s": 5.0}
    driver = LabJackT7(device_at(script.port, **changes))
    assert driver.open().model == "T7-Pro"
    driver.close()


def test_a_setting_that_does_not_stay_is_a_mismatch(driver, script):
    def forgetful(message):
        if message.pdu[:3] == bytes.fromhex("10 ab 7c"):
            script.put(43900, float32(1.0))
            return frame(message.transaction, message.unit, message.pdu[:5])
        return script.answer(message)

    script.respond = forgetful
    with pytest.raises(DeviceMismatch, match="register 43900 to read 10, as written, got 1; "):
        driver.open()


def test_a_refused_setting_is_named_with_labjacks_own_error(driver, script):
    def refusing(message):
        if message.pdu[:3] == bytes.fromhex("10 ab 7f"):
            return frame(message.transaction, message.unit, bytes.fromhex("90 03"))
        return script.answer(message)

    script.put(55000, [2375])
    script.respond = refusing
    with pytest.raises(
        DeviceRefused, match=r"exception 03, illegal data value \(LabJack error AIN_RES"
    ):
        driver.open()


def test_a_modbus_station_that_is_no_labjack_is_refused_with_what_to_check(script):
    script.words = dict.fromkeys(range(8), 0)
    with pytest.raises(DeviceRefused, match=r"exception 02.*sensor\.device\.host and \.port lead"):
        LabJackT7(device_at(script.port)).open()


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_an_identity_that_is_no_number_is_a_protocol_error(driver, script, value):
    script.put(PRODUCT_ID, float32(value))
    with pytest.raises(DeviceProtocolError, match="a number in register 60000"):
        driver.open()


def test_nobody_there_is_unreachable_and_close_is_always_safe():
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    driver = LabJackT7(device_at(port))
    with pytest.raises(DeviceUnreachable, match=rf"127\.0\.0\.1:{port}.*sensor\.device\.host"):
        driver.open()
    for request in (driver.send_request, driver.receive):
        with pytest.raises(DeviceUnreachable, match="open it again"):
            request()
    driver.close()
    driver.close()


def test_a_station_that_says_nothing_is_a_timeout_at_opening():
    with scripted_server(lambda client: client.recv(1000) and time.sleep(1)) as port:
        started_s = time.monotonic()
        with pytest.raises(DeviceTimeout, match=r"an answer within 0\.25 s, got none; check"):
            LabJackT7(device_at(port)).open()
        assert 0.2 < time.monotonic() - started_s < 1.0


# ---------------------------------------------------------------- samples


def test_a_sample_is_one_request_of_eight_registers(driver, script):
    driver.open()
    del script.requests[:]
    driver.send_request()
    assert sampled(driver).volts == (5.0, 4.0, 3.0, 2.0)
    assert script.requests == ["03 00 00 00 08"]
    assert driver.receive() is None


def test_photodiodes_are_read_from_the_inputs_that_the_rig_file_says(script):
    driver = LabJackT7(device_at(script.port, inputs=[3, 1, 0, 2]))
    driver.open()
    driver.send_request()
    assert sampled(driver).volts == (2.0, 4.0, 5.0, 3.0)
    driver.close()


@pytest.mark.usefixtures("kernel_stamps")
def test_a_sample_is_dated_midway_between_request_and_arrival_however_late_it_is_read(
    driver, script
):
    driver.open()

    answered_s = []

    def slowly(message):
        time.sleep(0.1)
        answered_s.append(time.monotonic())
        return script.answer(message)

    script.respond = slowly
    earliest_s = time.monotonic()
    driver.send_request()
    latest_s = time.monotonic()
    found_s = wait_until_arrived(driver, SAMPLE_BYTES)
    time.sleep(0.1)
    reading = driver.receive()
    assert reading.time_s >= (earliest_s + answered_s[0]) / 2
    assert reading.time_s <= (latest_s + found_s) / 2 + 1e-4


def test_of_several_samples_the_newest_is_returned_and_none_twice(driver, script):
    driver.open()
    volts = iter([(1.0, 0.0, 0.0, 0.0), (2.0, 0.0, 0.0, 0.0), (3.0, 0.0, 0.0, 0.0)])

    def next_volts(message):
        script.volts(*next(volts))
        return script.answer(message)

    script.respond = next_volts
    for _ in range(3):
        driver.send_request()
    wait_until_arrived(driver, 3 * SAMPLE_BYTES)
    assert driver.receive().volts[0] == 3.0
    assert driver.receive() is None


def test_nobody_waits_for_an_answer_until_its_time_limit_is_an_error_and_then_goes_on(
    driver, script
):
    driver.open()
    script.respond = lambda _message: b""
    for _ in range(10):
        started_s = time.monotonic()
        driver.send_request()
        assert driver.receive() is None
        assert time.monotonic() - started_s < AT_ONCE_S
    time.sleep(DEVICE.response_timeout_s)
    with pytest.raises(DeviceTimeout, match=r"within 0\.25 s"):
        driver.receive()
    assert driver.receive() is None  # what was sent before is given up
    script.respond = script.answer
    driver.send_request()
    assert sampled(driver).volts == (5.0, 4.0, 3.0, 2.0)


def test_a_late_answer_is_never_the_next_requests(driver, script):
    driver.open()
    held = []

    def hold(message):
        script.volts(9.0, 9.0, 9.0, 9.0)
        held.append(script.answer(message))
        return b""

    script.respond = hold
    driver.send_request()
    time.sleep(1.1 * DEVICE.response_timeout_s)
    with pytest.raises(DeviceTimeout):
        driver.receive()

    def release(message):
        script.volts(1.0, 1.0, 1.0, 1.0)
        return held.pop() + script.answer(message)

    script.respond = release
    driver.send_request()
    assert sampled(driver).volts == (1.0, 1.0, 1.0, 1.0)
    assert driver.receive() is None


def test_answers_that_come_twice_or_in_the_wrong_order_do_no_harm(driver, script):
    driver.open()
    opened = len(script.requests)
    held = []

    def swapped(message):
        script.volts(float(len(script.requests) - opened), 0.0, 0.0, 0.0)
        held.append(script.answer(message))
        return b"" if len(held) == 1 else held[1] + held[0] + held[1]

    script.respond = swapped
    driver.send_request()
    driver.send_request()
    wait_until_arrived(driver, 3 * SAMPLE_BYTES)
    assert driver.receive().volts[0] == 2.0
    assert driver.receive() is None  # the first one, older than the second, and the second again


def test_an_answer_in_pieces_is_one_sample(driver, script):
    driver.open()
    whole = []

    def in_pieces(message):
        whole.append(script.answer(message))
        return whole[0][:9]

    script.respond = in_pieces
    driver.send_request()
    wait_until_arrived(driver, 9)
    assert driver.receive() is None
    script.respond = lambda message: whole[0][9:] + script.answer(message)
    driver.send_request()
    wait_until_arrived(driver, 2 * SAMPLE_BYTES - 9)
    assert driver.receive().volts == (5.0, 4.0, 3.0, 2.0)


@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, -9999.0, 11.6])
def test_what_no_input_reads_is_a_protocol_error_and_opening_again_mends_it(driver, script, value):
    driver.open()
    script.volts(1.0, 2.0, value, 4.0)
    driver.send_request()
    with pytest.raises(DeviceProtocolError, match=r"AIN2 to read -11\.5 to 11\.5 V, got"):
        sampled(driver)
    with pytest.raises(DeviceUnreachable):
        driver.send_request()
    script.volts(1.0, 2.0, 3.0, 4.0)
    driver.open()
    driver.send_request()
    assert sampled(driver).volts == (1.0, 2.0, 3.0, 4.0)


def test_the_end_of_the_range_is_a_reading(driver, script):
    driver.open()
    script.volts(10.1, -10.5, 0.0, 0.0)
    driver.send_request()
    assert sampled(driver).volts == pytest.approx((10.1, -10.5, 0.0, 0.0))


@pytest.mark.parametrize(
    ("lie", "error"),
    [
        ("83 04", DeviceRefused),
        ("83 04 00", DeviceProtocolError),
        ("04 10" + " 00" * 16, DeviceProtocolError),
        ("03 0e" + " 00" * 14, DeviceProtocolError),
        ("03 10" + " 00" * 15, DeviceProtocolError),
        ("84 02", DeviceProtocolError),
    ],
)
def test_an_answer_that_is_no_sample_is_an_error(driver, script, lie, error):
    driver.open()
    script.respond = lambda message: frame(message.transaction, 1, bytes.fromhex(lie))
    driver.send_request()
    with pytest.raises(error):
        sampled(driver)


def test_an_answer_of_another_unit_is_a_protocol_error(driver, script):
    driver.open()
    script.respond = lambda message: frame(message.transaction, 2, script.pdu(message.pdu))
    driver.send_request()
    with pytest.raises(DeviceProtocolError, match="an answer of unit 1, got unit 2"):
        sampled(driver)


@settings(max_examples=60)
@given(st.binary(max_size=60))
def test_whatever_is_answered_a_sample_is_within_the_range_or_a_device_error_comes_out(noise):
    script = Script()
    with scripted_server(script.talk) as port:
        driver = LabJackT7(device_at(port))
        driver.open()
        script.respond = lambda message: frame(message.transaction, 1, b"\x03" + noise)
        driver.send_request()
        try:
            assert all(abs(value) <= 11.5 for value in sampled(driver).volts)
        except DeviceError:
            pass
        finally:
            driver.close()


def test_pymodbus_own_server_is_a_station_too(in_loop):
    volts = (5.0, 4.0, 3.0, 2.0)
    values = {
        0: [word for value in volts for word in float32(value)],
        43900: [0] * 6,
        PRODUCT_ID: float32(7.0) + float32(1.3) + float32(1.0312),
        60010: [0, 0],
        SERIAL: [0x1C03, 0xCE59],
    }

    async def serve():
        blocks = [
            SimData(address, values=words, datatype=DataType.REGISTERS)
            for address, words in values.items()
        ]
        server = ModbusTcpServer(SimDevice(1, blocks), address=("127.0.0.1", 0))
        await server.listen()
        return server

    server = in_loop(serve())
    driver = LabJackT7(device_at(server.transport.sockets[0].getsockname()[1]))
    assert driver.open().serial == "470011481"
    driver.send_request()
    assert sampled(driver).volts == volts
    driver.close()
    in_loop(server.shutdown())


# ---------------------------------------------------------------- its settings, while it samples

READ_SAMPLE, READ_SETTINGS = "03 00 00 00 08", "03 ab 7c 00 06"


def test_settings_are_read_beside_a_sample_now_and_then(script):
    with contextlib.closing(LabJackT7(device_at(script.port), check_every_s=0.1)) as driver:
        driver.open()
        opened = len(script.requests)
        for _ in range(25):
            driver.send_request()
            assert sampled(driver).volts == (5.0, 4.0, 3.0, 2.0)
            time.sleep(0.02)
    asked = script.requests[opened:]
    assert asked.count(READ_SAMPLE) == 25
    assert 3 <= asked.count(READ_SETTINGS) <= 25
    assert asked[0] == READ_SAMPLE


@pytest.mark.parametrize(
    ("address", "words", "got"),
    [
        (43900, float32(1.0), "43900 to read 10, as it was set, got 1"),
        (
            43900,
            float32(-9999.0),
            "43900 to read 10, as it was set, got other values of some inputs",
        ),
        (43900, float32(math.nan), "got nan"),
        (43902, [1], "43902 to read 199, as it was set, got 1"),
        (43903, [8], "43903 to read 4, as it was set, got 8"),
        (43904, float32(100.0), "43904 to read 0, as it was set, got 100"),
    ],
)
def test_a_setting_that_another_client_changes_is_a_mismatch_until_it_is_opened_again(
    script, address, words, got
):
    with contextlib.closing(LabJackT7(device_at(script.port), check_every_s=0.0)) as driver:
        driver.open()
        driver.send_request()
        sampled(driver)
        script.put(address, words)
        with pytest.raises(DeviceMismatch, match="another client") as error:
            ask_every_20_ms(driver)
        assert got in str(error.value)
        driver.open()
        ask_every_20_ms(driver)


def test_settings_that_are_not_answered_hold_up_no_sample(script):
    def respond(message):
        return b"" if message.pdu.hex(" ") == READ_SETTINGS else script.answer(message)

    with contextlib.closing(LabJackT7(device_at(script.port), check_every_s=0.0)) as driver:
        driver.open()
        script.respond = respond
        for _ in range(20):
            driver.send_request()
            assert sampled(driver).volts == (5.0, 4.0, 3.0, 2.0)
            time.sleep(0.02)


# ---------------------------------------------------------------- who is there


def test_a_probe_says_who_it_is_and_writes_nothing(script):
    probe = probe_labjack(device_at(script.port))
    assert (probe.identity.model, probe.disagreements) == ("T7", ())
    assert 0 < probe.round_trip_s < 1
    assert not [request for request in script.requests if request.startswith("10")]


def test_a_probe_says_what_differs_from_the_rig_file(script):
    (line,) = probe_labjack(device_at(script.port, serial_number=6)).disagreements
    assert line.startswith("expected serial number 6, got 470011481; ")
    script.put(PRODUCT_ID, float32(8.0))
    with pytest.raises(DeviceMismatch, match="PRODUCT_ID 7, got 8"):
        probe_labjack(device_at(script.port))


# ---------------------------------------------------------------- the rig file


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"range_v": 5.0}, "range_v must be one of 10, 1, 0.1, 0.01"),
        ({"inputs": [0, 1, 2, 2]}, "inputs must name each of 0 to 3 once"),
        ({"inputs": [0, 1, 2, 4]}, "inputs.3"),
        ({"resolution_index": 13}, "resolution_index"),
        ({"settling_us": 50_001.0}, "settling_us"),
        ({"port": 0}, "port"),
    ],
)
def test_a_rig_file_with_what_no_t7_has_is_refused(changes, says):
    with pytest.raises(ValidationError, match=says):
        LabJackT7Device(**{**DEVICE.model_dump(), **changes})
