"""The analogue back end against scripted stations, and what is its own with the mock."""

import time

import pytest
from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice
from scripted_server import scripted_server

from fitctl import config
from fitctl.drivers.bal_analog.driver import BalAnalogAmplifiers, probe_bal_analog
from fitctl.drivers.interface import (
    DeviceFault,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.mocks.modbus.tcp import frame, pop_message

STILL = (0.0, 0.0)
MOCK = "mocks.loops.right.bal_analog"
DEVICE = "loops.right.siderostat.device"
COUNT_RAD = 6.283185307179586 / 4000


class Script:
    """A station whose every answer a test decides: `respond(number of exchange, message)` gives bytes."""

    def __init__(self):
        self.counters = [0, 0]
        self.faults = 0
        self.respond = self.answer
        self.requests = []

    def answer(self, message):
        if message.pdu[0] != 23:
            return frame(message.transaction, message.unit, bytes([message.pdu[0] | 0x80, 1]))
        registers = [*self.counters, self.faults]
        pdu = bytes([23, 6]) + b"".join(value.to_bytes(2, "big") for value in registers)
        return frame(message.transaction, message.unit, pdu)

    def talk(self, client):
        pending = bytearray()
        while data := client.recv(1000):
            pending += data
            while (message := pop_message(pending)) is not None:
                self.requests.append(message.pdu)
                client.sendall(self.respond(message))


@pytest.fixture
def script():
    script = Script()
    with scripted_server(script.talk) as script.port:
        yield script


@pytest.fixture
def driver(script):
    rig = config.load_rig(
        config.default_rig_path().parent / "fit-bal-analog.toml",
        [
            f"{DEVICE}.port={script.port}",
            "loops.right.siderostat.servo.rate_hz=100.0",
            "loops.right.siderostat.servo.gain_per_s=40.0",
            "loops.right.siderostat.servo.following_error_limit_rad=2.0",
        ],
    )
    driver = BalAnalogAmplifiers(rig.loops["right"].siderostat)
    yield driver
    driver.close()


def reading_of(driver, velocity_rad_s=STILL):
    for _ in range(100):
        reading = driver.exchange(velocity_rad_s)
        if reading is not None:
            return reading
    return pytest.fail("no reading")


def test_each_period_is_one_transaction_of_function_23(driver, script):
    driver.open()
    driver.enable()
    del script.requests[:]
    reading_of(driver, (6.0, -12.0))
    assert [request.hex(" ") for request in script.requests] == [
        "17 00 10 00 03 00 00 00 03 06 0c cd e6 67 00 03"  # 1 V, -2 V, both enabled
    ]


def test_lines_and_senses_as_the_rig_file_says(driver, script):
    device = driver._device.model_copy(
        update={
            "enabled_level": "low",
            "fault_level": "low",
            "velocity_rad_s_per_v": config.AxisPair(az=6.0, el=-6.0),
        }
    )
    driver._device = device
    script.faults = 0b11
    driver.open()
    assert script.requests[-1][-2:] == b"\x00\x03"
    driver.enable()
    reading = reading_of(driver, (6.0, 6.0))
    assert script.requests[-1].hex(" ").endswith("0c cd f3 33 00 00")
    assert reading.enabled
    script.faults = 0b01
    assert reading_of(driver).fault == "elevation: fault line"


def test_counters_are_counted_on_across_their_wrap_both_ways(driver, script):
    driver.open()
    time.sleep(0.005)
    script.counters = [65520, 20]
    reading_of(driver)
    for counters in ([65535, 0], [34, 65500], [70, 65460]):
        time.sleep(0.005)
        script.counters = counters
        reading = reading_of(driver)
    assert reading.position_rad == pytest.approx((70 * COUNT_RAD, -76 * COUNT_RAD))


def test_turns_are_kept_when_it_is_opened_again(driver, script):
    driver.open()
    for counter in range(0, 40_000, 200):  # steps that a motor can make in 5 ms
        time.sleep(0.005)
        script.counters = [counter, 0]
        reading_of(driver)
    driver.close()
    script.counters = [39_900, 0]
    driver.open()
    assert reading_of(driver).position_rad[0] == pytest.approx(39_900 * COUNT_RAD)


def at_rest(driver):
    """Enabled, and commanded to stand for so long that the motors have lost all speed."""
    driver.open()
    driver.enable()
    reading_of(driver)
    time.sleep(0.3)
    reading_of(driver)


def counting(script, *elevations):
    """Answers with these counters of elevation, one after the other, and with the last one for ever."""
    left = list(elevations)

    def respond(message):
        script.counters[1] = left.pop(0) if len(left) > 1 else left[0]
        return script.answer(message)

    script.respond = respond


@pytest.mark.parametrize("bit", [10, 12, 15])
def test_a_false_count_is_dropped_and_the_next_one_counts(driver, script, bit):
    """Bit 10 is within what the velocity limit allows in 0.3 s, but not for a motor at rest."""
    at_rest(driver)
    time.sleep(0.3)
    counting(script, 1 << bit, 1)
    readings = [driver.exchange(STILL) for _ in range(5)]
    counted = {round(one.position_rad[1] / COUNT_RAD) for one in readings if one is not None}
    assert counted == {1}
    assert None in readings


def test_a_false_count_that_comes_again_is_a_fault(driver, script):
    at_rest(driver)
    counting(script, 4096)
    with pytest.raises(
        DeviceFault, match=r"azimuth moved by 0.000 rad, elevation moved by 6.434 rad"
    ):
        reading_of(driver)


def test_a_motor_may_have_turned_as_fast_as_it_was_commanded(driver, script):
    at_rest(driver)
    reading_of(driver, (0.0, 30.0))
    time.sleep(0.1)
    script.counters = [0, 1900]  # 3 rad in 0.1 s
    assert reading_of(driver).position_rad[1] == pytest.approx(1900 * COUNT_RAD)


def test_motors_without_power_may_be_turned_by_hand(driver, script):
    at_rest(driver)
    driver.disable()
    time.sleep(0.1)
    script.counters = [0, 1900]
    assert reading_of(driver).position_rad[1] == pytest.approx(1900 * COUNT_RAD)


def test_a_false_count_while_it_is_disabled_is_read_again(driver, script):
    at_rest(driver)
    counting(script, 0, 1 << 15, 0)
    driver.disable()
    counting(script, 1 << 15, 0)
    driver.disable()
    assert reading_of(driver).position_rad == (0.0, 0.0)


def test_after_a_gap_in_which_counters_can_wrap_it_does_not_guess(driver, script, monkeypatch):
    driver.open()
    reading_of(driver)
    now_s = time.monotonic()
    monkeypatch.setattr("fitctl.drivers.bal_analog.driver.time.monotonic", lambda: now_s + 1.0)
    with pytest.raises(DeviceTimeout, match=r"within 0\.69 s, for the counters not to wrap unseen"):
        driver.exchange(STILL)


def test_a_late_answer_is_taken_when_it_comes_and_dated_by_its_own_request(driver, script):
    driver.open()
    held = []

    def late(message):
        held.append(script.answer(message))
        return held.pop(0) if len(held) > 3 else b""

    script.respond = late
    started_s = time.monotonic()
    assert [driver.exchange(STILL) for _ in range(3)] == [None, None, None]
    asked_s = time.monotonic()
    reading = driver.exchange(STILL)
    assert started_s < reading.time_s < asked_s + 0.5 * (time.monotonic() - started_s)


def test_an_exchange_waits_for_answers_until_its_period_ends(driver, monkeypatch):
    driver.open()
    deadlines_s = []
    monkeypatch.setattr(driver._link, "receive", deadlines_s.append)
    before_s = time.monotonic()
    driver.exchange(STILL)
    assert before_s + 0.01 <= deadlines_s[0] <= time.monotonic() + 0.01


def test_an_answer_that_is_lost_costs_one_reading(driver, script):
    driver.open()
    script.respond = lambda message: b""
    assert driver.exchange(STILL) is None
    script.respond = script.answer
    assert reading_of(driver) is not None
    assert not driver._outstanding


def test_answers_that_nobody_asked_for_are_passed_over(driver, script):
    driver.open()

    def twice_and_strange(message):
        strange = script.answer(message._replace(transaction=message.transaction ^ 0x5555))
        return strange + script.answer(message) * 2

    script.respond = twice_and_strange
    for _ in range(10):
        assert reading_of(driver).position_rad == (0.0, 0.0)


def test_silence_is_none_for_a_while_and_then_an_error(driver, script):
    driver.open()
    script.respond = lambda message: b""
    answers = []
    started_s = time.monotonic()
    with pytest.raises(DeviceTimeout, match=r"an answer within 0\.25 s, got none"):  # noqa: PT012
        while True:
            answers.append(driver.exchange(STILL))
    assert answers
    assert not any(answers)
    assert 0.25 < time.monotonic() - started_s < 2.0


@pytest.mark.parametrize(
    ("answer", "error", "said"),
    [
        (b"\x97\x02", DeviceRefused, "exception 02, illegal data address"),
        (b"\x97\x77", DeviceRefused, "exception 77"),
        (b"\x17\x06\x00\x00", DeviceProtocolError, "three registers"),
        (b"\x03\x06\x00\x00\x00\x00\x00\x00", DeviceProtocolError, "three registers"),
    ],
)
def test_what_is_no_reading_is_an_error(driver, script, answer, error, said):
    driver.open()
    script.respond = lambda message: frame(message.transaction, message.unit, answer)
    with pytest.raises(error, match=said):
        reading_of(driver)


def test_another_units_answer_is_an_error(driver, script):
    driver.open()
    script.respond = lambda message: script.answer(message._replace(unit=9))
    with pytest.raises(DeviceProtocolError, match="unit 9"):
        reading_of(driver)


def test_what_is_no_modbus_is_an_error_and_closes(driver, script):
    driver.open()
    script.respond = lambda message: b"HTTP/1.1 400 Bad Request\r\n"
    with pytest.raises(DeviceProtocolError, match="a Modbus header"):
        reading_of(driver)
    with pytest.raises(DeviceUnreachable):
        driver.exchange(STILL)


def test_a_station_that_cannot_do_it_is_refused_at_open(driver, script):
    script.respond = lambda message: frame(
        message.transaction, message.unit, bytes([message.pdu[0] | 0x80, 1])
    )
    with pytest.raises(DeviceRefused, match="does not know function 23"):
        driver.open()
    with pytest.raises(DeviceUnreachable):
        driver.exchange(STILL)


# ---------------------------------------------------------------- with a stranger's server


def test_pymodbus_own_server_is_a_station_too(in_loop, script, driver):
    async def serve():
        registers = SimData(0, values=[0] * 16 + [120, 65436, 0], datatype=DataType.REGISTERS)
        server = ModbusTcpServer(SimDevice(1, registers), address=("127.0.0.1", 0))
        await server.listen()
        return server

    server = in_loop(serve())
    port = server.transport.sockets[0].getsockname()[1]
    driver._device = driver._device.model_copy(update={"port": port})
    driver.open()
    driver.enable()
    reading = reading_of(driver, (6.0, 0.0))
    assert reading.position_rad == pytest.approx((120 * COUNT_RAD, -100 * COUNT_RAD))
    assert reading.enabled
    driver.close()
    in_loop(server.shutdown())


# ---------------------------------------------------------------- with the mock


def test_counters_anywhere_at_power_up_are_zero_or_below_their_half(bench_of):
    bench = bench_of("bal_analog", f"{MOCK}.counters_at_start=[30000, 60000]")
    bench.driver.open()
    az, el = reading_of(bench.driver).position_rad
    assert az == pytest.approx(30_000 * COUNT_RAD)
    assert el == pytest.approx(-5536 * COUNT_RAD)


def test_the_motor_turns_across_the_wrap(bench_of):
    bench = bench_of("bal_analog", f"{MOCK}.counters_at_start=[32700, 32800]")
    bench.driver.open()
    bench.driver.enable()
    before = reading_of(bench.driver).position_rad
    while (reading := reading_of(bench.driver, (10.0, -10.0))).position_rad[0] < before[0] + 1.0:
        pass
    turned = bench.motors.position_rad()
    for axis in range(2):
        moved = reading.position_rad[axis] - before[axis]
        assert moved == pytest.approx(turned[axis], abs=0.3)


def test_a_pause_longer_than_the_watchdog_stops_the_motors(bench_of):
    bench = bench_of("bal_analog", f"{MOCK}.watchdog_s=0.05")
    bench.driver.open()
    bench.driver.enable()
    reading_of(bench.driver, (5.0, 5.0))
    end_s = time.monotonic() + 5
    while bench.motors.enabled != [False, False]:
        assert time.monotonic() < end_s
        time.sleep(0.005)
    assert not bench.motors.moving


def test_an_offset_of_an_amplifier_turns_its_motor(bench_of):
    bench = bench_of("bal_analog")
    bench.driver.open()
    bench.driver.enable()
    bench.fault("command_offset", "el", value=0.5)
    end_s = time.monotonic() + 5
    while reading_of(bench.driver).position_rad[1] < 0.1:
        assert time.monotonic() < end_s
    assert bench.motors.velocity_rad_s == pytest.approx((0.0, 3.0))


def test_asked_only_it_tells_what_disagrees_and_stays_as_it_is(bench_of):
    bench = bench_of("bal_analog")
    assert probe_bal_analog(bench.siderostat).disagreements == ()
    bench.fault("amplifier_fault", "el")
    probe = probe_bal_analog(bench.siderostat)
    assert probe.identity.model == "mock analogue amplifiers"
    assert 0 < probe.round_trip_s < 1
    assert probe.disagreements == (
        "elevation's fault line is up: look at the amplifier's lamps and remove the cause",
    )
    assert bench.motors.enabled == [False, False]
