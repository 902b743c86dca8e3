"""The mock drive on the wire: CANopen frames in, CANopen frames out, over SLCAN on TCP."""

import asyncio
import time

import canopen
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from fitctl import config
from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State
from fitctl.mocks.cia402 import slcan
from fitctl.mocks.cia402.drive import Cia402DriveMock

COUNT_RAD = 2 * 3.141592653589793 / 4000
RPM_RAD_S = 2 * 3.141592653589793 / 60


class RecordingMotors:
    def __init__(self):
        self.angle_rad = [0.0, 0.0]
        self.velocity_rad_s = (0.0, 0.0)
        self.enabled = [False, False]

    def position_rad(self):
        return self.angle_rad

    def command_velocity_rad_s(self, az, el):
        self.velocity_rad_s = (az, el)

    def set_enabled(self, axis, enabled):
        self.enabled[axis] = enabled


class Bus:
    """One raw SLCAN client that speaks in (identifier, hexadecimal data)."""

    def __init__(self, reader, writer):
        self._reader, self._writer = reader, writer
        self.passed_over = []

    def send(self, can_id, data=""):
        self._writer.write(slcan.encode_frame(slcan.CanFrame(can_id, bytes.fromhex(data))))

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
        motors = RecordingMotors()
        mock = Cia402DriveMock(siderostat, motors, port=0)
        port = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(b"S8\rO\r")
        try:
            await script(Bus(reader, writer), mock, motors)
        finally:
            writer.close()
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
        await bus.ask("2f 40 60 00 06000000", "80 40 60 00 10 00 07 06")  # one byte of two
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


def test_a_mapping_is_guarded():
    async def script(bus, _mock, _motors):
        await bus.ask("23 00 1a 01 10 00 08 10", "80 00 1a 01 41 00 04 06")  # 1008 is not mappable
        await bus.ask("23 00 1a 01 10 00 64 60", "80 00 1a 01 41 00 04 06")  # 6064 has 32 bits
        await bus.map_pdos()
        await bus.ask("2f 00 1a 00 00000000", "80 00 1a 00 22 00 00 08")  # in service

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
        assert motors.velocity_rad_s == (0, 0)
        await bus.state_becomes(State.SWITCH_ON_DISABLED)
        assert not motors.enabled[0]

        await bus.write(protocol.QUICK_STOP_OPTION, b"\x06\x00")
        await bus.enable(0)
        await bus.control(0x02, State.QUICK_STOP_ACTIVE)
        assert motors.enabled[0]
        await bus.control(0x0F, State.OPERATION_ENABLED)

    on_drive(script)


def test_a_fault_stops_is_told_and_is_reset_by_an_edge():
    async def script(bus, mock, motors):
        await bus.enable(0)
        await bus.write(protocol.TARGET_VELOCITY, (60).to_bytes(4, "little"))
        mock.inject_fault(0, 0x2310)
        assert motors.velocity_rad_s == (0, 0)
        await bus.see(0x081, "10 23 01 01 00 00 00 00")
        await bus.state_becomes(State.FAULT)
        assert not motors.enabled[0]
        await bus.ask("40 3f 60 00 00000000", "4b 3f 60 00 10 23 00 00")
        await bus.control(0x0F, State.FAULT)
        await bus.write(protocol.CONTROLWORD, b"\x80\x00")
        assert (0x081, "00 00 00 00 00 00 00 00") in bus.passed_over
        assert protocol.state_of(await bus.statusword()) is State.SWITCH_ON_DISABLED
        mock.inject_fault(0, 0x2310)
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

        motors.angle_rad = [10 * COUNT_RAD, -1.4 * COUNT_RAD]
        bus.send(0x201, "60 ea 00 00 a0 15 ff ff")  # 60 and -60 rpm
        await bus.ask("40 ff 60 00 00000000", "43 ff 60 00 00 00 00 00")
        assert motors.velocity_rad_s == (0, 0)  # not before SYNC
        bus.send(0x080)
        await bus.see(0x181, "0a 00 00 00 ff ff ff ff")
        assert motors.velocity_rad_s == pytest.approx((60 * RPM_RAD_S, -60 * RPM_RAD_S))

        motors.angle_rad = [2**31 * COUNT_RAD, 0]  # the counter wraps
        bus.send(0x080)
        await bus.see(0x181, "00 00 00 80 00 00 00 00")

        bus.send(0x201, "60 ea")  # too short: not acted on, but told
        bus.send(0x080)
        await bus.see(0x081, "10 82 00 00 00 00 00 00")

        bus.send(0x000, "80 01")
        await bus.state_becomes(State.SWITCH_ON_DISABLED)  # leaving operation stops both axes
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
        assert motors.velocity_rad_s == (0, 0)
        for axis in (0, 1):
            await bus.state_becomes(State.FAULT, axis)
        assert motors.enabled == [False, False]

    on_drive(script)


def test_the_last_client_leaving_does_not_stop_the_drive_by_itself():
    async def script(bus, mock, motors):
        await bus.enable(0)
        mock.drop_links()
        with pytest.raises((ConnectionError, asyncio.IncompleteReadError)):
            await bus.frame()
        assert motors.enabled[0]

    on_drive(script)


random_frames = st.tuples(
    st.sampled_from([0x601, 0x601, 0x601, 0x000, 0x080, 0x201, 0x301, 0x77F, 0x123]),
    st.binary(max_size=8)
    | st.builds(
        protocol.encode_sdo,
        st.sampled_from([0x20, 0x22, 0x23, 0x2B, 0x2F, 0x40, 0x60, 0x70, 0x80]),
        st.sampled_from([0x1016, 0x1017, 0x1400, 0x1600, 0x1800, 0x1A00, 0x6040, 0x6860, 0x60FF]),
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


def test_python_canopen_finds_nothing_strange():
    """An independent master: SDO with its segmented transfer, abort, NMT, heartbeat."""

    def talk(port):
        network = canopen.Network()
        network.connect(
            interface="slcan",
            channel=f"socket://127.0.0.1:{port}",
            bitrate=1000000,
            sleep_after_open=0,
        )
        try:
            node = network.add_node(1, canopen.ObjectDictionary())
            assert node.sdo.upload(0x1008, 0) == b"FIT two-axis servo drive (mock)"
            node.sdo.download(0x1017, 0, (50).to_bytes(2, "little"))
            with pytest.raises(canopen.SdoAbortedError) as aborted:
                node.sdo.upload(0x2099, 0)
            assert aborted.value.code == 0x06020000
            node.nmt.state = "OPERATIONAL"
            assert node.nmt.wait_for_heartbeat(timeout=3) == "OPERATIONAL"
        finally:
            network.disconnect()

    async def run():
        siderostat = config.load_rig(config.default_rig_path()).loops["right"].siderostat
        mock = Cia402DriveMock(siderostat, RecordingMotors(), port=0)
        port = await mock.start()
        try:
            await asyncio.to_thread(talk, port)
        finally:
            await mock.stop()

    asyncio.run(run())
