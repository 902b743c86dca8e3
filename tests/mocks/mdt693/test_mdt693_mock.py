"""Read these as transcripts: what a terminal sends, and every byte that comes back."""

import asyncio
import os
from contextlib import asynccontextmanager

import pytest

from fitctl import config
from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.mdt693.device import Dialect
from fitctl.mocks.mdt693.server import Mdt693Mock

PIEZO = load_rig(default_rig_path()).loops["right"].fsm.piezo


class Terminal:
    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    async def transcript(self, *exchanges):
        """Each exchange is what is typed, and what must come back, exactly and nothing more."""
        for typed, answer in exchanges:
            self.writer.write(typed)
            got = await asyncio.wait_for(self.reader.readexactly(len(answer)), 5)
            assert (typed, got) == (typed, answer)


@asynccontextmanager
async def amplifier(model="MDT693B", firmware="2.04", switch_v=150, dialect=None, reply_s=0.0):
    outputs = []
    mock = Mdt693Mock(
        config.Mdt693Mock(model=model, firmware=firmware, limit_switch_v=switch_v, reply_s=reply_s),
        PIEZO,
        lambda volts: outputs.append([round(value, 6) for value in volts]),
        port=0,
        dialect=dialect,
    )
    try:
        ends = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", ends.tcp_port)
        mock.ends = ends
        yield mock, Terminal(reader, writer), outputs
        writer.close()
    finally:
        await mock.stop()


def test_the_session_recorded_from_firmware_1_05():
    async def scene():
        async with amplifier(firmware="1.05", switch_v=100) as (_, terminal, _):
            await terminal.transcript(
                (b"vlimit?\r", b"vlimit?\r*[ 100]\r*"),
                (b"xvoltage=24.8\r", b"xvoltage=24.8\r*"),
                (b"xvoltage?\r", b"xvoltage?\r*[  24.8]\r*"),
                (b"cm?\r", b"cm?\r*[MDT693A Compatibility Mode Off]\r*"),
                (b"xmin?\r", b"xmin?\r*0\r*"),
                (b"xmax?\r", b"xmax?\r*100.5\r*"),
                (
                    b"id?\r",
                    b"id?\r*\r\r\rModel MDT693B Piezo Control Module\rFirmware Version: 1.05\r",
                ),
            )

    asyncio.run(scene())


def test_a_693b_with_the_manuals_prompt():
    async def scene():
        async with amplifier() as (_, terminal, _):
            await terminal.transcript(
                (b"echo?\r", b"echo?\r[Echo On]\r>"),
                (b"echo=0\r", b"echo=0\r>"),
                (b"\n\r", b"CMD_NOT_DEFINED>"),
                (b"VLIMIT?\n\r", b"[ 150]\r>"),
                (b"allvoltage=10\r", b">"),
                (b"xyzvoltage=[1,2.5,30]\r", b">"),
                (b"xyzvoltage?\r", b"[  1.0,   2.5,  30.0]\r>"),
                (b"xyzvoltage=1,2\r", b"CMD_NOT_DEFINED>"),
                (b"zvoltage?\r", b"[  30.0]\r>"),
                (b"zmax=20\r", b">"),
                (b"zvoltage?\r", b"[  20.0]\r>"),
                (b"serial?\r", b"000000-00\r>"),
                (b"restore\r", b">"),
                (b"zmax?\r", b"zmax?\r150.5\r>"),
            )

    asyncio.run(scene())


def test_a_693b_in_693a_compatibility_mode():
    async def scene():
        async with amplifier() as (_, terminal, _):
            await terminal.transcript(
                (b"echo=0\r", b"echo=0\r>"),
                (b"cm=1\r", b"*"),
                (b"nonsense\r", b"!"),
                (b"XV12.34\r", b"*"),
                (b"XR?\r", b"[  12.3]\r*"),
                (b"cm=0\r", b">"),
            )

    asyncio.run(scene())


def test_a_693a():
    async def scene():
        async with amplifier(model="MDT693A") as (_, terminal, _):
            await terminal.transcript(
                (b"E\r", b"E\r*[Echo Off]\r*"),
                (b"id?\r", b"!"),
                (b"D\r", b"MDT693A\r*"),
                (b"%\r", b"[ 150]\r*"),
                (b"AV15\r", b"*"),
                (b"yr?\r", b"[  15.0]\r*"),
                (b"XH100\r", b"*"),
                (b"XH?\r", b"[ 100.0]\r*"),
                (b"XL?\r", b"[   0.0]\r*"),
                (b"XV101\r", b"!"),
                (b"E\r", b"[Echo On]\r*"),
            )

    asyncio.run(scene())


def test_another_firmware_answers_a_position_and_a_prompt_with_a_space():
    async def scene():
        async with amplifier(dialect=Dialect("> ", True, True)) as (_, terminal, _):
            await terminal.transcript((b"vlimit?\r", b"vlimit?\r2\r> "))

    asyncio.run(scene())


def test_half_a_command_waits_and_two_in_one_packet_are_both_answered():
    async def scene():
        async with amplifier() as (_, terminal, _):
            await terminal.transcript(
                (b"ech", b""),
                (b"o=0\rvlim", b"echo=0\r>"),
                (b"it?\rxmin?\r", b"[ 150]\r>0\r>"),
            )

    asyncio.run(scene())


def test_a_flood_without_cr_is_one_wrong_command():
    async def scene():
        async with amplifier() as (_, terminal, _):
            await terminal.transcript((b"echo=0\r", b"echo=0\r>"))
            terminal.writer.write(b"xvoltage=" + b"0" * 100_000)
            await terminal.transcript((b"\r", b"CMD_NOT_DEFINED>"), (b"xmin?\r", b"0\r>"))

    asyncio.run(scene())


def test_answers_take_the_devices_time():
    async def scene():
        async with amplifier(reply_s=0.1) as (_, terminal, _):
            started_s = asyncio.get_running_loop().time()
            await terminal.transcript((b"xmin?\rxmax?\r", b"xmin?\r0\r>xmax?\r150.5\r>"))
            assert asyncio.get_running_loop().time() - started_s >= 0.19

    asyncio.run(scene())


def test_the_output_is_external_input_times_gain_plus_set_point_within_the_limits():
    async def scene():
        async with amplifier() as (mock, terminal, outputs):
            assert outputs == [[0, 0, 0]]
            mock.set_external_input_v([1.0, 5.0, 10.0])
            assert outputs[-1] == [15, 75, 150]
            await terminal.transcript((b"xvoltage=2\r", b"xvoltage=2\r>"))
            assert outputs[-1] == [17, 75, 150]
            await terminal.transcript((b"allvoltage=2\r", b"allvoltage=2\r>"))
            assert outputs[-1] == [17, 77, 150.5]
            await terminal.transcript((b"ymax=50\r", b"ymax=50\r>"), (b"xmin=20\r", b"xmin=20\r>"))
            assert outputs[-1] == [20, 50, 150.5]
            seen = len(outputs)
            mock.set_external_input_v([1.0, 5.0, 10.0])
            assert len(outputs) == seen

    asyncio.run(scene())


@pytest.mark.parametrize(("switch_v", "highest_v"), [(75, 75.5), (100, 100.5), (150, 150.0)])
def test_the_limit_switch_clips_whatever_else_is_set(switch_v, highest_v):
    async def scene():
        async with amplifier() as (mock, terminal, outputs):
            await terminal.transcript((b"xmin=110\r", b"xmin=110\r>"))
            mock.set_external_input_v([10.0, 10.0, 10.0])
            mock.amplifier.set_limit_switch_v(switch_v)
            assert outputs[-1] == [highest_v] * 3

    asyncio.run(scene())


def test_the_pty_speaks_for_the_same_device_and_outlives_its_clients():
    async def scene():
        async with amplifier() as (mock, terminal, _):
            for _ in range(2):
                client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
                os.write(client, b"yvoltage=7\ryvoltage?\r")
                wanted, got = b"yvoltage=7\r>yvoltage?\r[   7.0]\r>", b""
                while len(got) < len(wanted):
                    got += await asyncio.to_thread(os.read, client, 100)
                assert got == wanted
                os.close(client)
            await terminal.transcript((b"yvoltage?\r", b"yvoltage?\r[   7.0]\r>"))

    asyncio.run(scene())


def test_a_client_that_never_reads_does_not_stop_the_others():
    async def scene():
        async with amplifier() as (mock, terminal, _):
            client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
            for _ in range(200):
                os.write(client, b"?\r" * 10)
                await asyncio.sleep(0)
            await terminal.transcript((b"xmin?\r", b"xmin?\r0\r>"))
            os.close(client)

    asyncio.run(scene())


def test_it_can_be_silent_and_garbled():
    async def scene():
        async with amplifier() as (mock, terminal, _):
            mock.silent = True
            terminal.writer.write(b"xmin?\r")
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(terminal.reader.read(1), 0.15)
            mock.silent, mock.garbled = False, True
            await terminal.transcript((b"xmin?\r", b"\xfe"))

    asyncio.run(scene())


def test_nothing_is_left_after_stop():
    async def scene():
        before = set(os.listdir("/proc/self/fd"))
        async with amplifier() as (mock, _, _):
            client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
            os.close(client)
        await mock.stop()
        assert asyncio.all_tasks() == {asyncio.current_task()}
        await asyncio.sleep(0)
        assert set(os.listdir("/proc/self/fd")) <= before

    asyncio.run(scene())
