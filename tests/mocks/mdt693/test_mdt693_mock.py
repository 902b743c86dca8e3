"""Read these as transcripts: what a terminal sends, and every byte that comes back."""

import asyncio
import os

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from instruments.mock_bench import in_a_loop
from mdt693_terminal import A_301, B_105, B_110, COMPATIBLE, QUIET, amplifier

from fitctl.mocks.mdt693.line import CommandSplitter

# ---------------------------------------------------------------- dialects


@in_a_loop
async def test_the_session_recorded_from_firmware_1_05():
    async with amplifier(B_105, limit_switch_v=100) as (_, terminal, _):
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


@in_a_loop
async def test_the_session_recorded_from_firmware_1_10():
    async with amplifier(B_110, QUIET) as (mock, terminal, _):
        mock.set_external_input_v([0.24 / 15, 0.21 / 15, 0.22 / 15])
        await terminal.transcript(
            (b"XMAX?\r", b"150.50\r>"),
            (b"XMIN?\r", b"0\r>"),
            (b"xyzvoltage?\r", b"[  0.24,  0.21,  0.22]\r>"),
            (b"xvoltage?\r", b"[  0.24]\r>"),
            (b"HELP?\r", b"CMD_NOT_DEFINED>"),
            (b"XV 1\r", b"CMD_NOT_DEFINED>"),
            (b"\n\r", b"CMD_NOT_DEFINED>"),
        )


@in_a_loop
async def test_the_session_recorded_from_a_693a_with_firmware_3_01():
    identity = (
        b"*     \r\r\rModel MDT693A Piezo Control Module\rFirmware Version: 3.01\r"
        b"Voltage Range: 0V to 150V\rThorlabs, Inc. Newton, NJ 07860\rwww.thorlabs.com\r\r"
    )
    async with amplifier(A_301, QUIET) as (mock, terminal, _):
        mock.set_external_input_v([0.9 / 15, 1.0 / 15, 50.4 / 15])
        await terminal.transcript(
            (b"I\r", identity),
            (b"ID?\r", identity),
            (b"XR?\r", b"*[   0.9]\r"),
            (b"YR?\r", b"*[     1]\r"),
            (b"ZR?\r", b"*[  50.4]\r"),
            (b"XV?\r", b"!"),
            (b"XL?\r", b"*0"),
            (b"XH?\r", b"*150"),
            (b"%\r", b"*[ 150]\r"),
            (b"XVOLTAGE?\r", b"!"),
            (b"E\r", b"*[Echo On]\r"),
            (b"XR?\r\n", b"xr?\r*[   0.9]\r"),
            (b"XV1\r", b"\nxv1\r*"),
            (b"XV=1.00\r", b"xv=1.00\r!"),
            (b"E=0\r", b"e=0\r!"),
        )


@in_a_loop
async def test_a_693b_in_693a_compatibility_mode():
    async with amplifier(B_110, QUIET) as (_, terminal, _):
        await terminal.transcript(
            (b"cm=1\r", b"*"),
            (b"nonsense\r", b"!"),
            (b"XV12.34\r", b"*"),
            (b"XR?\r", b"[ 12.34]\r*"),
            (b"vlimit?\r", b"[ 150]\r*"),
            (b"cm=0\r", b">"),
            (b"nonsense\r", b"CMD_NOT_DEFINED>"),
        )


@in_a_loop
async def test_each_disagreement_of_public_sources_is_a_setting():
    async with amplifier(
        QUIET, prompt="> ", vlimit_as="position", dacstep_max=1000, push_command="disablepush"
    ) as (_, terminal, _):
        await terminal.transcript(
            (b"vlimit?\r", b"2\r> "),
            (b"dacstep=1001\r", b"CMD_NOT_DEFINED>"),
            (b"disablepush=1\r", b"> "),
            (b"disablepush?\r", b"1\r> "),
            (b"pushdisable?\r", b"CMD_NOT_DEFINED>"),
            (b"xyzvoltage?\r", b"CMD_NOT_DEFINED>"),
            (b"xyzvoltage=1,2,3\r", b"CMD_NOT_DEFINED>"),
        )
    async with amplifier(B_110, QUIET) as (_, terminal, _):
        await terminal.transcript(
            (b"xyzvoltage=[1,2.5,30]\r", b">"),
            (b"xyzvoltage?\r", b"[  1.00,  2.50, 30.00]\r>"),
            (b"xyzvoltage=3,2,1\r", b">"),
            (b"xyzvoltage?\r", b"[  3.00,  2.00,  1.00]\r>"),
        )


# ---------------------------------------------------------------- the line


@in_a_loop
async def test_half_a_command_waits_and_two_in_one_packet_are_both_answered():
    async with amplifier(B_110) as (_, terminal, _):
        await terminal.transcript(
            (b"ech", b""),
            (b"o=0\rvlim", b"echo=0\r>"),
            (b"it?\rxmin?\r", b"[ 150]\r>0\r>"),
        )


@in_a_loop
async def test_a_flood_without_cr_is_one_wrong_command():
    async with amplifier(B_110, QUIET) as (_, terminal, _):
        terminal.writer.write(b"xvoltage=" + b"0" * 100_000)
        await terminal.transcript((b"\r", b"CMD_NOT_DEFINED>"), (b"xmin?\r", b"0\r>"))


@in_a_loop
async def test_answers_take_the_devices_time():
    async with amplifier(B_110, reply_s=0.1) as (_, terminal, _):
        started_s = asyncio.get_running_loop().time()
        await terminal.transcript((b"xmin?\rxmax?\r", b"xmin?\r0\r>xmax?\r150.50\r>"))
        assert asyncio.get_running_loop().time() - started_s >= 0.19


@in_a_loop
async def test_a_byte_takes_ten_bits_at_the_baud_rate_both_ways():
    async with amplifier(B_110, QUIET, baud_rate=1200) as (mock, _, _):
        client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
        started_s = asyncio.get_running_loop().time()
        os.write(client, b"xyzvoltage?\r")
        wanted, got = b"[  0.00,  0.00,  0.00]\r>", b""
        while len(got) < len(wanted):
            got += await asyncio.to_thread(os.read, client, 100)
        took_s = asyncio.get_running_loop().time() - started_s
        os.close(client)
        assert got == wanted
        assert took_s >= (12 + 24) * 10 / 1200


@in_a_loop
async def test_the_pty_speaks_for_the_same_device_and_outlives_its_clients():
    async with amplifier(B_110) as (mock, terminal, _):
        for _ in range(2):
            client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
            os.write(client, b"yvoltage=7\ryvoltage?\r")
            wanted, got = b"yvoltage=7\r>yvoltage?\r[  7.00]\r>", b""
            while len(got) < len(wanted):
                got += await asyncio.to_thread(os.read, client, 100)
            assert got == wanted
            os.close(client)
        await terminal.transcript((b"yvoltage?\r", b"yvoltage?\r[  7.00]\r>"))


@in_a_loop
async def test_clients_that_never_read_do_not_stop_the_others():
    async with amplifier(B_110) as (mock, terminal, _):
        _, deaf = await asyncio.open_connection("127.0.0.1", mock.ends.tcp_port)
        client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        for _ in range(20):
            deaf.write(b"?\r" * 10)
            os.write(client, b"?\r" * 10)
            await asyncio.sleep(0)
        await terminal.transcript((b"xmin?\r", b"xmin?\r0\r>"))
        os.close(client)
        deaf.close()


@in_a_loop
async def test_nothing_is_left_after_stop():
    before = set(os.listdir("/proc/self/fd"))
    async with amplifier() as (mock, _, _):
        client = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
        os.close(client)
    await mock.stop()
    assert asyncio.all_tasks() == {asyncio.current_task()}
    await asyncio.sleep(0)
    assert set(os.listdir("/proc/self/fd")) <= before


@given(st.lists(st.binary(max_size=100), max_size=5))
@settings(max_examples=200)
def test_the_cut_of_a_stream_changes_none_of_its_commands(chunks):
    piecewise, at_once = CommandSplitter(), CommandSplitter()
    commands = [command for chunk in chunks for command in piecewise.feed(chunk)]
    assert commands == at_once.feed(b"".join(chunks))


@pytest.mark.parametrize("variant", [A_301, B_105, B_110, COMPATIBLE], ids=str)
@given(noise=st.binary(max_size=200))
@settings(max_examples=25)
def test_any_bytes_leave_the_device_alive(variant, noise):
    async def scene():
        async with amplifier(variant) as (_, terminal, _):
            terminal.writer.write(noise + b"\r%\r")
            await asyncio.wait_for(terminal.reader.readuntil(b"[ 150]\r"), 10)

    asyncio.run(scene())
