"""A raw CANopen master beside the mock drive: frames in, frames out, over SLCAN on TCP."""

import asyncio
import math
import time

from instruments.mock_bench import ToldMotors

from fitctl import config
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State
from fitctl.mocks.cia402 import slcan
from fitctl.mocks.cia402.drive import Cia402DriveMock

COUNT_RAD = 2 * math.pi / 4000
RPM_RAD_S = 2 * math.pi / 60


class Bus:
    """One raw SLCAN client that speaks in (identifier, hexadecimal data)."""

    def __init__(self, reader, writer, port):
        self._reader, self._writer = reader, writer
        self._port = port
        self.passed_over = []

    @classmethod
    async def on(cls, port):
        bus = cls(*await asyncio.open_connection("127.0.0.1", port), port)
        bus._writer.write(b"S8\rO\r")
        await bus.caught_up()
        return bus

    async def connect_again(self):
        self.close()
        self._reader, self._writer = await asyncio.open_connection("127.0.0.1", self._port)
        self._writer.write(b"S8\rO\r")

    async def caught_up(self):
        """The adapter has taken all that was sent."""
        self._writer.write(b"V\r")
        async with asyncio.timeout(3):
            await self._reader.readuntil(b"V1013\r")

    def close(self):
        self._writer.close()

    def send(self, can_id, data=""):
        self._writer.write(slcan.encode_frame(slcan.CanFrame(can_id, bytes.fromhex(data))))

    def ask_for(self, can_id):
        """A remote frame."""
        self._writer.write(slcan.encode_frame(slcan.CanFrame(can_id, b"", False, 8)))

    async def frame(self, timeout_s=3.0):
        async with asyncio.timeout(timeout_s):
            while True:
                line = (await self._reader.readuntil(b"\r"))[:-1].lstrip(b"\a")
                if line not in {b"", b"z"}:
                    frame = slcan.decode_frame(line)
                    return frame.can_id, frame.data.hex(" ")

    async def see(self, can_id, data):
        """The next frame with this identifier has these data; others are kept aside."""
        while (frame := await self.frame())[0] != can_id:
            self.passed_over.append(frame)
        assert frame[1] == data

    async def see_after(self, can_id, before, data):
        """The same, but some with the data from before may have been sent already."""
        while (frame := await self.frame()) == (can_id, before):
            pass
        assert frame == (can_id, data)

    async def ask(self, request, answer):
        """One SDO round trip."""
        self.send(0x601, request)
        await self.see(0x581, answer)

    async def write(self, index, code_bytes, subindex=0):
        size = len(code_bytes)
        command = protocol.expedited_command(protocol.SDO_DOWNLOAD, size)
        request = protocol.encode_sdo(command, index, subindex, code_bytes)
        answer = protocol.encode_sdo(protocol.SDO_DOWNLOADED, index, subindex)
        await self.ask(request.hex(), answer.hex(" "))

    async def statusword(self, axis=0):
        index = protocol.STATUSWORD + axis * protocol.AXIS_OFFSET
        self.send(0x601, protocol.encode_sdo(protocol.SDO_UPLOAD, index, 0).hex())
        while (frame := await self.frame())[0] != 0x581:
            self.passed_over.append(frame)
        return int.from_bytes(bytes.fromhex(frame[1])[4:6], "little")

    async def state_becomes(self, state, axis=0):
        end_s = time.monotonic() + 3
        while protocol.state_of(await self.statusword(axis)) is not state:
            assert time.monotonic() < end_s, state

    async def control(self, controlword, state, axis=0):
        """Write a controlword; the axis is in this state at once."""
        index = protocol.CONTROLWORD + axis * protocol.AXIS_OFFSET
        await self.write(index, controlword.to_bytes(2, "little"))
        assert protocol.state_of(await self.statusword(axis)) is state

    async def enable(self, axis):
        offset = axis * protocol.AXIS_OFFSET
        await self.write(protocol.MODE + offset, b"\x09")
        await self.control(0x06, State.READY_TO_SWITCH_ON, axis)
        await self.control(0x07, State.SWITCHED_ON, axis)
        await self.control(0x0F, State.OPERATION_ENABLED, axis)

    async def map_pdos(self):
        """RPDO1 both targets and TPDO1 both positions on SYNC; TPDO2 both statuswords on change."""
        pdos = (
            (0x1400, 0x1600, 0x201, 1, 0x60FF, 32),
            (0x1800, 0x1A00, 0x181, 1, 0x6064, 32),
            (0x1801, 0x1A01, 0x281, 255, 0x6041, 16),
        )
        for communication, mapping, can_id, transmission, index, bits in pdos:
            await self.write(mapping, b"\0")
            for number, axis_index in enumerate((index, index + 0x800), 1):
                entry = protocol.mapping_entry(axis_index, 0, bits).to_bytes(4, "little")
                await self.write(mapping, entry, number)
            await self.write(mapping, b"\x02")
            await self.write(communication, bytes([transmission]), 2)
            await self.write(communication, can_id.to_bytes(4, "little"), 1)


def on_drive(script):
    """Run `script(bus, mock, motors)` against a mock on a free port."""

    async def run():
        siderostat = config.load_rig(config.default_rig_path()).loops["right"].siderostat
        motors = ToldMotors()
        mock = Cia402DriveMock(siderostat, motors, port=0)
        port = await mock.start()
        bus = await Bus.on(port)
        try:
            await script(bus, mock, motors)
        finally:
            bus.close()
            await mock.stop()
        assert asyncio.all_tasks() == {asyncio.current_task()}

    asyncio.run(run())
