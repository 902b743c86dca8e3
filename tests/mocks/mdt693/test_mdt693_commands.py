"""What each command does, and to which voltages."""

import asyncio
import itertools

import pytest
from instruments.mock_bench import in_a_loop
from mdt693_terminal import A_301, B_110, EXACT, QUIET, SETTINGS, amplifier

from fitctl.mocks.mdt693.amplifier import Amplifier


@in_a_loop
async def test_the_output_is_knob_set_point_scan_and_external_input_within_the_limits():
    async with amplifier(B_110, QUIET, knobs_v=[0.0, 1.0, 0.0]) as (mock, terminal, outputs):
        assert outputs == [[0, 1, 0]]
        mock.set_external_input_v([1.0, 5.0, 10.0])
        assert outputs[-1] == [15, 76, 150]
        await terminal.transcript((b"xvoltage=2\r", b">"))
        assert outputs[-1] == [17, 76, 150]
        await terminal.transcript((b"allvoltage=2\r", b">"))
        assert outputs[-1] == [17, 78, 150.5]
        await terminal.transcript((b"msvoltage=3\r", b">"))
        assert outputs[-1] == [17, 78, 150.5]
        await terminal.transcript((b"msenable=1\r", b">"))
        assert outputs[-1] == [20, 81, 150.5]
        await terminal.transcript((b"ymax=50\r", b">"), (b"xmin=30\r", b">"))
        assert outputs[-1] == [30, 50, 150.5]
        await terminal.transcript((b"sysmin=40\r", b">"), (b"sysmax=100\r", b">"))
        assert outputs[-1] == [40, 50, 100]
        await terminal.transcript((b"restore\r", b">"))
        assert outputs[-1] == [15, 76, 150]
        seen = len(outputs)
        mock.set_external_input_v([1.0, 5.0, 10.0])
        assert len(outputs) == seen


@pytest.mark.parametrize(("switch_v", "highest_v"), [(75, 75.5), (100, 100.5), (150, 150.0)])
def test_the_limit_switch_clips_whatever_else_is_set(switch_v, highest_v):
    async def scene():
        async with amplifier(B_110, QUIET) as (mock, terminal, outputs):
            await terminal.transcript((b"xmin=110\r", b">"))
            mock.set_external_input_v([10.0, 10.0, 10.0])
            mock.amplifier.set_switch_v(switch_v)
            assert outputs[-1] == [highest_v] * 3

    asyncio.run(scene())


@in_a_loop
async def test_a_value_beyond_the_limits_is_refused_and_changes_nothing():
    async with amplifier(B_110, QUIET, limit_switch_v=100) as (_, terminal, outputs):
        await terminal.transcript(
            (b"xvoltage=100.6\r", b"CMD_NOT_DEFINED>"),
            (b"xyzvoltage=1,2,101\r", b"CMD_NOT_DEFINED>"),
            (b"xmax=101\r", b"CMD_NOT_DEFINED>"),
            (b"sysmax=101\r", b"CMD_NOT_DEFINED>"),
            (b"xmin=-1\r", b"CMD_NOT_DEFINED>"),
            (b"sysmin=101\r", b"CMD_NOT_DEFINED>"),
            (b"msvoltage=101\r", b"CMD_NOT_DEFINED>"),
            (b"xmax=50\r", b">"),
            (b"xmin=51\r", b"CMD_NOT_DEFINED>"),
            (b"xvoltage=51\r", b"CMD_NOT_DEFINED>"),
        )
        assert outputs == [[0, 0, 0]]


@in_a_loop
async def test_limits_read_as_they_act():
    async with amplifier(B_110, QUIET, limit_switch_v=100) as (_, terminal, _):
        await terminal.transcript(
            (b"zmax?\r", b"100.50\r>"),
            (b"sysmax=90\r", b">"),
            (b"zmax?\r", b"90.00\r>"),
            (b"sysmax?\r", b"90.00\r>"),
            (b"sysmin=10\r", b">"),
            (b"zmin?\r", b"10.00\r>"),
            (b"sysmin?\r", b"10.00\r>"),
        )


@in_a_loop
async def test_the_commands_of_the_693a():
    async with amplifier(A_301, QUIET) as (_, terminal, outputs):
        await terminal.transcript((b"AV15\r", b"*"), (b"xv10.5\r", b"*"))
        assert outputs[-1] == [10.5, 15, 15]
        await terminal.transcript((b"XH100\r", b"*"), (b"XH?\r", b"*100"), (b"XV101\r", b"!"))
        await terminal.transcript((b"YL20\r", b"*"), (b"YL?\r", b"*20"), (b"D\r", b"*MDT693A\r"))
        assert outputs[-1] == [10.5, 20, 15]


@in_a_loop
async def test_the_693b_takes_the_commands_of_the_693a_too():
    async with amplifier(B_110, QUIET) as (_, terminal, outputs):
        await terminal.transcript(
            (b"AV15\r", b">"),
            (b"XV10\r", b">"),
            (b"XR?\r", b"[ 10.00]\r>"),
            (b"XH100\r", b">"),
            (b"XL5\r", b">"),
            (b"XH?\r", b"100.00\r>"),
            (b"XL?\r", b"5.00\r>"),
            (b"%\r", b"[ 150]\r>"),
            (b"D\r", b"MDT693B\r>"),
            (b"E\r", b"[Echo On]\r>"),
        )
        assert outputs[-1] == [10, 15, 15]


@in_a_loop
async def test_what_is_only_kept_is_kept_within_its_range():
    async with amplifier(B_110, QUIET) as (_, terminal, _):
        for name, default, highest in (
            (b"intensity", b"15", b"15"),
            (b"msenable", b"0", b"1"),
            (b"dacstep", b"1", b"5000"),
            (b"rotarymode", b"0", b"2"),
            (b"pushdisable", b"0", b"1"),
        ):
            beyond = str(int(highest) + 1).encode()
            await terminal.transcript(
                (name + b"?\r", default + b"\r>"),
                (name + b"=" + highest + b"\r", b">"),
                (name + b"=" + beyond + b"\r", b"CMD_NOT_DEFINED>"),
                (name.upper() + b"?\r", highest + b"\r>"),
            )
        await terminal.transcript(
            (b"friendly?\r", b"MDT693B\r>"),
            (b"friendly=Left Piezo\r", b">"),
            (b"friendly?\r", b"Left Piezo\r>"),
            (b"serial?\r", b"000000-00\r>"),
            (b"restore\r", b">"),
            (b"friendly?\r", b"MDT693B\r>"),
            (b"dacstep?\r", b"1\r>"),
            (b"voltage?\r", b"CMD_NOT_DEFINED>"),
        )


@in_a_loop
async def test_echo_and_its_switch():
    async with amplifier(B_110) as (_, terminal, _):
        await terminal.transcript(
            (b"echo?\r", b"echo?\r[Echo On]\r>"),
            (b"Echo=0\r", b"Echo=0\r>"),
            (b"echo?\r", b"[Echo Off]\r>"),
            (b"E1\r", b"[Echo On]\r>"),
            (b"e\r", b"e\r[Echo Off]\r>"),
        )


@in_a_loop
async def test_arrow_keys_choose_a_channel_and_move_it_with_and_without_cr():
    up, down, right, left = b"\x1b[A", b"\x1b[B", b"\x1b[C", b"\x1b[D"
    async with amplifier(B_110, QUIET) as (_, terminal, outputs):
        await terminal.transcript((b"dacstep=1000\r", b">"), (up + b"\r", b">"), (right, b">"))
        await terminal.transcript((up, b">"), (up + b"\r\n", b">"), (left, b">"), (down, b">"))
        step_v = 150 / 65536 * 1000
        assert outputs[-1] == pytest.approx([0, 2 * step_v, 0])
        await terminal.transcript((down, b">"), (b"\r", b""), (b"\r", b"CMD_NOT_DEFINED>"))
        assert outputs[-1] == pytest.approx([0, 2 * step_v, 0])


@in_a_loop
async def test_help_names_only_what_the_device_takes():
    async with amplifier(B_110, push_command="disablepush") as (_, terminal, _):
        terminal.writer.write(b"?\r")
        text = (await terminal.reader.readuntil(b"\r>")).decode()
        commands = [line.split("\t")[0] for line in text.split("\r")[1:-1]]
        assert commands[0] == "?"
        assert "DISABLEPUSH?" in commands
        values = {"XYZVOLTAGE=": "1,2,3", "SYSMAX=": "20", "CM=": "0"} | {
            f"{axis}MAX=": "20" for axis in "XYZ"
        }
        for command in commands:
            if command.endswith("Arrow"):
                continue
            value = values.get(command, "1") if command.endswith("=") else ""
            terminal.writer.write(f"{command}{value}\r".encode())
            answer = await asyncio.wait_for(terminal.reader.readuntil(b">"), 5)
            assert b"CMD_NOT_DEFINED" not in answer, command


def test_measured_voltages_settle_and_have_offset_and_noise():
    now_s = itertools.count(0.0, 0.1)
    settings = SETTINGS.model_copy(
        update=EXACT | {"readback_settling_s": 0.1, "readback_offset_v": 0.5}
    )
    amplifier = Amplifier(settings, 15.0, lambda volts: None, lambda: next(now_s))
    amplifier.set_external_input_v([4.0, 0.0, 0.0])
    assert amplifier.measured_v(0) == pytest.approx(60 * (1 - 0.3679) + 0.5, abs=0.01)
    assert amplifier.measured_v(0) == pytest.approx(60 * (1 - 0.1353) + 0.5, abs=0.01)
    noisy = Amplifier(
        settings.model_copy(update={"readback_noise_v": 0.2, "readback_settling_s": 0.0}),
        15.0,
        lambda volts: None,
        lambda: 0.0,
    )
    noisy.set_external_input_v([4.0, 0.0, 0.0])
    read = [noisy.measured_v(0) - 60.5 for _ in range(500)]
    assert (sum(error**2 for error in read) / 500) ** 0.5 == pytest.approx(0.2, rel=0.2)
