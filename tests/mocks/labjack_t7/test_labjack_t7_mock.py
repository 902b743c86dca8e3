"""Read these as transcripts: what a Modbus/TCP client sends a T7, and what the mock answers, byte by byte.

Values are LabJack's: FLOAT32 big-endian in two registers, so 10 V is 41 20 00 00 and -9999 is c6 1c 3c 00.
"""

import asyncio
import contextlib
import struct
import time

import pytest
from hypothesis import given
from hypothesis import strategies as st
from instruments.labjack_bench import DEVICE, SETTINGS, Bench
from instruments.mock_bench import in_a_loop

from fitctl.config import Fault
from fitctl.mocks.labjack_t7.server import LabJackT7Mock
from fitctl.mocks.modbus.pdu import answer

READ_DIODES = "03 00 00 00 08"
ALL_RANGE, ALL_NEGATIVE, ALL_RESOLUTION, ALL_SETTLING = "ab 7c", "ab 7e", "ab 7f", "ab 80"
LAST_ERR_DETAIL = "03 d6 d8 00 01"
TEN_V, ONE_V = "41 20 00 00", "3f 80 00 00"


class Client:
    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer
        self.number = 0

    async def says(self, request, unit=1):
        """The answer's PDU to a request's."""
        self.number += 1
        pdu = bytes.fromhex(request)
        self.writer.write(struct.pack(">HHHB", self.number, 0, 1 + len(pdu), unit) + pdu)
        got = struct.unpack(">HHHB", await asyncio.wait_for(self.reader.readexactly(7), 5))
        assert (got[0], got[1], got[3]) == (self.number, 0, unit)
        return (await self.reader.readexactly(got[2] - 1)).hex(" ")

    async def volts(self, request=READ_DIODES):
        data = bytes.fromhex(await self.says(request))[2:]
        return list(struct.unpack(f">{len(data) // 4}f", data))

    async def is_cut_off(self):
        try:
            return await asyncio.wait_for(self.reader.read(), 5) == b""
        except ConnectionError:
            return True


async def connected(port):
    return Client(*await asyncio.open_connection("127.0.0.1", port))


@contextlib.asynccontextmanager
async def served(**settings):
    """The bench, and a client of its mock."""
    bench = Bench(**settings)
    try:
        bench.port = await bench.mock.start()
        client = await connected(bench.port)
        yield bench, client
        client.writer.close()
    finally:
        await bench.mock.stop()
    assert asyncio.all_tasks() == {asyncio.current_task()}


# ---------------------------------------------------------------- who it is


@pytest.mark.parametrize(
    ("request_", "expected"),
    [
        ("03 ea 60 00 02", "03 04 40 e0 00 00"),  # PRODUCT_ID: 7.0
        ("04 ea 60 00 02", "04 04 40 e0 00 00"),
        ("03 ea 64 00 02", "03 04 3f 83 fe 5d"),  # FIRMWARE_VERSION: 1.0312
        ("03 ea 7c 00 02", "03 04 1c 03 ce 59"),  # SERIAL_NUMBER: 470011481
        ("03 ea 6a 00 02", "03 04 00 00 00 00"),  # HARDWARE_INSTALLED: no option
        (LAST_ERR_DETAIL, "03 02 00 00"),
    ],
)
@in_a_loop
async def test_it_says_what_it_is(request_, expected):
    async with served(serial_number=0x1C03CE59) as (_, client):
        assert await client.says(request_) == expected


@in_a_loop
async def test_a_pro_says_that_it_has_the_high_resolution_converter():
    async with served(pro=True) as (_, client):
        assert await client.says("03 ea 6a 00 02") == "03 04 00 00 00 01"


# ---------------------------------------------------------------- inputs


@pytest.mark.parametrize("function", ["03", "04"])
@in_a_loop
async def test_one_request_reads_all_four_inputs(function):
    async with served() as (bench, client):
        bench.volts[:] = [5.0, 0.0, -2.5, 10.0]
        volts = await client.volts(f"{function} 00 00 00 08")
        assert volts == pytest.approx([5.0, 0.0, -2.5, 10.0], abs=1e-3)
        assert len(bench.sampled_s) == 1


@in_a_loop
async def test_inputs_can_be_read_one_by_one_and_nothing_is_connected_from_ain4_on():
    async with served() as (_, client):
        assert await client.volts("03 00 04 00 02") == pytest.approx([3.0], abs=1e-3)
        assert await client.volts("03 00 00 00 1c") == pytest.approx(
            [5.0, 4.0, 3.0, 2.0] + [0.0] * 10, abs=1e-3
        )


@in_a_loop
async def test_photodiodes_are_on_the_inputs_that_the_rig_file_says():
    device = DEVICE.model_copy(update={"inputs": [1, 2, 3, 0]})
    async with served(device=device) as (_, client):
        assert await client.volts() == pytest.approx([2.0, 5.0, 4.0, 3.0], abs=1e-3)


@in_a_loop
async def test_a_voltage_beyond_the_range_reads_its_end():
    async with served() as (bench, client):
        bench.volts[:] = [30.0, -30.0, 10.05, -10.4]
        assert await client.volts() == pytest.approx([10.1, -10.5, 10.05, -10.4], abs=1e-3)
        await client.says(f"10 {ALL_RANGE} 00 02 04 {ONE_V}")
        bench.volts[:] = [5.0, -5.0, 0.5, -0.5]
        assert await client.volts() == pytest.approx([1.01, -1.05, 0.5, -0.5], abs=1e-3)


@pytest.mark.parametrize(
    ("index", "noise_v"), [(1, 316e-6), (4, 112e-6), (8, 36.8e-6), (0, 36.8e-6)]
)
@in_a_loop
async def test_the_noise_is_that_of_the_resolution_index(index, noise_v):
    async with served() as (bench, client):
        await client.says(f"06 {ALL_RESOLUTION} 00 {index:02x}")
        readings = [volts for _ in range(100) for volts in await client.volts()]
        wrongs = [value - true for value, true in zip(readings, bench.volts * 100, strict=True)]
    rms_v = (sum(wrong**2 for wrong in wrongs) / len(wrongs)) ** 0.5
    assert rms_v == pytest.approx(noise_v, rel=0.15)  # of 400 samples: 3.5 %


@in_a_loop
async def test_a_request_takes_its_conversions_time_and_is_sampled_amid_it():
    async with served(overhead_s=0.05) as (bench, client):
        await client.says(f"10 {ALL_SETTLING} 00 02 04 {struct.pack('>f', 10_000.0).hex()}")
        began_s = time.monotonic()
        await client.volts()
        took_s = time.monotonic() - began_s
        assert took_s > 0.05 + 4 * 0.01  # overhead, and four times settling
        assert began_s + 0.02 < bench.sampled_s[-1] < began_s + took_s - 0.02


@in_a_loop
async def test_an_even_input_can_be_measured_against_the_next():
    async with served() as (_, client):
        assert await client.says("06 a0 28 00 01") == "06 a0 28 00 01"  # AIN0_NEGATIVE_CH: AIN1
        assert await client.volts() == pytest.approx([1.0, 4.0, 3.0, 2.0], abs=1e-3)
        assert await client.says(f"03 {ALL_NEGATIVE} 00 01") == "03 02 ff ff"
        await client.says(f"06 {ALL_NEGATIVE} 00 01")
        assert await client.says(f"03 {ALL_NEGATIVE} 00 01") == "03 02 00 01"
        assert (await client.volts())[::2] == pytest.approx([1.0, 1.0], abs=1e-3)


# ---------------------------------------------------------------- settings


@pytest.mark.parametrize(
    ("of_all", "of_ain0", "value"),
    [
        (ALL_RANGE, 40000, TEN_V),
        (ALL_RANGE, 40000, "3d cc cc cd"),  # 0.1
        (ALL_RANGE, 40000, "3c 23 d7 0a"),  # 0.01
        (ALL_RANGE, 40000, "00 00 00 00"),  # the device's default, 10 V
        (ALL_RESOLUTION, 41500, "00 08"),
        (ALL_NEGATIVE, 41000, "00 c7"),
        (ALL_SETTLING, 42000, "47 43 50 00"),  # 50 000
    ],
)
@in_a_loop
async def test_what_is_written_is_read_back_of_all_and_of_each(of_all, of_ain0, value):
    count = len(value.split()) // 2
    async with served() as (_, client):
        written = await client.says(f"10 {of_all} 00 0{count} 0{2 * count} {value}")
        assert written == f"10 {of_all} 00 0{count}"
        assert await client.says(f"03 {of_all} 00 0{count}") == f"03 0{2 * count} {value}"
        of_ain13 = (of_ain0 + 13 * count).to_bytes(2, "big").hex(" ")
        assert await client.says(f"03 {of_ain13} 00 0{count}") == f"03 0{2 * count} {value}"


@in_a_loop
async def test_inputs_that_differ_have_no_common_setting():
    async with served() as (_, client):
        await client.says(f"10 9c 42 00 02 04 {ONE_V}")  # AIN1_RANGE
        assert await client.says(f"03 {ALL_RANGE} 00 02") == "03 04 c6 1c 3c 00"
        await client.says("06 a2 1c 00 03")  # AIN0_RESOLUTION_INDEX
        assert await client.says(f"03 {ALL_RESOLUTION} 00 01") == "03 02 ff ff"


@in_a_loop
async def test_one_write_sets_range_negative_channel_resolution_and_settling():
    async with served() as (_, client):
        everything = f"{ONE_V} 00 c7 00 03 42 c8 00 00"
        assert await client.says(f"10 {ALL_RANGE} 00 06 0c {everything}") == "10 ab 7c 00 06"
        assert await client.says(f"03 {ALL_RANGE} 00 06") == f"03 0c {everything}"


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(
    ("request_", "refusal", "detail"),
    [
        ("03 00 1c 00 02", "83 02", 0),
        ("03 00 1b 00 02", "83 02", 0),
        ("10 00 00 00 02 04 3f 80 00 00", "90 02", 0),
        ("10 ea 60 00 02 04 3f 80 00 00", "90 02", 0),
        ("03 00 00 00 00", "83 03", 0),
        ("03 00 00 00 01", "83 03", 2315),
        ("03 00 01 00 02", "83 03", 2315),
        (f"06 {ALL_RANGE} 41 20", "86 03", 2315),
        (f"10 {ALL_RANGE} 00 02 04 40 a0 00 00", "90 03", 2370),
        (f"10 {ALL_RANGE} 00 02 04 7f c0 00 00", "90 03", 2370),
        (f"10 {ALL_SETTLING} 00 02 04 47 43 50 01", "90 03", 2371),
        (f"10 {ALL_SETTLING} 00 02 04 bf 80 00 00", "90 03", 2371),
        (f"10 {ALL_SETTLING} 00 02 04 7f c0 00 00", "90 03", 2371),
        (f"06 {ALL_NEGATIVE} 00 02", "86 03", 2373),
        ("06 a0 29 00 02", "86 03", 2373),
        (f"06 {ALL_RESOLUTION} 00 09", "86 03", 2375),
        ("01 00 00 00 01", "81 01", 0),
        ("17 00 00 00 02 ab 7f 00 01 02 00 01", "97 01", 0),
        ("2b 0e 01 00", "ab 01", 0),
        ("4c 00 00 00 00", "cc 01", 0),
    ],
    ids=[
        "an input that it does not have",
        "across the end of what it has",
        "an input cannot be written",
        "nor can its product id",
        "no registers",
        "half an input",
        "halves of two inputs",
        "half a range",
        "a range of 5 V",
        "a range that is no number",
        "settling longer than it can",
        "settling for a negative time",
        "settling for no number",
        "all against AIN2",
        "an odd input against the next",
        "a resolution of the Pro",
        "coils",
        "function 23",
        "identification",
        "feedback, a function of LabJack's own",
    ],
)
@in_a_loop
async def test_what_cannot_be_is_refused_changes_nothing_and_leaves_labjacks_error(
    request_, refusal, detail
):
    async with served() as (_, client):
        before = await client.says(f"03 {ALL_RANGE} 00 06")
        assert await client.says(request_) == refusal
        assert await client.says(LAST_ERR_DETAIL) == f"03 02 {detail.to_bytes(2, 'big').hex(' ')}"
        assert await client.says(f"03 {ALL_RANGE} 00 06") == before


@in_a_loop
async def test_a_write_with_one_wrong_value_changes_nothing():
    async with served() as (_, client):
        before = await client.says(f"03 {ALL_RANGE} 00 06")
        everything = f"{ONE_V} 00 c7 00 0d 00 00 00 00"
        assert await client.says(f"10 {ALL_RANGE} 00 06 0c {everything}") == "90 03"
        assert await client.says(f"03 {ALL_RANGE} 00 06") == before


@in_a_loop
async def test_a_pro_has_resolutions_up_to_12():
    async with served(pro=True) as (_, client):
        assert await client.says(f"06 {ALL_RESOLUTION} 00 0c") == f"06 {ALL_RESOLUTION} 00 0c"
        assert await client.says(f"06 {ALL_RESOLUTION} 00 0d") == "86 03"


@pytest.mark.parametrize("unit", [0, 1, 7, 255])
@in_a_loop
async def test_every_unit_is_the_device(unit):
    async with served() as (_, client):
        assert await client.says("03 ea 60 00 02", unit) == "03 04 40 e0 00 00"


@in_a_loop
async def test_two_clients_are_served_and_a_third_is_cut_off():
    async with served() as (bench, client):
        second, third = await connected(bench.port), await connected(bench.port)
        assert await third.is_cut_off()
        assert len(await client.volts()) == len(await second.volts()) == 4
        second.writer.close()


ADDRESSES = [0, 1, 26, 40000, 40001, 40026, 41000, 41013, 41500, 43900, 43902, 43903, 43904, 60000]
WORDS = [0, 1, 2, 8, 9, 199, 0x3F80, 0x4120, 0x7FC0, 0x4743, 0x5000, 0xFFFF]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(ADDRESSES), st.lists(st.sampled_from(WORDS), min_size=1, max_size=6)
        ),
        max_size=8,
    )
)
def test_whatever_is_written_the_settings_stay_what_a_t7_can_have(writes):
    mock = Bench().mock
    model = mock._server._model
    for address, words in writes:
        body = struct.pack(f">HHB{len(words)}H", address, len(words), 2 * len(words), *words)
        assert answer(b"\x10" + body, model)[0] in {0x10, 0x90}
        assert answer(struct.pack(">BHH", 3, address, len(words)), model)[0] in {0x03, 0x83}
    ranges, negatives, resolutions, settlings = mock._values.values()
    assert {round(value, 6) for value in ranges} <= {0.0, 10.0, 1.0, 0.1, 0.01}
    assert set(negatives) <= {199, *range(1, 14, 2)}
    assert all(0 <= value <= 8 for value in resolutions)
    assert all(0 <= value <= 50_000 for value in settlings)


# ---------------------------------------------------------------- its faults


@in_a_loop
async def test_an_input_can_read_no_number_or_a_wrong_one():
    async with served() as (bench, client):
        bench.begin("not_a_number", part="AIN1")
        assert await client.says("03 00 02 00 02") == "03 04 7f c0 00 00"
        bench.begin("wrong_value", part="AIN3")
        assert (await client.volts())[3] == -9999.0
        bench.mock.faults.clear()
        assert await client.volts() == pytest.approx([5.0, 4.0, 3.0, 2.0], abs=1e-3)


@in_a_loop
async def test_a_stuck_input_keeps_its_reading_and_the_others_go_on():
    async with served() as (bench, client):
        bench.begin("stuck_input", part="AIN0")
        held = (await client.volts())[0]
        bench.volts[:] = [1.0, 1.0, 1.0, 1.0]
        volts = await client.volts()
        assert volts[0] == held
        assert volts[1:] == pytest.approx([1.0, 1.0, 1.0], abs=1e-3)
        bench.mock.faults.clear()
        assert (await client.volts())[0] == pytest.approx(1.0, abs=1e-3)


@in_a_loop
async def test_an_offset_grows_from_when_it_began():
    async with served() as (bench, client):
        began_s = time.monotonic()
        bench.begin("offset_drift", part="AIN2", value=10.0)
        await asyncio.sleep(0.05)
        volts = await client.volts()
        assert 3.5 - 0.01 < volts[2] < 3.0 + 10.0 * (time.monotonic() - began_s) + 0.01
        assert volts[3] == pytest.approx(2.0, abs=1e-3)
        bench.mock.faults.clear()
        assert (await client.volts())[2] == pytest.approx(3.0, abs=1e-3)


@in_a_loop
async def test_exchanged_photodiodes_and_one_that_is_unplugged():
    async with served() as (bench, client):
        bench.begin("swapped", part="el")
        assert await client.volts() == pytest.approx([5.0, 4.0, 2.0, 3.0], abs=1e-3)
        bench.begin("swapped")
        assert await client.volts() == pytest.approx([4.0, 5.0, 2.0, 3.0], abs=1e-3)
        bench.mock.faults.clear()
        bench.begin("unplugged", part="AIN1")
        assert await client.volts() == pytest.approx([5.0, 0.0, 3.0, 2.0], abs=1e-3)


@in_a_loop
async def test_the_laser_is_dimmed_until_the_fault_ends():
    powers = []
    mock = LabJackT7Mock(DEVICE, SETTINGS, lambda _time_s: [0.0] * 4, set_laser=powers.append)
    mock.faults.set(Fault(device="metrology.labjack", kind="laser_dim"))
    mock.faults.set(Fault(device="metrology.labjack", kind="laser_dim", value=0.3))
    mock.faults.clear()
    assert powers == [0.0, 0.3, 1.0]
    await mock.stop()


@in_a_loop
async def test_noise_on_an_input():
    async with served() as (bench, client):
        bench.begin("noise", part="AIN0", value=0.5)
        wrongs = [(await client.volts())[0] - 5.0 for _ in range(100)]
        assert 0.3 < (sum(wrong**2 for wrong in wrongs) / 100) ** 0.5 < 0.7


@in_a_loop
async def test_another_client_changes_the_range_until_somebody_sets_it_again():
    async with served() as (bench, client):
        await client.says(f"10 {ALL_RANGE} 00 02 04 {TEN_V}")
        bench.begin("range_changed", for_s=0.01)
        await asyncio.sleep(0.05)
        assert await client.volts() == pytest.approx([1.01] * 4, abs=1e-3)
        assert await client.says(f"03 {ALL_RANGE} 00 02") == f"03 04 {ONE_V}"
        await client.says(f"10 {ALL_RANGE} 00 02 04 {TEN_V}")
        assert await client.volts() == pytest.approx([5.0, 4.0, 3.0, 2.0], abs=1e-3)


@in_a_loop
async def test_an_exception_on_demand():
    async with served() as (bench, client):
        bench.begin("exception", value=6.0)
        assert await client.says(READ_DIODES) == "83 06"
        assert await client.says(f"06 {ALL_RESOLUTION} 00 01") == "86 06"
        bench.mock.faults.clear()
        assert len(await client.volts()) == 4


@in_a_loop
async def test_after_a_reboot_its_settings_are_those_of_power_up():
    async with served() as (bench, client):
        await client.says(f"10 {ALL_RANGE} 00 06 0c {ONE_V} 00 c7 00 03 42 c8 00 00")
        bench.begin("reboot", value=0.02)
        assert await client.is_cut_off()
        await asyncio.sleep(0.1)
        again = await connected(bench.port)
        power_up = "00 00 00 00 00 c7 00 00 00 00 00 00"
        assert await again.says(f"03 {ALL_RANGE} 00 06") == f"03 0c {power_up}"
        again.writer.close()


@in_a_loop
async def test_a_taken_port_is_said_and_stop_is_safe_twice():
    async with served() as (bench, _):
        taken = SETTINGS.model_copy(update={"modbus_port": bench.port})
        second = LabJackT7Mock(DEVICE, taken, lambda _time_s: [0.0] * 4)
        with pytest.raises(OSError, match="address already in use"):
            await second.start()
        await second.stop()
        await bench.mock.stop()
