"""Read these as transcripts: what a Modbus/TCP master sends, and what the mock answers, byte by byte."""

import asyncio
import contextlib
import socket

import pytest
from instruments.mock_bench import in_a_loop

from fitctl.config import DacMock, Fault, default_rig_path, load_rig
from fitctl.mocks.modbus_dac.server import ModbusDacMock

RIG = load_rig(default_rig_path())
DAC = RIG.loops["right"].fsm.dac
SETTINGS = RIG.mocks.loops["right"].dac
HALF = "80 00"
READ_ALL = "00 01 00 00 00 06 01 03 00 00 00 03"
IDENTIFY = "00 01 00 00 00 05 01 2b 0e 01 00"
WRITE_FIRST = "00 01 00 00 00 06 01 06 00 00 ff ff"


class Master:
    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def says(self, *requests):
        """Send requests in one segment; gives as many answers."""
        self.writer.write(b"".join(map(bytes.fromhex, requests)))
        answers = [await asyncio.wait_for(self._answer(), 5) for _ in requests]
        return answers[0] if len(answers) == 1 else answers

    async def _answer(self):
        header = await self.reader.readexactly(6)
        return (header + await self.reader.readexactly(header[5])).hex(" ")

    async def is_cut_off(self):
        try:
            return await asyncio.wait_for(self.reader.read(), 5) == b""
        except ConnectionError:
            return True


class Outputs(list):
    """What the plant is told, and a way to wait for the next."""

    def __init__(self):
        self.news = asyncio.Event()

    def take(self, volts):
        self.append([round(value, 3) for value in volts])
        self.news.set()

    async def next(self):
        self.news.clear()
        await asyncio.wait_for(self.news.wait(), 5)
        return self[-1]


async def connected(port):
    return Master(*await asyncio.open_connection("127.0.0.1", port))


@contextlib.asynccontextmanager
async def station(settings=None, **changes):
    outputs = Outputs()
    mock = ModbusDacMock(
        DAC.model_copy(update=changes),
        SETTINGS.model_copy(update={"watchdog_s": 30.0} | (settings or {})),
        outputs.take,
        port=0,
    )
    try:
        ends = await mock.start()
        master = await connected(ends.tcp_port)
        yield mock, master, outputs
        master.writer.close()
    finally:
        await mock.stop()
    assert asyncio.all_tasks() == {asyncio.current_task()}


def fault(kind, **settings):
    return Fault(device="right.dac", kind=kind, **settings)


# ---------------------------------------------------------------- what it does


@in_a_loop
async def test_it_powers_up_at_mid_stroke_and_says_so():
    async with station() as (_, master, outputs):
        assert outputs == [[5.0, 5.0, 5.0]]
        assert await master.says(READ_ALL) == f"00 01 00 00 00 09 01 03 06 {HALF} {HALF} {HALF}"


@in_a_loop
async def test_one_write_of_three_registers_sets_three_outputs_at_once():
    async with station() as (mock, master, outputs):
        answer = await master.says("00 07 00 00 00 0d 01 10 00 00 00 03 06 00 00 80 00 ff ff")
        assert answer == "00 07 00 00 00 06 01 10 00 00 00 03"
        assert outputs[1:] == [[0.0, 5.0, 10.0]]
        assert mock.outputs_v == pytest.approx([0.0, 5.0, 10.0], abs=1e-4)
        answer = await master.says(READ_ALL)
        assert answer == "00 01 00 00 00 09 01 03 06 00 00 80 00 ff ff"


@in_a_loop
async def test_one_register_can_be_written_and_the_same_again_is_no_change():
    async with station() as (_, master, outputs):
        for _ in range(2):
            answer = await master.says("00 01 00 00 00 06 01 06 00 02 ff ff")
            assert answer == "00 01 00 00 00 06 01 06 00 02 ff ff"
        assert outputs[1:] == [[5.0, 5.0, 10.0]]


@in_a_loop
async def test_one_transaction_writes_two_and_reads_three():
    async with station() as (_, master, outputs):
        answer = await master.says("00 01 00 00 00 0f 01 17 00 00 00 03 00 01 00 02 04 00 00 ff ff")
        assert answer == f"00 01 00 00 00 09 01 17 06 {HALF} 00 00 ff ff"
        assert outputs[1:] == [[5.0, 0.0, 10.0]]


@in_a_loop
async def test_requests_that_come_together_are_all_answered_in_order():
    async with station() as (_, master, _):
        assert await master.says(WRITE_FIRST, READ_ALL.replace("00 01", "00 02", 1)) == [
            WRITE_FIRST,
            f"00 02 00 00 00 09 01 03 06 ff ff {HALF} {HALF}",
        ]


@in_a_loop
async def test_a_request_may_come_in_pieces():
    async with station() as (_, master, _):
        master.writer.write(bytes.fromhex(READ_ALL)[:9])
        await master.writer.drain()
        assert (await master.says(READ_ALL[27:])).startswith("00 01 00 00 00 09 01 03 06")


# ---------------------------------------------------------------- what it refuses


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("00 01 00 00 00 06 01 03 00 03 00 01", "00 01 00 00 00 03 01 83 02"),
        ("00 01 00 00 00 06 01 03 00 01 00 03", "00 01 00 00 00 03 01 83 02"),
        ("00 01 00 00 00 0d 01 10 00 01 00 03 06 00 00 00 00 00 00", "00 01 00 00 00 03 01 90 02"),
        ("00 01 00 00 00 06 01 03 00 00 00 00", "00 01 00 00 00 03 01 83 03"),
        ("00 01 00 00 00 06 01 06 00 00 10 00", "00 01 00 00 00 03 01 86 04"),
        ("00 01 00 00 00 06 01 04 00 00 00 03", "00 01 00 00 00 03 01 84 01"),
        ("00 01 00 00 00 06 01 04 ff ff 00 03", "00 01 00 00 00 03 01 84 01"),
        ("00 01 00 00 00 06 09 03 00 00 00 03", "00 01 00 00 00 03 09 83 0b"),
    ],
    ids=[
        "read beyond: illegal address",
        "read across the end: illegal address",
        "write across the end: illegal address",
        "no registers: illegal value",
        "13 bits into 12: the device cannot",
        "input registers: illegal function",
        "input registers at no address: still illegal function",
        "another unit: no such target",
    ],
)
@in_a_loop
async def test_what_cannot_be_is_refused_and_changes_nothing(request_, answer):
    async with station(bits=12) as (_, master, outputs):
        assert await master.says(request_) == answer
        assert len(outputs) == 1


@pytest.mark.parametrize("unit", ["00", "ff"])
@in_a_loop
async def test_who_reached_it_by_its_address_needs_no_unit(unit):
    async with station() as (_, master, _):
        answer = await master.says(f"00 01 00 00 00 06 {unit} 03 00 00 00 01")
        assert answer == f"00 01 00 00 00 05 {unit} 03 02 {HALF}"


@in_a_loop
async def test_some_stations_ignore_other_units():
    async with station({"unknown_unit": "ignore"}) as (_, master, _):
        master.writer.write(bytes.fromhex("00 01 00 00 00 06 09 03 00 00 00 03"))
        assert (await master.says("00 02 00 00 00 06 01 03 00 00 00 03")).startswith("00 02")


@in_a_loop
async def test_some_stations_answer_for_every_unit():
    async with station({"unknown_unit": "serve"}) as (_, master, _):
        answer = await master.says("00 01 00 00 00 06 09 03 00 00 00 01")
        assert answer == f"00 01 00 00 00 05 09 03 02 {HALF}"


@in_a_loop
async def test_who_is_out_of_step_is_cut_off_and_others_are_served():
    async with station() as (_, master, _):
        noisy = await connected(master.writer.get_extra_info("peername")[1])
        noisy.writer.write(bytes(range(256)) * 20)
        assert await noisy.is_cut_off()
        noisy.writer.close()
        assert (await master.says(READ_ALL)).startswith("00 01 00 00 00 09 01 03 06")


@pytest.mark.long
@in_a_loop
async def test_who_never_reads_is_not_read_from_either():
    async with station() as (mock, master, _):
        with socket.socket() as greedy:
            greedy.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            greedy.connect(master.writer.get_extra_info("peername"))
            greedy.setblocking(False)
            reading = [True]
            async with asyncio.timeout(10):
                while all(reading):
                    with contextlib.suppress(BlockingIOError):
                        greedy.send(bytes.fromhex(IDENTIFY) * 1000)
                    await asyncio.sleep(0)
                    reading = [link.transport.is_reading() for link in mock._tcp.links]
            assert (await master.says(READ_ALL)).startswith("00 01")


# ---------------------------------------------------------------- its watchdog


@in_a_loop
async def test_without_writes_the_watchdog_makes_the_outputs_safe_once():
    async with station({"watchdog_s": 0.05, "safe_v": 4.0}) as (mock, master, outputs):
        await asyncio.sleep(0.15)
        assert mock.watchdog_trips == 0  # nobody has written yet
        await master.says(WRITE_FIRST)
        assert await outputs.next() == [4.0, 4.0, 4.0]
        assert mock.watchdog_trips == 1
        assert (await master.says(READ_ALL)).endswith("06 66 66 66 66 66 66")
        await asyncio.sleep(0.15)
        assert mock.watchdog_trips == 1
        assert await master.says(WRITE_FIRST) == WRITE_FIRST


@in_a_loop
async def test_a_watchdog_that_latches_refuses_all_until_power_is_cycled():
    async with station({"watchdog_s": 0.05, "watchdog_latches": True}) as (mock, master, outputs):
        await master.says(WRITE_FIRST)
        assert await outputs.next() == [5.0, 5.0, 5.0]
        for request, function in ((WRITE_FIRST, "86"), (READ_ALL, "83")):
            assert await master.says(request) == f"00 01 00 00 00 03 01 {function} 04"
        port = master.writer.get_extra_info("peername")[1]
        mock.faults.set(fault("reboot", value=0.01))
        await outputs.next()
        assert await (await connected(port)).says(WRITE_FIRST) == WRITE_FIRST


@in_a_loop
async def test_writes_keep_the_watchdog_quiet():
    async with station({"watchdog_s": 0.5}) as (mock, master, _):
        for _ in range(12):
            await master.says(WRITE_FIRST)
            await asyncio.sleep(0.05)
        assert mock.watchdog_trips == 0


@in_a_loop
async def test_reading_does_not_keep_it_quiet():
    async with station({"watchdog_s": 0.1}) as (mock, master, _):
        await master.says(WRITE_FIRST)
        for _ in range(10):
            await master.says(READ_ALL)
            await asyncio.sleep(0.02)
        assert mock.watchdog_trips == 1


# ---------------------------------------------------------------- its faults


@in_a_loop
async def test_a_tripped_watchdog_on_demand_is_safe_at_once_and_refuses_until_it_ends():
    async with station({"safe_v": 4.0}) as (mock, master, outputs):
        await master.says(WRITE_FIRST)
        mock.faults.set(fault("watchdog_trip"))
        assert outputs[-1] == [4.0, 4.0, 4.0]
        assert await master.says(WRITE_FIRST) == "00 01 00 00 00 03 01 86 04"
        assert mock.watchdog_trips == 1
        mock.faults.clear()
        assert await master.says(WRITE_FIRST) == WRITE_FIRST
        assert outputs[-1] == [10.0, 4.0, 4.0]


@in_a_loop
async def test_without_power_the_outputs_are_at_zero_then_as_at_power_up():
    async with station({"safe_v": 4.0}) as (mock, master, outputs):
        await master.says(WRITE_FIRST)
        mock.faults.set(fault("reboot", value=0.02))
        assert mock.outputs_v == [0.0, 0.0, 0.0]
        assert await master.is_cut_off()
        while outputs[-1] != [4.0, 4.0, 4.0]:
            await outputs.next()
        assert outputs[-2:] == [[0.0, 0.0, 0.0], [4.0, 4.0, 4.0]]


@in_a_loop
async def test_disconnected_it_cuts_who_is_there_and_who_comes():
    async with station() as (mock, master, _):
        port = master.writer.get_extra_info("peername")[1]
        mock.faults.set(fault("disconnect"))
        assert await master.is_cut_off()
        assert await (await connected(port)).is_cut_off()
        mock.faults.clear()
        assert await (await connected(port)).says(WRITE_FIRST) == WRITE_FIRST


@in_a_loop
async def test_frozen_it_takes_nothing_and_its_watchdog_runs_out():
    async with station({"watchdog_s": 0.1, "safe_v": 4.0}) as (mock, master, outputs):
        await master.says(WRITE_FIRST)
        mock.faults.set(fault("freeze"))
        master.writer.write(bytes.fromhex("00 01 00 00 00 06 01 06 00 02 00 00"))
        assert await outputs.next() == [4.0, 4.0, 4.0]
        mock.faults.clear()
        assert (await master.says(READ_ALL)).endswith("06 66 66 66 66 66 66")


# ---------------------------------------------------------------- starting and stopping


@in_a_loop
async def test_a_taken_port_is_said_and_stop_is_safe_twice():
    async with station() as (mock, master, _):
        port = master.writer.get_extra_info("peername")[1]
        second = ModbusDacMock(DAC, SETTINGS, lambda volts: None, port=port)
        with pytest.raises(OSError, match="address already in use"):
            await second.start()
        await second.stop()
        await mock.stop()


def test_a_safe_value_that_it_cannot_give_is_refused():
    settings = DacMock(watchdog_s=1.0, watchdog_latches=False, safe_v=11.0, unknown_unit="refuse")
    with pytest.raises(ValueError, match="channel 1 gives 0 to 10 V"):
        ModbusDacMock(DAC, settings, lambda volts: None, port=0)
