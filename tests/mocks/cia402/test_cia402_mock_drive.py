"""The mock drive on the wire: CANopen frames in, CANopen frames out, over SLCAN on TCP."""

import asyncio
import time

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mock_bench import ToldMotors

from fitctl import config
from fitctl.config import Fault
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State
from fitctl.mocks.cia402 import slcan_frames
from fitctl.mocks.cia402.drive import Cia402DriveMock

COUNT_RAD = 2 * 3.141592653589793 / 4000
RPM_RAD_S = 2 * 3.141592653589793 / 60


def fault(kind, **settings):
    return Fault(device="right.drive", kind=kind, **settings)


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
        self._writer.write(
            slcan_frames.encode_frame(slcan_frames.CanFrame(can_id, bytes.fromhex(data)))
        )

    def ask_for(self, can_id):
        """A remote frame."""
        self._writer.write(slcan_frames.encode_frame(slcan_frames.CanFrame(can_id, b"", False, 8)))

    async def frame(self, timeout_s=3.0):
        async with asyncio.timeout(timeout_s):
            while True:
                line = (await self._reader.readuntil(b"\r"))[:-1].lstrip(b"\a")
                if line not in {b"", b"z"}:
                    frame = slcan_frames.decode_frame(line)
                    return frame.can_id, frame.data.hex(" ")

    async def see(self, can_id, data):
        """The next frame with this identifier has these data; others are kept aside."""
        while (frame := await self.frame())[0] != can_id:
            self.passed_over.append(frame)
        assert frame[1] == data

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


def test_sdo_reads_writes_and_aborts():
    async def script(bus, _mock, _motors):
        await bus.ask("40 00 10 00 00000000", "43 00 10 00 92 01 ff ff")  # device type
        await bus.ask("40 18 10 04 00000000", "43 18 10 04 01 29 35 01")  # serial number
        await bus.ask("40 02 65 00 00000000", "43 02 65 00 04 01 00 00")  # modes 3 and 9
        await bus.ask("2f 60 60 00 09000000", "60 60 60 00 00 00 00 00")  # mode 9
        await bus.ask("40 61 60 00 00000000", "4f 61 60 00 09 00 00 00")  # ... is shown
        await bus.ask("22 ff 60 00 e8030000", "60 ff 60 00 00 00 00 00")  # size not given
        await bus.ask("40 99 20 00 00000000", "80 99 20 00 00 00 02 06")  # no such object
        await bus.ask("40 18 10 09 00000000", "80 18 10 09 11 00 09 06")  # no such subindex
        await bus.ask("2b 41 60 00 00000000", "80 41 60 00 02 00 01 06")  # read only
        await bus.ask("2f 40 60 00 06000000", "80 40 60 00 13 00 07 06")  # one byte of two
        await bus.ask("23 40 60 00 06000000", "80 40 60 00 12 00 07 06")  # four bytes of two
        await bus.ask("2f 60 60 00 08000000", "80 60 60 00 30 00 09 06")  # mode 8 not supported
        await bus.ask("c2 00 10 00 00000000", "80 00 10 00 01 00 04 05")  # block transfer

    on_drive(script)


def test_a_text_comes_in_segments():
    async def script(bus, _mock, _motors):
        await bus.ask("40 08 10 00 00000000", "41 08 10 00 1f 00 00 00")
        await bus.ask("60 00000000000000", "00 46 49 54 20 74 77 6f")  # FIT two
        await bus.ask("70 00000000000000", "10 2d 61 78 69 73 20 73")  # -axis s
        await bus.ask("60 00000000000000", "00 65 72 76 6f 20 64 72")  # ervo dr
        await bus.ask("70 00000000000000", "10 69 76 65 20 28 6d 6f")  # ive (mo
        await bus.ask("60 00000000000000", "09 63 6b 29 00 00 00 00")  # ck)
        await bus.ask("40 08 10 00 00000000", "41 08 10 00 1f 00 00 00")
        await bus.ask("70 00000000000000", "80 08 10 00 00 00 03 05")  # toggle bit

    on_drive(script)


def test_a_download_may_come_in_segments():
    async def script(bus, mock, _motors):
        await bus.ask("21 ff 60 00 04000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("07 e8030000 000000", "20 00 00 00 00 00 00 00")  # all four, the last segment
        assert mock.axes[0].target_velocity == 1000
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")  # length not told
        await bus.ask("0a d0070000 000000", "20 00 00 00 00 00 00 00")  # two of four
        await bus.ask("1b 0000 0000000000", "30 00 00 00 00 00 00 00")
        assert mock.axes[0].target_velocity == 0x07D0
        await bus.ask("21 ff 60 00 05000000", "80 ff 60 00 12 00 07 06")  # five bytes of four
        await bus.ask("21 41 60 00 02000000", "80 41 60 00 02 00 01 06")  # read only
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("00 01020304050607", "80 ff 60 00 12 00 07 06")  # seven bytes and more
        await bus.ask("01 01020304050607", "80 ff 60 00 01 00 04 05")  # the transfer is over
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        await bus.ask("17 e8030000 000000", "80 ff 60 00 00 00 03 05")  # toggle bit
        await bus.ask("20 ff 60 00 00000000", "60 ff 60 00 00 00 00 00")
        bus.send(0x601, "80 ff 60 00 00 00 04 05")  # the client gives up
        await bus.ask("07 e8030000 000000", "80 ff 60 00 01 00 04 05")

    on_drive(script)


def test_a_mapping_is_guarded():
    async def script(bus, _mock, _motors):
        await bus.ask("23 00 1a 01 10 00 08 10", "80 00 1a 01 41 00 04 06")  # 1008 is not mappable
        await bus.ask("23 00 1a 01 10 00 64 60", "80 00 1a 01 41 00 04 06")  # 6064 has 32 bits
        await bus.map_pdos()
        await bus.ask("2f 00 1a 00 00000000", "80 00 1a 00 22 00 00 08")  # in service
        await bus.ask("23 02 18 01 01060000", "80 02 18 01 30 00 09 06")  # SDO's identifier
        await bus.ask("23 02 18 01 81030020", "80 02 18 01 30 00 09 06")  # a 29-bit identifier
        await bus.ask("2f 02 18 02 f1000000", "80 02 18 02 30 00 09 06")  # type 241
        await bus.ask("2f 02 14 02 fd000000", "80 02 14 02 30 00 09 06")  # 253, of an RPDO

    on_drive(script)


def test_each_axis_walks_the_state_machine():
    async def script(bus, _mock, motors):
        for axis in (0, 1):
            await bus.control(0x00, State.SWITCH_ON_DISABLED, axis)
            await bus.control(0x0F, State.SWITCH_ON_DISABLED, axis)  # not from here
            await bus.enable(axis)
            assert motors.enabled[axis]
            await bus.control(0x07, State.SWITCHED_ON, axis)
            assert not motors.enabled[axis]
            await bus.control(0x0F, State.OPERATION_ENABLED, axis)
            await bus.control(0x06, State.READY_TO_SWITCH_ON, axis)
            await bus.control(0x02, State.SWITCH_ON_DISABLED, axis)
            await bus.enable(axis)
            await bus.control(0x00, State.SWITCH_ON_DISABLED, axis)
        assert motors.enabled == [False, False]

    on_drive(script)


def test_quick_stop_stops_first_and_disables_then():
    async def script(bus, _mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, 0))  # unit is 1 rpm yet
        await bus.write(protocol.CONTROLWORD, b"\x02\x00")
        await bus.state_becomes(State.SWITCH_ON_DISABLED)
        assert motors.velocity_rad_s == (0, 0)
        assert not motors.enabled[0]

        await bus.write(protocol.QUICK_STOP_OPTION, b"\x06\x00")
        await bus.enable(0)
        await bus.control(0x02, State.QUICK_STOP_ACTIVE)
        assert motors.enabled[0]
        await bus.control(0x0F, State.OPERATION_ENABLED)

    on_drive(script)


def test_a_quick_stop_takes_the_time_of_its_ramp():
    async def script(bus, _mock, motors):
        await bus.write(protocol.QUICK_STOP_DECELERATION, (600).to_bytes(4, "little"))
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        started_s = time.monotonic()
        await bus.control(0x02, State.QUICK_STOP_ACTIVE)  # from 60 rpm by 600 rpm/s
        assert 0 < motors.velocity_rad_s[0] < 60 * RPM_RAD_S
        assert motors.enabled[0]
        await bus.state_becomes(State.SWITCH_ON_DISABLED)
        assert time.monotonic() - started_s >= 0.1
        assert not motors.enabled[0]

    on_drive(script)


@pytest.mark.parametrize("option", [0, 1, 2, 5, 6])
def test_after_any_quick_stop_the_motor_stands(option):
    async def script(bus, _mock, motors):
        await bus.write(protocol.QUICK_STOP_OPTION, option.to_bytes(2, "little"))
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        await bus.write(protocol.CONTROLWORD, b"\x02\x00")
        stays = option >= 5
        await bus.state_becomes(State.QUICK_STOP_ACTIVE if stays else State.SWITCH_ON_DISABLED)
        while motors.velocity_rad_s != (0, 0):
            await asyncio.sleep(0.001)
        assert motors.enabled[0] == stays
        await bus.ask(
            "2b 5a 60 00 03000000", "80 5a 60 00 30 00 09 06"
        )  # option 3: no current limit

    on_drive(script)


def test_profile_velocity_ramps_halts_and_says_where_it_is():
    async def script(bus, _mock, motors):
        reached, zero = protocol.SW_TARGET_REACHED, protocol.SW_SPEED_ZERO
        await bus.enable(0)
        await bus.write(protocol.MODE, b"\x03")
        await bus.write(protocol.ACCELERATION, (600).to_bytes(4, "little"))
        assert await bus.statusword() & (reached | zero) == reached | zero
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert not await bus.statusword() & reached
        assert motors.velocity_rad_s[0] < 60 * RPM_RAD_S
        while not await bus.statusword() & reached:
            pass
        assert motors.velocity_rad_s[0] == pytest.approx(60 * RPM_RAD_S)
        assert not await bus.statusword() & zero
        await bus.ask("40 6b 60 00 00000000", "43 6b 60 00 3c 00 00 00")  # the demand, 60 rpm
        await bus.write(protocol.CONTROLWORD, b"\x0f\x01")  # halt
        while not await bus.statusword() & zero:
            pass
        assert motors.velocity_rad_s[0] == 0
        assert protocol.state_of(await bus.statusword()) is State.OPERATION_ENABLED

    on_drive(script)


def test_a_software_limit_holds_the_axis_and_lets_it_back():
    async def script(bus, _mock, motors):
        await bus.write(protocol.POSITION_LIMITS, (-1000).to_bytes(4, "little", signed=True), 1)
        await bus.write(protocol.POSITION_LIMITS, (1000).to_bytes(4, "little"), 2)
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        assert not await bus.statusword() & protocol.SW_INTERNAL_LIMIT
        motors.angles_rad = [1000 * COUNT_RAD, 0]
        while not await bus.statusword() & protocol.SW_INTERNAL_LIMIT:
            pass
        assert motors.velocity_rad_s == (0, 0)
        await bus.write(protocol.TARGET_VELOCITY, (-60).to_bytes(4, "little", signed=True))
        assert motors.velocity_rad_s[0] == pytest.approx(-60 * RPM_RAD_S)
        assert not await bus.statusword() & protocol.SW_INTERNAL_LIMIT
        motors.angles_rad = [-1001 * COUNT_RAD, 0]
        while motors.velocity_rad_s[0]:  # without any message
            await asyncio.sleep(0.001)

    on_drive(script)


def test_a_fault_stops_is_told_and_is_reset_by_an_edge():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        mock.faults.set(fault("amplifier_fault", part="az"))
        await bus.see(0x081, "10 23 01 01 00 00 00 00")
        await bus.state_becomes(State.FAULT)
        assert motors.velocity_rad_s == (0, 0)
        assert motors.enabled == [False, False]
        await bus.ask("40 3f 60 00 00000000", "4b 3f 60 00 10 23 00 00")
        await bus.ask("40 01 10 00 00000000", "4f 01 10 00 01 00 00 00")  # error register
        await bus.ask("40 03 10 00 00000000", "4f 03 10 00 01 00 00 00")  # history
        await bus.ask("40 03 10 01 00000000", "43 03 10 01 10 23 01 00")
        await bus.ask("40 03 10 02 00000000", "80 03 10 02 24 00 00 08")  # no more
        await bus.control(0x0F, State.FAULT)
        await bus.control(0x80, State.FAULT)  # the cause is still there
        mock.faults.clear()
        await bus.control(0x00, State.FAULT)
        await bus.control(0x80, State.SWITCH_ON_DISABLED)
        assert (0x081, "00 00 00 00 00 00 00 00") in bus.passed_over
        await bus.ask("2f 03 10 00 01000000", "80 03 10 00 30 00 09 06")
        await bus.ask("2f 03 10 00 00000000", "60 03 10 00 00 00 00 00")  # forgotten
        await bus.ask("40 03 10 00 00000000", "4f 03 10 00 00 00 00 00")
        mock.faults.set(fault("amplifier_fault", part="az", for_s=0.01))
        while mock.faults.active:
            await asyncio.sleep(0.001)
        await bus.control(0x80, State.FAULT)  # the bit was set already: no edge

    on_drive(script)


def test_a_pdo_cycle():
    async def script(bus, mock, motors):
        await bus.map_pdos()
        for index in (protocol.UNIT_VELOCITY, protocol.UNIT_VELOCITY + 0x800):
            await bus.write(index, protocol.UNIT_MILLI_RPM.to_bytes(4, "little"))
        bus.send(0x000, "01 01")
        await bus.see(0x281, "50 02 50 02")  # both switch-on disabled, remote, voltage
        await bus.enable(0)
        await bus.enable(1)
        statuswords = [data for can_id, data in bus.passed_over if can_id == 0x281]
        assert statuswords[-1] == "37 12 37 12"  # each change was told

        motors.angles_rad = [10 * COUNT_RAD, -1.4 * COUNT_RAD]
        bus.send(0x201, "60 ea 00 00 a0 15 ff ff")  # 60 and -60 rpm
        await bus.ask("40 ff 60 00 00000000", "43 ff 60 00 00 00 00 00")
        assert motors.velocity_rad_s == (0, 0)  # not before SYNC
        bus.send(0x080)
        await bus.see(0x181, "0a 00 00 00 ff ff ff ff")
        assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, -60 * RPM_RAD_S))

        motors.angles_rad = [2**31 * COUNT_RAD, 0]  # the counter wraps
        bus.send(0x080)
        await bus.see(0x181, "00 00 00 80 00 00 00 00")

        bus.send(0x201, "60 ea")  # too short: not acted on, but told
        bus.send(0x080)
        await bus.see(0x081, "10 82 00 00 00 00 00 00")

        bus.send(0x000, "80 01")
        for axis in (0, 1):  # leaving operation stops both
            await bus.state_becomes(State.SWITCH_ON_DISABLED, axis)
        assert motors.velocity_rad_s == (0, 0)
        bus.send(0x080)
        bus.passed_over.clear()
        await bus.statusword()
        assert not [frame for frame in bus.passed_over if frame[0] == 0x181]

    on_drive(script)


def test_tpdos_by_divided_sync_and_by_timer():
    async def script(bus, _mock, _motors):
        await bus.map_pdos()
        await bus.write(0x1800, b"\x03", 2)  # every third SYNC
        await bus.write(0x1801, (30).to_bytes(2, "little"), 5)
        bus.send(0x000, "01 01")
        for _ in range(6):
            bus.send(0x080)
        await bus.ask("40 00 10 00 00000000", "43 00 10 00 92 01 ff ff")
        assert [frame[0] for frame in bus.passed_over].count(0x181) == 2
        for _ in range(3):
            await bus.see(0x281, "50 02 50 02")

    on_drive(script)


def test_the_heartbeat_says_the_nmt_state():
    async def script(bus, _mock, _motors):
        await bus.write(protocol.HEARTBEAT_PRODUCER, (20).to_bytes(2, "little"))
        await bus.see(0x701, "7f")
        bus.send(0x000, "01 00")
        await bus.see(0x701, "05")
        bus.send(0x000, "02 01")
        await bus.see(0x701, "04")
        bus.send(0x601, "40 00 10 00 00000000")
        assert (await bus.frame())[0] == 0x701  # stopped: no SDO
        bus.send(0x000, "81 02")  # another node's reset
        bus.send(0x000, "81 01")
        while (state := (await bus.frame())[1]) == "04":
            pass
        assert state == "00"  # boot-up, and the producer is off again
        await bus.ask("40 17 10 00 00000000", "4b 17 10 00 00 00 00 00")

    on_drive(script)


def test_a_lost_master_heartbeat_stops_both_motors():
    async def script(bus, _mock, motors):
        await bus.write(
            protocol.HEARTBEAT_CONSUMER, bytes.fromhex("64007f00"), 1
        )  # node 127, 100 ms
        await bus.enable(0)
        await bus.enable(1)
        await asyncio.sleep(0.15)
        assert motors.enabled == [True, True]  # it was not seen yet
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        bus.send(0x77F, "05")
        await bus.see(0x081, "30 81 11 00 00 00 00 00")
        for axis in (0, 1):
            await bus.state_becomes(State.FAULT, axis)
        assert motors.velocity_rad_s == (0, 0)
        assert motors.enabled == [False, False]

    on_drive(script)


@pytest.mark.parametrize(
    ("option", "state"),
    [(0, State.OPERATION_ENABLED), (2, State.SWITCH_ON_DISABLED), (3, State.SWITCH_ON_DISABLED)],
)
def test_what_a_lost_master_does_can_be_chosen(option, state):
    async def script(bus, _mock, motors):
        await bus.write(protocol.ABORT_OPTION, option.to_bytes(2, "little"))
        await bus.write(protocol.HEARTBEAT_CONSUMER, bytes.fromhex("14007f00"), 1)
        await bus.enable(0)
        bus.send(0x77F, "05")
        await bus.see(0x081, "30 81 11 00 00 00 00 00")  # the other axis is in fault
        await bus.state_becomes(state)
        assert motors.enabled[0] == (option == 0)

    on_drive(script)


def test_a_tpdo_on_change_at_sync():
    async def script(bus, _mock, _motors):
        await bus.map_pdos()
        await bus.write(0x1801, b"\x00", 2)
        bus.send(0x000, "01 01")
        bus.send(0x080)
        await bus.see(0x281, "50 02 50 02")
        bus.send(0x080)
        await bus.control(0x06, State.READY_TO_SWITCH_ON)
        assert 0x281 not in [frame[0] for frame in bus.passed_over]
        bus.send(0x080)
        await bus.see(0x281, "31 02 50 02")

    on_drive(script)


def test_a_tpdo_can_be_asked_for_by_a_remote_frame():
    async def script(bus, _mock, motors):
        await bus.map_pdos()
        motors.angles_rad = [10 * COUNT_RAD, 0]
        bus.ask_for(0x181)  # not operational yet
        bus.send(0x000, "01 01")
        bus.ask_for(0x181)
        await bus.see(0x181, "0a 00 00 00 00 00 00 00")

        await bus.write(0x1800, (0x4000_0181 | protocol.PDO_DISABLED).to_bytes(4, "little"), 1)
        await bus.write(0x1800, b"\xfc", 2)  # 252: as sampled at SYNC
        await bus.write(0x1800, (0x181).to_bytes(4, "little"), 1)
        bus.send(0x080)
        await bus.statusword()
        motors.angles_rad = [20 * COUNT_RAD, 0]
        bus.ask_for(0x181)
        await bus.see(0x181, "0a 00 00 00 00 00 00 00")

        await bus.write(0x1800, protocol.PDO_DISABLED.to_bytes(4, "little"), 1)
        await bus.write(0x1800, (0x4000_0181).to_bytes(4, "little"), 1)  # no remote frames
        bus.ask_for(0x181)
        bus.passed_over.clear()
        await bus.statusword()
        assert 0x181 not in [frame[0] for frame in bus.passed_over]

    on_drive(script)


def test_the_last_client_leaving_does_not_stop_the_drive_by_itself():
    async def script(bus, mock, motors):
        await bus.enable(0)
        mock.faults.set(fault("disconnect"))
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await bus.frame()
        assert motors.enabled[0]

    on_drive(script)


def test_a_severed_can_cable_leaves_an_adapter_without_a_drive():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("link_loss"))
        bus.send(0x601, "40 00 10 00 00000000")
        await bus.caught_up()
        mock.faults.clear()
        await bus.ask("40 18 10 04 00000000", "43 18 10 04 01 29 35 01")
        assert bus.passed_over == []

    on_drive(script)


def test_a_jumped_encoder_counts_more_until_it_is_mended():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("encoder_jump", part="el", value=-3))
        await bus.ask("40 64 60 00 00000000", "43 64 60 00 00 00 00 00")
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 fd ff ff ff")
        mock.faults.clear()
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 00 00 00 00")

    on_drive(script)


def test_a_stuck_axis_stands_still_and_the_drive_does_not_know():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        mock.faults.set(fault("stuck_axis"))
        assert motors.velocity_rad_s == (0, 0)
        await bus.state_becomes(State.OPERATION_ENABLED)
        mock.faults.clear()
        assert motors.velocity_rad_s[0] > 0

    on_drive(script)


def test_a_following_error_is_a_fault_of_its_own():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("following_error", part="el"))
        await bus.see(0x081, "11 86 01 02 00 00 00 00")
        await bus.state_becomes(State.FAULT, axis=1)
        await bus.state_becomes(State.SWITCH_ON_DISABLED, axis=0)

    on_drive(script)


def test_neither_a_reset_of_the_node_nor_a_reboot_mends_an_amplifier():
    async def script(bus, mock, _motors):
        mock.faults.set(fault("amplifier_fault", part="el"))
        bus.send(0x000, "81 01")
        await bus.see(0x701, "00")
        await bus.state_becomes(State.FAULT, axis=1)
        mock.faults.set(fault("reboot", value=0.01))
        while mock.faults.value("reboot") is not None:
            await asyncio.sleep(0.001)
        await bus.connect_again()
        await bus.state_becomes(State.FAULT, axis=1)
        await bus.state_becomes(State.SWITCH_ON_DISABLED, axis=0)

    on_drive(script)


def test_after_a_reboot_all_is_as_at_power_up_and_counters_start_anew():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.HEARTBEAT_PRODUCER, (20).to_bytes(2, "little"))
        motors.angles_rad = [100 * COUNT_RAD, 0]
        mock.faults.set(fault("reboot", value=0.01))
        assert motors.enabled == [False, False]
        while mock.faults.active:
            await asyncio.sleep(0.001)
        assert mock.nmt_state == 0x7F
        assert mock.heartbeat_ms == 0
        await bus.connect_again()
        motors.angles_rad = [101 * COUNT_RAD, 0]
        await bus.ask("40 64 60 00 00000000", "43 64 60 00 01 00 00 00")
        assert protocol.state_of(await bus.statusword()) is State.SWITCH_ON_DISABLED

    on_drive(script)


WRITTEN = (
    *(0x1003, 0x1016, 0x1017, 0x1400, 0x1600, 0x1800, 0x1A00),
    *(0x6007, 0x6040, 0x605A, 0x607D, 0x6083, 0x6085, 0x60FF, 0x6860),
)
random_frames = st.tuples(
    st.sampled_from([0x601, 0x601, 0x601, 0x000, 0x080, 0x201, 0x301, 0x77F, 0x123]),
    st.binary(max_size=8)
    | st.builds(
        protocol.encode_sdo,
        st.sampled_from([0x00, 0x01, 0x17, 0x20, 0x21, 0x23, 0x2B, 0x2F, 0x40, 0x60, 0x70, 0x80]),
        st.sampled_from(WRITTEN),
        st.integers(0, 3),
        st.binary(max_size=4),
    ),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(random_frames, max_size=30))
def test_no_frame_breaks_the_drive(frames):
    async def script(bus, _mock, _motors):
        for can_id, data in frames:
            bus.send(can_id, data.hex())
        bus.send(0x000, "81 00")
        await bus.see(0x701, "00")
        await bus.ask("40 64 68 00 00000000", "43 64 68 00 00 00 00 00")

    on_drive(script)
