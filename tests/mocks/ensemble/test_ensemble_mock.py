"""The mock controller as a client of its wire sees it."""

import asyncio
import functools
import math
import os

import pytest
from hypothesis import given
from hypothesis import strategies as st
from instruments.ensemble_axis import parameters
from instruments.mock_bench import SimulatedMotors, ToldMotors

from fitctl import config
from fitctl.drivers.ensemble.protocol import (
    AxisFault,
    AxisStatus,
    Parameter,
    Reply,
)
from fitctl.mocks.ensemble.axis import Axis
from fitctl.mocks.ensemble.commands import Interpreter, words_of
from fitctl.mocks.ensemble.controller import EnsembleControllerMock, LineSplitter

RIG = config.load_rig(config.default_rig_path().parent / "ensemble.toml")
SIDEROSTAT = RIG.loops["right"].siderostat
SETTINGS = RIG.mocks.loops["right"].ensemble.model_copy(update={"tcp_port": 0})
PERIOD_S = 0.002
AT_REST = 0x01C00002
"""AXISSTATUS of a homed axis without power that has not moved: three unconnected inputs read high."""


def spoken(test=None, *, motors=ToldMotors, **update):
    """Run a test with a connection to a mock: ``say(command)`` gives the whole answer."""

    def decorate(test):
        @functools.wraps(test)
        def run():
            asyncio.run(serve(test))

        del run.__wrapped__  # pytest would take its arguments for fixtures
        return run

    async def serve(test):
        settings = SETTINGS.model_copy(update=update)
        mock = EnsembleControllerMock(SIDEROSTAT, settings, motors())
        ends = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", ends.tcp_port)

        async def say(command):
            writer.write(command.encode("latin-1") + b"\n")
            return (await asyncio.wait_for(reader.readuntil(b"\n"), 5)).decode()

        try:
            await test(mock, say, reader, writer)
        finally:
            writer.close()
            await mock.stop()
            await mock.stop()
        await asyncio.sleep(0)
        assert len(asyncio.all_tasks()) == 1

    return decorate(test) if test else decorate


async def until(say, question, holds):
    """Ask until the number in the answer is as wanted."""
    end_s = asyncio.get_running_loop().time() + 5
    while not holds(float((await say(question))[1:])):
        assert asyncio.get_running_loop().time() < end_s


# ---------------------------------------------------------------- transcripts


@spoken
async def test_what_epics_motor_asks_at_start(mock, say, *_):
    assert await say("NONE") == "!\n"
    assert await say("GETPARM(@0, 140)") == "%X\n"
    assert await say("GETPARM(@1, 99)") == "%Y\n"
    assert (await say("GETPARM(@2, 140)"))[0] == "!"
    assert await say("GETPARM(@0, 47)") == "%1.000000\n"
    assert await say("GETPARM(@0, 2)") == "%4000.000000\n"
    for number in (77, 75, 61, 1):
        assert await say(f"GETPARM(@0, {number})") == "%0.000000\n"
    assert await say("RAMP MODE @0 RATE") == "%\n"


@spoken
async def test_what_epics_motor_polls(mock, say, *_):
    assert await say("AXISSTATUS(@0)") == f"%{AT_REST}\n"
    assert await say("PLANESTATUS(0)") == "%0\n"
    assert await say("PFBKPROG(@0)") == "%0.000000\n"
    assert await say("PCMDPROG(@0)") == "%0.000000\n"
    assert await say("AXISFAULT(@0)") == "%0\n"
    assert await say("VFBK(@0)") == "%0.000000\n"


@spoken
async def test_epics_motor_reads_no_active_limit(mock, say, *_):
    """As drvEnsembleAsyn.cc combines the status bits with parameter 61."""
    setup = float((await say("GETPARM(@0, 61)"))[1:])
    for switch_on in (False, True):
        status = int((await say("AXISSTATUS(@0)"))[1:])
        cw, ccw = (status >> 22 & 1), (status >> 23 & 1)
        assert not 1 ^ cw ^ (int(setup) >> 2 & 1)
        assert not 1 ^ ccw ^ (int(setup) >> 1 & 1)
        assert switch_on or await say("ENABLE @0") == "%\n"


@spoken
async def test_what_epics_motor_says_to_enable_jog_and_move(mock, say, *_):
    assert await say("AXISFAULT @0") == "%0\n"
    assert await say("ENABLE @0") == "%\n"
    assert mock._motors._motors.enabled == [True, False]
    assert await say("WAIT MODE NOWAIT") == "%\n"
    assert await say("SETPARM @0, 73, 250.00000") == "%\n"
    assert await say("GETPARM(@0, 73)") == "%250.000000\n"
    assert await say("RAMP RATE @0 0.10000") == "%\n"
    assert await say("FREERUN @0 0.01000") == "%\n"
    assert int((await say("AXISSTATUS(@0)"))[1:]) & (AxisStatus.ENABLED | AxisStatus.MOVING) == 9
    assert await say("PLANESTATUS(0)") == "%0\n"
    assert await say("ABORT @0") == "%\n"
    assert await say("ABS") == "%\n"
    assert await say("RAMP RATE 0.10000") == "%\n"
    assert await say("LINEAR @0 0.10000 F0.01000") == "%\n"
    assert await say("DISABLE @0") == "%\n"
    assert await say("AXISSTATUS(@0)") == f"%{AT_REST | AxisStatus.CLOCKWISE}\n"


@spoken(motors=SimulatedMotors)
async def test_the_plane_moves_while_a_coordinated_move_runs(mock, say, *_):
    """epics-motor asks PLANESTATUS for each axis: during a LINEAR of one, all its records are moving."""
    await say("ENABLE @0")
    await say("ENABLE @1")
    assert await say("LINEAR @0 0.05000 F1.00000") == "%\n"
    assert await say("PLANESTATUS(0)") == "%1\n"
    await until(say, "PLANESTATUS(0)", lambda bits: bits == 0)
    assert await say("PCMDPROG(@0)") == "%0.050000\n"
    assert await say("FREERUN @1 0.01000") == "%\n"
    assert await say("PLANESTATUS(0)") == "%0\n", "another axis' free run is not the plane's motion"
    assert not int((await say("AXISSTATUS(@0)"))[1:]) & AxisStatus.MOVING
    assert int((await say("AXISSTATUS(@1)"))[1:]) & AxisStatus.MOVING
    assert await say("MOVEABS X 0.06 XF 0.1") == "%\n"
    assert await say("PLANESTATUS(0)") == "%0\n"
    assert int((await say("AXISSTATUS(@0)"))[1:]) & AxisStatus.MOVING


@spoken(motors=SimulatedMotors)
async def test_what_epics_motor_says_to_home(mock, say, *_):
    assert await say("ENABLE @0") == "%\n"
    assert await say("LINEAR @0 0.10000 F5.00000") == "%\n"
    await until(say, "PLANESTATUS(0)", lambda bits: bits == 0)
    assert await say("SETPARM @0, 76, 0.50000") == "%\n"
    assert await say("SETPARM @0, 75, 0") == "%\n"
    assert await say("IGLOBAL(32) = 1") == "%\n"
    assert await say("IGLOBAL(33) = 0") == "%\n"
    assert await say("IGLOBAL(32)") == "%1\n"
    assert await say('PROGRAM RUN 5, "HomeAsync.bcx"') == "%\n"
    homing = AxisStatus.HOMING | AxisStatus.MOVING
    assert int((await say("AXISSTATUS(@0)"))[1:]) & (homing | AxisStatus.HOMED) == homing
    await until(say, "AXISSTATUS(@0)", lambda bits: not int(bits) & homing)
    assert int((await say("AXISSTATUS(@0)"))[1:]) & AxisStatus.HOMED
    assert await say("PCMDPROG(@0)") == "%0.000000\n"
    # The command rests; the motor still follows, further behind if the machine stood still.
    await until(say, "PFBKPROG(@0)", lambda place: abs(place) < 1e-3)
    assert await say("AXISFAULT(@0)") == "%0\n"


@spoken(motors=SimulatedMotors)
async def test_what_epics_motor_says_to_set_a_position(mock, say, *_):
    await say("ENABLE @0")
    assert await say("POSOFFSET SET @0, 1.50000") == "%\n"
    assert await say("PFBKPROG(@0)") == "%1.500000\n"
    assert await say("PCMDPROG(@0)") == "%1.500000\n"
    assert await say("PFBK(@0)") == "%0.000000\n", "nothing moved"
    assert await say("ABS") == "%\n"
    assert await say("LINEAR @0 1.55000 F5.00000") == "%\n"
    await until(say, "PLANESTATUS(0)", lambda bits: bits == 0)
    assert await say("PCMDPROG(@0)") == "%1.550000\n"
    await until(say, "PFBK(@0)", lambda place: abs(place - 0.05) < 1e-3)
    assert await say("POSOFFSET SET X 0 Y 2") == "%\n"
    assert await say("PCMDPROG(@1)") == "%2.000000\n"
    assert await say("POSOFFSET CLEAR @0") == "%\n"
    assert await say("PCMDPROG(@0)") == "%0.050000\n"


@spoken(position_error_units=5.0)
async def test_epics_motors_records_of_errors(mock, say, *_):
    assert await say("perr(0)") == "%0.000000\n"
    assert await say("verr(@0)") == "%0.000000\n"
    await say("ENABLE @0")
    await say("FREERUN @0 1.0")  # a motor that does not turn
    await until(say, "perr(0)", lambda error: error > 0.01)
    await until(say, "verr(0)", lambda error: error == pytest.approx(1.0))


@spoken
async def test_what_other_public_clients_say(mock, say, *_):
    assert await say("enable X") == "%\n"
    assert await say("ENABLE Y") == "%\n"
    assert await say("MOVEABS X0.100000 XF0.01 Y0.200000 YF0.01") == "%\n"
    assert await say("MOVEINC X 0 XF 0.02") == "%\n"
    assert await say("MOVEABS X 0.1") == "%\n"
    assert await say("PFBK X") == "%0.000000\n"
    assert await say("ACKNOWLEDGEALL") == "%\n"
    assert await say("FREERUN X 0.01 Y -0.01") == "%\n"
    assert await say("HOME X") == "!\n"


@pytest.mark.parametrize(
    "line",
    [
        "ENABLE",
        "ENABLE Z",
        "FREERUN @0",
        "FREERUN @0 fast",
        "FREERUN @0 1 2",
        "FREERUN 1",
        "LINEAR F2",
        "LINEAR @0 1 G2",
        "RAMP MODE TIME",
        "RAMP",
        "WAIT MODE",
        "AXISSTATUS",
        "AXISSTATUS(@0, @1)",
        "GETPARM(@0)",
        "GETPARM(@0, 9999)",
        "GETPARM(@0, 2, 3)",
        "SETPARM @0, 73",
        "PLANESTATUS(1)",
        "ABS 1",
        "ENABLE @0; DISABLE @0",
        "IGLOBAL",
        "IGLOBAL(32) = ",
        "IGLOBAL(32) 1",
        "IGLOBAL(32) = 1.5",
        "POSOFFSET @0, 1",
        "POSOFFSET SET @0",
        "POSOFFSET SET @2, 1",
        "PROGRAM RUN 5",
        "PERR(2)",
        "\x80",
    ],
)
def test_what_is_no_command_is_not_understood(line):
    assert interpreter().answer(line) == (Reply.NOT_UNDERSTOOD, "")


@spoken
async def test_what_cannot_be_done_now_is_a_fault(mock, say, *_):
    assert await say("FREERUN @0 1.0") == "#\n"
    assert await say("MOVEABS X 1") == "#\n"
    assert await say("RAMP RATE @0 0") == "#\n"
    assert await say("SETPARM @0, 32, -1") == "#\n"
    assert await say("IGLOBAL(50) = 1") == "#\n"
    assert await say("IGLOBAL(32) = 1") == "%\n"
    assert await say('PROGRAM RUN 5, "HomeAsync.bcx"') == "#\n", "no power"
    assert await say("ENABLE @0") == "%\n"
    assert await say('PROGRAM RUN 5, "Other.bcx"') == "#\n"
    assert await say("IGLOBAL(33) = 2") == "%\n"
    assert await say('PROGRAM RUN 5, "HomeAsync.bcx"') == "#\n", "no such axis"


@pytest.mark.parametrize(
    ("number", "taken", "refused"),
    [
        (1, "1 0", "-1 0.5"),
        (61, "6 0", "-1 0.5"),
        (75, "1 0", "-1 0.5"),
        (47, "2 0", "-1"),
        (2, "-4000.0 2000", "0"),
        (32, "0.5 0", "-1"),
        (72, "5.0", "0 -5"),
        (73, "250.0", "0 -5"),
        (37, "-3.0 0 3", ""),
        (38, "-3.0 0 3", ""),
        (76, "0.5", "0 -0.5"),
        (77, "-1.5 0 1.5", ""),
        (78, "0.5", "0 -0.5"),
    ],
)
def test_parameters_are_set_within_their_range(number, taken, refused):
    controller = interpreter(dict.fromkeys((1, 2, 47, 61, 75), 7.0))
    for value in taken.split():
        assert controller.answer(f"SETPARM @0, {number}, {value}") == (Reply.DONE, "")
        assert controller.answer(f"GETPARM(@0, {number})") == (Reply.DONE, f"{float(value):.6f}")
    for wrong in refused.split():
        assert controller.answer(f"SETPARM @0, {number}, {wrong}") == (Reply.FAULT, "")
        assert controller.answer(f"GETPARM(@0, {number})") == (Reply.DONE, f"{float(value):.6f}")


def test_a_position_error_threshold_of_zero_is_none():
    axis = Axis(parameters() | {Parameter.POSITION_ERROR_THRESHOLD: 0.0})
    axis.enable()
    axis.step(3.0, PERIOD_S)
    assert not axis.faults
    assert axis.status & AxisStatus.IN_POSITION


@spoken(always_send_eos=False)
async def test_without_always_send_eos_only_values_end_in_a_newline(mock, say, reader, writer):
    writer.write(b"ENABLE @0\nNONE\nAXISFAULT(@0)\n")
    assert await asyncio.wait_for(reader.readexactly(5), 5) == b"%!%0\n"


@spoken(reply_s=0.05)
async def test_answers_come_one_after_the_other_in_the_controllers_time(mock, say, reader, writer):
    loop = asyncio.get_running_loop()
    before_s = loop.time()
    writer.write(b"NONE\nAXISFAULT(@0)\nAXIS")
    writer.write(b"FAULT(@1)\n")
    assert await asyncio.wait_for(reader.readexactly(8), 5) == b"!\n%0\n%0\n"
    assert loop.time() - before_s >= 3 * 0.05


@spoken(idle_timeout_s=0.05)
async def test_a_connection_over_which_nothing_comes_is_closed(mock, say, reader, writer):
    assert await say("NONE") == "!\n"
    assert await asyncio.wait_for(reader.read(), 5) == b""


@spoken
async def test_a_line_without_end_is_not_kept(mock, say, reader, writer):
    writer.write(b"E" * 100_000)
    assert await say("") == "!\n"
    assert await say("AXISFAULT(@0)") == "%0\n"


@spoken
async def test_the_serial_port_speaks_the_same(mock, say, reader, writer):
    path = mock._pty.path
    end = os.open(path, os.O_RDWR | os.O_NOCTTY)
    try:
        os.write(end, b"AXISFAULT(@1)\n")
        answer = await asyncio.get_running_loop().run_in_executor(None, os.read, end, 100)
    finally:
        os.close(end)
    assert answer == b"%0\n"


# ---------------------------------------------------------------- faults


def set_fault(mock, kind, **settings):
    mock.faults.set(config.Fault(device="right.drive", kind=kind, **settings))


@spoken
async def test_an_amplifiers_fault_disables_and_comes_back_while_its_cause_is_there(mock, say, *_):
    await say("ENABLE @1")
    set_fault(mock, "amplifier_fault", part="el")
    assert await say("AXISFAULT(@1)") == f"%{AxisFault.AMPLIFIER}\n"
    assert await say("AXISFAULT(@0)") == "%0\n"
    assert await say("AXISSTATUS(@1)") == f"%{AT_REST}\n"
    assert await say("FAULTACK @1") == "%\n"
    assert await say("AXISFAULT(@1)") == f"%{AxisFault.AMPLIFIER}\n"
    assert await say("ENABLE @1") == "#\n"
    mock.faults.clear()
    assert await say("AXISFAULT(@1)") == f"%{AxisFault.AMPLIFIER}\n"
    assert await say("FAULTACK @1") == "%\n"
    assert await say("ENABLE @1") == "%\n"


@spoken
async def test_a_motor_that_does_not_follow_is_a_position_error(mock, say, *_):
    await say("ENABLE @0")
    await say("RAMP RATE @0 1000")
    await say("FREERUN @0 10")
    end_s = asyncio.get_running_loop().time() + 5
    while await say("AXISFAULT(@0)") != f"%{AxisFault.POSITION_ERROR}\n":
        assert asyncio.get_running_loop().time() < end_s
    assert await say("FREERUN @0 10") == "#\n"
    assert mock._motors._motors.enabled == [False, False]


@spoken
async def test_a_jumped_encoder_reads_that_much_more(mock, say, *_):
    set_fault(mock, "encoder_jump", part="az", value=400)
    assert await say("PFBK X") == "%0.100000\n"
    assert await say("PFBK Y") == "%0.000000\n"


@spoken
async def test_after_a_reboot_it_is_as_at_power_up(mock, say, reader, writer):
    await say("ENABLE @0")
    await say("SETPARM @0, 32, 3.0")
    set_fault(mock, "reboot", value=0.01)
    mock._motors._motors.angles_rad = (math.tau, 0.0)
    assert await asyncio.wait_for(reader.read(), 5) == b""
    while mock.faults.active:
        await asyncio.sleep(0.001)
    assert mock._motors._motors.enabled == [False, False]
    assert mock._answer("PFBK X") == b"%0.000000\n", "encoders start anew"
    assert mock._interpreter.answer("GETPARM(@0, 32)") == (Reply.DONE, "0.250000")


# ---------------------------------------------------------------- an axis, over the wire


def interpreter(update=None):
    tables = [parameters() | (update or {}), parameters()]
    return Interpreter([Axis(table) for table in tables], tables, ["X", "Y"])


@spoken(motors=SimulatedMotors, software_limit_units=0.05)
async def test_on_the_wire_both_limits_are_hit_acknowledged_and_left(mock, say, *_):
    """As epics-motor jogs, and powers an axis in fault."""
    for at, outward, fault in (
        ("@0", 1, AxisFault.CW_SOFTWARE_LIMIT),
        ("@1", -1, AxisFault.CCW_SOFTWARE_LIMIT),
    ):
        assert await say(f"ENABLE {at}") == "%\n"
        assert await say(f"FREERUN {at} {outward}.0") == "%\n"
        await until(say, f"AXISFAULT({at})", lambda word, fault=fault: word == fault)
        assert await say(f"FREERUN {at} {-outward}.0") == "#\n"
        assert await say(f"GETPARM({at}, 2)") == "%4000.000000\n"
        assert await say(f"AXISFAULT {at}") == f"%{fault:d}\n"
        assert await say(f"FAULTACK {at}") == "%\n"
        assert await say(f"ENABLE {at}") == "%\n"
        assert await say("WAIT MODE NOWAIT") == "%\n"
        await asyncio.sleep(5 * PERIOD_S)
        assert await say(f"AXISFAULT({at})") == "%0\n"
        # So slowly that a machine that stands still for 0.4 s does not see it at the other limit.
        assert await say(f"FREERUN {at} {-outward * 0.2}") == "%\n"
        await until(say, f"PFBKPROG({at})", lambda place, out=outward: place * out < 0.04)
        assert await say(f"ABORT {at}") == "%\n"
        assert await say(f"AXISFAULT({at})") == "%0\n"


@spoken(position_error_units=5.0)
async def test_the_velocity_feedback_of_a_stuck_motor_is_zero(mock, say, *_):
    await say("ENABLE @0")
    await say("FREERUN @0 1.0")
    await asyncio.sleep(0.1)
    assert await say("VFBK(@0)") == "%0.000000\n"
    assert mock.axes[0].velocity > 0


# ---------------------------------------------------------------- any bytes


@given(st.lists(st.binary(max_size=50), max_size=8))
def test_lines_do_not_depend_on_how_their_bytes_come(pieces):
    whole, parts = LineSplitter(), LineSplitter()
    lines = [line for piece in pieces for line in parts.feed(piece)]
    assert lines == whole.feed(b"".join(pieces))


@given(st.text(max_size=60))
def test_any_line_is_answered(line):
    reply, value = interpreter().answer(line)
    assert reply in Reply
    assert "\n" not in value


WORDS = ["FREERUN", "MOVEABS", "RAMP", "RATE", "GETPARM", "POSOFFSET", "SET", "IGLOBAL", "PROGRAM"]
WORDS += ["RUN", "PERR", "@0", "X", "YF", "F", "1.5", "-2E1", "2", "32", "="]


@given(st.lists(st.sampled_from(WORDS), max_size=6))
def test_any_order_of_known_words_is_answered(words):
    assert interpreter().answer(" ".join(words))[0] in Reply


def test_words_are_the_same_however_they_are_set_apart():
    assert words_of("getparm(@0, 2)") == words_of("GETPARM @0,2") == ["GETPARM", "@0", "2"]
    assert words_of("MOVEABS X1.5 XF10") == ["MOVEABS", "X", "1.5", "XF", "10"]
    assert words_of('PROGRAM RUN 5, "x"') == ["PROGRAM", "RUN", "5", '"X"']
    assert words_of("IGLOBAL(32) = 1") == words_of("IGLOBAL(32)=1") == ["IGLOBAL", "32", "=", "1"]
    assert words_of('PROGRAM RUN 5, "x') == []
