"""Read these as transcripts of a serial line: what a master sends, and what the station answers."""

import asyncio
import os
import termios
from contextlib import asynccontextmanager

import pytest
from instruments.mock_bench import in_a_loop

from fitctl.config import Fault
from fitctl.mocks.faults import WIRE_FAULTS, Faults
from fitctl.mocks.modbus import rtu
from fitctl.mocks.modbus.pdu import DataModel

READ = bytes.fromhex("01 03 00 00 00 01 84 0a")
WRITE = bytes.fromhex("01 06 00 00 12 34 84 bd")


class Line:
    """The clients' end of a station's pty, and the station's one register."""

    def __init__(self, baud_rate):
        self.register = 7
        self.written = asyncio.Event()
        self.faults = Faults(WIRE_FAULTS)
        model = DataModel({0}, lambda *_: [self.register], self._write, ())
        self.server = rtu.ModbusRtuServer(model, self.faults, unit=1, baud_rate=baud_rate)
        self._came = asyncio.Queue()

    async def start(self):
        path = await self.server.start()
        self.end = os.open(path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        loop = asyncio.get_running_loop()
        loop.add_reader(self.end, lambda: self._came.put_nowait(os.read(self.end, 300)))

    async def stop(self):
        asyncio.get_running_loop().remove_reader(self.end)
        os.close(self.end)
        await self.server.stop()

    def send(self, frame):
        os.write(self.end, frame)

    async def hears(self):
        return (await asyncio.wait_for(self._came.get(), 5)).hex(" ")

    async def hears_nothing(self):
        """Nothing within many times what an answer takes."""
        await asyncio.sleep(0.1)
        return self._came.empty()

    def _write(self, address, values):
        self.register = values[0]
        self.written.set()


@asynccontextmanager
async def line(baud_rate=115200):
    line = Line(baud_rate)
    await line.start()
    try:
        yield line
    finally:
        await line.stop()
        await line.server.stop()
    assert asyncio.all_tasks() == {asyncio.current_task()}


@in_a_loop
async def test_a_request_is_answered():
    async with line() as master:
        master.send(READ)
        assert await master.hears() == "01 03 02 00 07 f9 86"
        master.send(WRITE)
        assert await master.hears() == WRITE.hex(" ")
        assert master.register == 0x1234


@in_a_loop
async def test_an_exception_is_framed_too():
    async with line() as master:
        master.send(rtu.frame(1, bytes.fromhex("03 00 05 00 01")))
        assert await master.hears() == rtu.frame(1, bytes.fromhex("83 02")).hex(" ")


@in_a_loop
async def test_an_answer_that_comes_twice_goes_out_in_one_piece(monkeypatch):
    pieces = []

    def write(end, data):
        pieces.append(data.hex(" "))
        return os_write(end, data)

    os_write = os.write
    async with line() as master:
        master.faults.set(Fault(device="right.dac", kind="duplicate"))
        monkeypatch.setattr(os, "write", write)
        master.send(READ)
        answer = "01 03 02 00 07 f9 86"
        assert await master.hears() == f"{answer} {answer}"
    assert pieces == [READ.hex(" "), f"{answer} {answer}"]


@pytest.mark.parametrize(
    "frame",
    [
        rtu.frame(2, READ[1:-2]),
        READ[:-1] + b"\0",
        READ[:-1],
        READ + b"\x55",
        bytes(400),
        rtu.frame(0, READ[1:-2]),
    ],
    ids=["another unit", "wrong check", "cut off", "a byte too many", "a flood", "to all: a read"],
)
@in_a_loop
async def test_what_is_not_for_it_or_not_whole_gets_no_answer_and_does_no_harm(frame):
    async with line() as master:
        master.send(frame)
        assert await master.hears_nothing()
        master.send(READ)
        assert await master.hears() == "01 03 02 00 07 f9 86"


@in_a_loop
async def test_a_write_to_all_is_obeyed_and_not_answered():
    async with line() as master:
        master.send(rtu.frame(0, WRITE[1:-2]))
        await asyncio.wait_for(master.written.wait(), 5)
        assert await master.hears_nothing()
        assert master.register == 0x1234


@in_a_loop
async def test_a_client_at_another_baud_rate_is_not_understood():
    async with line() as master:
        mode = termios.tcgetattr(master.end)
        mode[4] = mode[5] = termios.B9600
        termios.tcsetattr(master.end, termios.TCSANOW, mode)
        master.send(WRITE)
        assert await master.hears_nothing()
        assert master.register == 7


@in_a_loop
async def test_who_talks_before_the_answer_destroys_it():
    async with line(baud_rate=1200) as master:  # 73 ms for eight bytes
        master.send(WRITE)
        await asyncio.wait_for(master.written.wait(), 5)
        master.send(b"me too")
        assert await master.hears_nothing()


@pytest.mark.parametrize("kind", ["disconnect", "freeze"])
@in_a_loop
async def test_an_unplugged_or_frozen_station_hears_nothing(kind):
    async with line() as master:
        master.faults.set(Fault(device="any", kind=kind))
        master.send(WRITE)
        assert await master.hears_nothing()
        assert master.register == 7
        master.faults.clear()
        master.send(READ)
        assert await master.hears() == "01 03 02 00 07 f9 86"
