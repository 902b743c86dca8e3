"""Read these as transcripts: what a Modbus/TCP master sends, and what the mock answers, byte by byte."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from fitctl.config import DacMock, default_rig_path, load_rig
from fitctl.mocks.modbus_dac.server import ModbusDacMock

DAC = load_rig(default_rig_path()).loops["right"].fsm.dac
HALF = "80 00"


class Master:
    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def says(self, request):
        self.writer.write(bytes.fromhex(request))
        header = await asyncio.wait_for(self.reader.readexactly(6), 5)
        rest = await asyncio.wait_for(self.reader.readexactly(header[5]), 5)
        return (header + rest).hex(" ")


class Outputs(list):
    """What the plant is told, and a way to wait for the next."""

    def __init__(self):
        self.news = asyncio.Event()

    def take(self, volts):
        self.append([round(value, 3) for value in volts])
        self.news.set()


@asynccontextmanager
async def station(watchdog_s=30.0, safe_v=5.0, **changes):
    outputs = Outputs()
    mock = ModbusDacMock(
        DAC.model_copy(update=changes),
        DacMock(watchdog_s=watchdog_s, safe_v=safe_v),
        outputs.take,
        port=0,
    )
    try:
        port = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        yield mock, Master(reader, writer), outputs
        writer.close()
    finally:
        await mock.stop()


def test_it_powers_up_at_mid_stroke_and_says_so():
    async def scene():
        async with station() as (_, master, outputs):
            assert outputs == [[5.0, 5.0, 5.0]]
            answer = await master.says("00 01 00 00 00 06 01 03 00 00 00 03")
            assert answer == f"00 01 00 00 00 09 01 03 06 {HALF} {HALF} {HALF}"

    asyncio.run(scene())


def test_one_write_of_three_registers_sets_three_outputs_at_once():
    async def scene():
        async with station() as (mock, master, outputs):
            answer = await master.says("00 07 00 00 00 0d 01 10 00 00 00 03 06 00 00 80 00 ff ff")
            assert answer == "00 07 00 00 00 06 01 10 00 00 00 03"
            assert outputs[1:] == [[0.0, 5.0, 10.0]]
            assert mock.outputs_v == pytest.approx([0.0, 5.0, 10.0], abs=1e-4)
            answer = await master.says("00 08 00 00 00 06 01 03 00 00 00 03")
            assert answer == "00 08 00 00 00 09 01 03 06 00 00 80 00 ff ff"

    asyncio.run(scene())


def test_one_register_can_be_written_and_the_same_again_is_no_change():
    async def scene():
        async with station() as (_, master, outputs):
            for _ in range(2):
                answer = await master.says("00 01 00 00 00 06 01 06 00 02 ff ff")
                assert answer == "00 01 00 00 00 06 01 06 00 02 ff ff"
            assert outputs[1:] == [[5.0, 5.0, 10.0]]

    asyncio.run(scene())


@pytest.mark.parametrize(
    ("request_", "answer"),
    [
        ("00 01 00 00 00 06 01 03 00 03 00 01", "00 01 00 00 00 03 01 83 02"),
        ("00 01 00 00 00 06 01 03 00 01 00 03", "00 01 00 00 00 03 01 83 02"),
        ("00 01 00 00 00 0d 01 10 00 01 00 03 06 00 00 00 00 00 00", "00 01 00 00 00 03 01 90 02"),
        ("00 01 00 00 00 06 01 06 00 00 10 00", "00 01 00 00 00 03 01 86 03"),
        ("00 01 00 00 00 06 01 04 00 00 00 03", "00 01 00 00 00 03 01 84 01"),
        ("00 01 00 00 00 06 09 03 00 00 00 03", "00 01 00 00 00 03 09 83 0b"),
    ],
    ids=[
        "read beyond: illegal address",
        "read across the end: illegal address",
        "write across the end: illegal address",
        "13 bits into 12: illegal value",
        "input registers: illegal function",
        "somebody else's id: no such target",
    ],
)
def test_what_cannot_be_is_refused_and_changes_nothing(request_, answer):
    async def scene():
        async with station(bits=12) as (_, master, outputs):
            assert await master.says(request_) == answer
            assert len(outputs) == 1

    asyncio.run(scene())


def test_without_writes_the_watchdog_makes_the_outputs_safe_once():
    async def scene():
        async with station(watchdog_s=0.05, safe_v=4.0) as (mock, master, outputs):
            await asyncio.sleep(0.15)
            assert mock.watchdog_trips == 0  # nobody has written yet
            await master.says("00 01 00 00 00 06 01 06 00 00 ff ff")
            outputs.news.clear()
            await asyncio.wait_for(outputs.news.wait(), 5)
            assert mock.watchdog_trips == 1
            assert outputs[-1] == [4.0, 4.0, 4.0]
            answer = await master.says("00 08 00 00 00 06 01 03 00 00 00 03")
            assert answer.endswith("06 66 66 66 66 66 66")
            await asyncio.sleep(0.15)
            assert mock.watchdog_trips == 1

    asyncio.run(scene())


def test_writes_keep_the_watchdog_quiet():
    async def scene():
        async with station(watchdog_s=0.5) as (mock, master, _):
            for _ in range(12):
                await master.says("00 01 00 00 00 06 01 06 00 00 ff ff")
                await asyncio.sleep(0.05)
            assert mock.watchdog_trips == 0

    asyncio.run(scene())


def test_it_can_be_told_to_refuse_and_to_drop_its_links():
    async def scene():
        async with station() as (mock, master, outputs):
            mock.refuse_with = 6
            answer = await master.says("00 01 00 00 00 06 01 06 00 00 ff ff")
            assert answer == "00 01 00 00 00 03 01 86 06"
            assert len(outputs) == 1
            mock.drop_links()
            assert await asyncio.wait_for(master.reader.read(), 5) == b""

    asyncio.run(scene())


def test_noise_does_not_stop_it_from_serving_others():
    async def scene():
        async with station() as (_, master, _):
            port = master.writer.get_extra_info("peername")[1]
            _, noisy = await asyncio.open_connection("127.0.0.1", port)
            noisy.write(bytes(range(256)) * 20)
            await noisy.drain()
            answer = await master.says("00 01 00 00 00 06 01 03 00 00 00 01")
            assert answer == f"00 01 00 00 00 05 01 03 02 {HALF}"
            noisy.close()

    asyncio.run(scene())


def test_a_taken_port_is_said_and_stop_is_safe_twice():
    async def scene():
        async with station() as (mock, master, _):
            port = master.writer.get_extra_info("peername")[1]
            second = ModbusDacMock(
                DAC, DacMock(watchdog_s=1.0, safe_v=5.0), lambda volts: None, port=port
            )
            with pytest.raises(OSError, match="another testbed"):
                await second.start()
            await second.stop()
            await mock.stop()
            await mock.stop()
            assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(scene())
