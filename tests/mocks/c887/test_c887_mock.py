"""The mock hexapod controller as a client of its wire sees it."""

import asyncio
import functools
import math
import os
import termios

import hypothesis
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instruments.c887_settings import MOCK

from fitctl.config import Fault
from fitctl.drivers.c887 import protocol
from fitctl.drivers.c887.protocol import AXES, GcsError
from fitctl.mocks.c887.controller import COMMAND_BYTES_MAX, Controller
from fitctl.mocks.c887.platform import Platform
from fitctl.mocks.c887.server import C887ControllerMock, CommandSplitter

ZEROS = b"X=0.0000000 \nY=0.0000000 \nZ=0.0000000 \nU=0.0000000 \nV=0.0000000 \nW=0.0000000\n"
ALL_0, ALL_1 = (
    b" \n".join(b"%s=%d" % (axis.encode(), flag) for axis in AXES) + b"\n" for flag in (0, 1)
)


def spoken(test=None, **update):
    """Run a test with a connection to a mock: ``say(command)`` gives the whole answer."""

    def decorate(test):
        @functools.wraps(test)
        def run():
            asyncio.run(serve(test))

        del run.__wrapped__  # pytest would take its arguments for fixtures
        return run

    async def serve(test):
        mock = C887ControllerMock(MOCK.model_copy(update=update))
        mock.ends = await mock.start()
        reader, writer = await asyncio.open_connection("127.0.0.1", mock.ends.tcp_port)

        async def say(command):
            writer.write(command)
            answer = b""
            while not protocol.is_complete(answer):
                answer += await asyncio.wait_for(reader.read(4096), 2)
            return answer

        try:
            await test(mock, say, writer)
        finally:
            writer.close()
            await mock.stop()
            await mock.stop()
        await asyncio.sleep(0)
        assert len(asyncio.all_tasks()) == 1

    return decorate(test) if test else decorate


async def at_rest(say):
    while await say(b"\x05") != b"0\n":
        await asyncio.sleep(0.01)


# ---------------------------------------------------------------- transcripts


@spoken
async def test_who_it_is(mock, say, writer):
    maker = b"(c)2013 Physik Instrumente (PI) Karlsruhe"
    assert await say(b"*IDN?\n") == maker + b", C-887, 117040000, 2.3.0.1\n"
    assert await say(b"CSV?\n") == b"2.0\n"
    assert await say(b"SAI?\n") == await say(b"SAI? ALL\n") == b"X \nY \nZ \nU \nV \nW\n"
    assert await say(b"CST? X W\n") == b"X=M-850.H11 \nW=M-850.H11\n"
    assert await say(b"PUN? Z U\n") == b"Z=mm \nU=deg\n"
    assert await say(b"SPA? X 0x3C\n") == b"X 0x3C=M-850.H11\n"
    assert (await say(b"VER?\n")).startswith(b"FW_DSP: V2.3.0.1 \n")


@spoken
async def test_the_state_in_which_it_waits(mock, say, writer):
    assert await say(b"POS?\n") == await say(b"\x03") == ZEROS
    assert await say(b"\x05") == b"0\n"
    assert await say(b"\x07") == b"\xb1\n"
    assert await say(b"\x08") == await say(b"\x09") == b"0\n"
    assert await say(b"FRF?\n") == await say(b"SVO?\n") == await say(b"ONT?\n") == ALL_1
    assert await say(b"TMN? X Z\n") == b"X=-50.0000000 \nZ=-25.0000000\n"
    assert await say(b"TMX? W\n") == b"W=30.0000000\n"
    assert await say(b"VLS?\n") == b"8.0000000\n"
    assert await say(b"SPI?\n") == b"R=0.0000000 \nS=0.0000000 \nT=0.0000000\n"
    assert await say(b"ERR?\n") == b"0\n"


@spoken
async def test_a_move(mock, say, writer):
    writer.write(b"VLS 4\nMOV X 0.4 W -0.2\n")
    assert await say(b"\x05") == b"21\n", "the first axis and the sixth"
    assert await say(b"MOV? X Y W\n") == b"X=0.4000000 \nY=0.0000000 \nW=-0.2000000\n"
    assert await say(b"ONT? X Y\n") == b"X=0 \nY=1\n"
    await at_rest(say)
    assert await say(b"POS? X W\n") == b"X=0.4000000 \nW=-0.2000000\n"
    writer.write(b"MVR X 0.1 X 0.1\n")
    assert await say(b"ERR?\n") == b"22\n"
    writer.write(b"mvr x 0.1\n")
    await at_rest(say)
    assert await say(b"POS? X\n") == b"X=0.5000000\n"
    assert await say(b"\x06") == b"0\n"
    writer.write(b"MOV Y 0.1\n")
    await at_rest(say)
    assert await say(b"\x06") == b"2\n"


@spoken(referenced=False)
async def test_referencing_takes_its_time(mock, say, writer):
    assert await say(b"FRF?\n") == ALL_0
    writer.write(b"MOV X 1\n")
    assert await say(b"ERR?\n") == b"5\n"
    started_s = asyncio.get_running_loop().time()
    writer.write(b"FRF X\n")
    assert await say(b"\x07") == b"\xb0\n"
    assert await say(b"\x05") == b"3f\n"
    writer.write(b"MOV X 1\n")
    assert await say(b"ERR?\n") == b"5\n"
    assert await say(b"FRF? X\n") == b"X=0\n"
    while await say(b"\x07") != b"\xb1\n":
        pass
    assert asyncio.get_running_loop().time() - started_s >= MOCK.reference_s
    assert await say(b"FRF?\n") == ALL_1
    assert await say(b"ERR?\n") == b"0\n"


ERRORS = {
    b"MOV X 50.1": 7,
    b"MOV X 36 Y 36": 7,  # each within its travel, but not both
    b"MOV Q 1": 15,
    b"MOV X one": 1,
    b"MOV X nan": 1,
    b"MOV X": 24,
    b"MOV": 24,
    b"POS? Q": 15,
    b"VLS 0": 8,
    b"VLS 8.1": 8,
    b"VLS 1 2": 24,
    b"SVO X 2": 1,
    b"SVO X 1 Y 0": 1,
    b"SPI Q 1": 15,
    b"SPA? X 0x70": 54,
    b"SPA? X word": 1,
    b"NLM X -60": 17,
    b"SAI? SOME": 1,
    b"*IDN? X": 24,
    b"CSV? X": 24,
    b"JMP": 2,
    b"\x01": 2,
    b"X" * (COMMAND_BYTES_MAX + 1): 3,
}


@pytest.mark.parametrize("command", ERRORS, ids=lambda command: repr(command[:20]))
def test_what_it_does_not_do_it_reports_once(command):
    platform = Platform(MOCK, lambda: 0.0)
    controller = Controller(MOCK, platform)
    assert controller.answer(command) is None
    assert controller.answer(b"ERR?") == b"%d\n" % ERRORS[command]
    assert controller.answer(b"ERR?") == b"0\n"
    assert not any(platform.moving().values())
    assert platform.velocity_mm_s == 8.0


@spoken
async def test_what_is_allowed_at_rest_only(mock, say, writer):
    writer.write(b"MOV U 2\n")
    for command in (b"VLS 1\n", b"SPI R 1\n", b"NLM X -5\n", b"PLM X 5\n", b"SSL X 0\n"):
        writer.write(command)
        assert await say(b"ERR?\n") == b"93\n"
    await at_rest(say)
    writer.write(b"SPI R 1\n")
    assert await say(b"ERR?\n") == b"9\n", "the platform is rotated"
    writer.write(b"MOV U 0\n")
    await at_rest(say)
    writer.write(b"SPI X 1.5\n")
    assert await say(b"SPI? R X\n") == b"R=1.5000000 \nX=1.5000000\n"


@spoken
async def test_soft_limits_keep_a_move_from_beginning(mock, say, writer):
    writer.write(b"PLM X 1\nMOV X 1.1\n")
    assert await say(b"ERR?\n") == b"7\n"
    assert await say(b"VMO? X 1.1\n") == b"0\n"
    writer.write(b"SSL X 0\n")
    assert await say(b"VMO? X 1.1\n") == b"1\n"
    assert await say(b"PLM? X\n") == b"X=1.0000000\n"
    assert await say(b"SSL? X Y\n") == b"X=0 \nY=1\n"


def test_a_pose_far_out_on_one_axis_leaves_the_others_little():
    controller = Controller(MOCK, Platform(MOCK, lambda: 0.0))
    for x in (0.0, 30.0, 40.0, 49.0):
        least, most = 0.0, 50.0
        for _ in range(30):
            y = (least + most) / 2
            can = controller.answer(f"VMO? X {x} Y {y}".encode()) == b"1\n"
            least, most = (y, most) if can else (least, y)
        assert least == pytest.approx(math.sqrt(50.0**2 - x**2), abs=1e-4)


@pytest.mark.parametrize("stop", [b"\x18", b"STP\n", b"HLT\n", b"HLT X\n"])
def test_a_stop_ends_every_motion_and_leaves_error_10(stop):
    @spoken
    async def talk(mock, say, writer):
        writer.write(b"MOV X 20\n")
        await say(b"\x05")
        await asyncio.sleep(0.2)
        writer.write(stop)
        assert await say(b"ERR?\n") == b"10\n"
        await asyncio.sleep(0.1)
        assert await say(b"\x05") == b"0\n"
        x = protocol.parse_numbers(await say(b"POS? X\n"), ["X"])[0]
        assert 0.5 < x < 4
        assert protocol.parse_numbers(await say(b"MOV? X\n"), ["X"])[0] == pytest.approx(x)

    talk()


@spoken
async def test_a_stop_is_heard_within_half_a_line(mock, say, writer):
    writer.write(b"MOV X 20\nPOS\x18? Y\n")
    assert await say(b"") == b"Y=0.0000000\n"
    assert await say(b"ERR?\n") == b"10\n"
    await asyncio.sleep(0.02)
    assert await say(b"\x05\n") == b"0\n", "a line end after a control character is nothing"


@spoken
async def test_without_servo_it_does_not_move(mock, say, writer):
    writer.write(b"MOV X 5\nSVO X 0\nMOV X 1\n")
    assert await say(b"ERR?\n") == b"5\n"
    assert await say(b"SVO?\n") == ALL_0
    assert await say(b"ONT?\n") == ALL_0
    writer.write(b"FRF\n")
    assert await say(b"ERR?\n") == b"5\n"
    writer.write(b"SVO X 1 Y 1 Z 1 U 1 V 1 W 1\nMOV X 0\n")
    assert await say(b"ERR?\n") == b"0\n"


@spoken
async def test_all_clients_share_the_platform_and_the_error_number(mock, say, writer):
    other_reader, other = await asyncio.open_connection("127.0.0.1", mock.ends.tcp_port)
    other.write(b"MOV X 2\nMOV X 99\n\x05")
    assert await other_reader.readline() == b"1\n"
    assert await say(b"ERR?\n") == b"7\n"
    other.close()
    await at_rest(say)
    assert await say(b"POS? X\n") == b"X=2.0000000\n", "a client that leaves stops nothing"


@spoken
async def test_the_pty_is_a_serial_port_at_its_baud_rate(mock, say, writer):
    port = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NONBLOCK)
    try:
        os.write(port, b"CSV?\n")
        await asyncio.sleep(0.05)
        assert os.read(port, 100) == b"2.0\n"
        mode = termios.tcgetattr(port)
        mode[4] = mode[5] = termios.B9600
        termios.tcsetattr(port, termios.TCSANOW, mode)
        os.write(port, b"CSV?\n")
        await asyncio.sleep(0.05)
        with pytest.raises(BlockingIOError):
            os.read(port, 100)
    finally:
        os.close(port)


@spoken
async def test_the_plant_gets_the_true_pose_of_the_recent_past(mock, say, writer):
    loop = asyncio.get_running_loop()
    writer.write(b"MOV X 8 V 1\n")
    await say(b"\x05")
    poses = []
    for _ in range(20):
        await asyncio.sleep(0.01)
        writer.write(b"MOV X %f\n" % (8 + len(poses) / 100))
        now_s = loop.time()
        poses.append((now_s, mock.pose_at(now_s)))
    assert poses[-1][1][0] > 0.5
    for time_s, pose in poses:
        assert np.allclose(mock.pose_at(time_s), pose, atol=1e-9)


# ---------------------------------------------------------------- faults


@spoken
async def test_after_a_loss_of_power_it_stands_where_it_was_and_does_not_know_it(mock, say, writer):
    writer.write(b"MOV X 1\n")
    await at_rest(say)
    mock.faults.set(Fault(device="hexapod", kind="reboot", value=0.05))
    await asyncio.sleep(0.1)
    reader, again = await asyncio.open_connection("127.0.0.1", mock.ends.tcp_port)
    again.write(b"FRF? X\nPOS? X\n")
    assert await reader.readline() == b"X=0\n"
    assert await reader.readline() == b"X=0.0000000\n"
    assert mock.pose_at(asyncio.get_running_loop().time())[0] == pytest.approx(1.0)
    again.close()


FAULTS = {
    "moves_stopped": (b"MOV X 5\n", 10),
    "servo_off": (b"MOV X 5\n", 5),
    "motion_error": (b"", 1024),
    "emergency_stop": (b"MOV X 5\n", 500),
    "reference_lost": (b"MOV X 5\n", 5),
    "false_error": (b"", 1024),
}


@pytest.mark.parametrize("kind", FAULTS)
def test_a_fault_shows_as_its_error_number_and_nothing_moves(kind):
    command, number = FAULTS[kind]

    @spoken
    async def talk(mock, say, writer):
        mock.faults.set(Fault(device="hexapod", kind=kind))
        writer.write(command)
        assert await say(b"ERR?\n") == b"%d\n" % number
        await asyncio.sleep(0.05)
        assert await say(b"\x05") == b"0\n"
        mock.faults.clear()
        writer.write(b"SVO X 1\nFRF\n")
        await at_rest(say)
        await say(b"ERR?\n")
        writer.write(b"MOV X 0.1\n")
        assert await say(b"ERR?\n") == b"0\n", "and afterwards all is well again"

    talk()


@spoken
async def test_servos_stay_off_while_the_emergency_stop_is_pressed(mock, say, writer):
    mock.faults.set(Fault(device="hexapod", kind="emergency_stop"))
    await say(b"ERR?\n")
    for command in (b"SVO X 1\n", b"FRF\n"):
        writer.write(command)
        assert await say(b"ERR?\n") == b"500\n"
    assert await say(b"SVO? X\n") == b"X=0\n"


@spoken
async def test_a_stuck_platform_takes_moves_and_stays(mock, say, writer):
    mock.faults.set(Fault(device="hexapod", kind="stuck"))
    writer.write(b"MOV X 5\n")
    assert await say(b"ERR?\n") == b"0\n"
    await asyncio.sleep(0.2)
    assert await say(b"POS? X\n") == b"X=0.0000000\n"


@spoken
async def test_with_x_and_y_exchanged_the_platform_goes_the_wrong_way(mock, say, writer):
    mock.faults.set(Fault(device="hexapod", kind="wrong_axis"))
    writer.write(b"MOV X 0.2\n")
    await at_rest(say)
    assert await say(b"POS? X Y\n") == b"X=0.0000000 \nY=0.2000000\n"


@spoken
async def test_an_offset_is_in_what_it_reports_alone(mock, say, writer):
    mock.faults.set(Fault(device="hexapod", kind="position_offset", value=0.5))
    assert await say(b"POS? X\n") == b"X=0.5000000\n"
    assert (await say(b"\x03")).startswith(b"X=0.5000000 \n")
    assert not mock.pose_at(asyncio.get_running_loop().time()).any()
    mock.faults.clear()
    assert await say(b"POS? X\n") == b"X=0.0000000\n"


@spoken
async def test_when_silent_it_obeys(mock, say, writer):
    mock.faults.set(Fault(device="hexapod", kind="silent"))
    writer.write(b"MOV X 0.1\nPOS?\n")
    with pytest.raises(asyncio.TimeoutError):
        await asyncio.wait_for(say(b"ERR?\n"), 0.2)
    mock.faults.clear()
    await at_rest(say)
    assert await say(b"POS? X\n") == b"X=0.1000000\n"


# ---------------------------------------------------------------- any bytes


@given(data=st.binary(max_size=300), cuts=st.lists(st.integers(0, 300), max_size=5))
def test_commands_are_the_same_however_the_bytes_arrive(data, cuts):
    whole = CommandSplitter().feed(data)
    splitter, pieces, start = CommandSplitter(), [], 0
    for end in [*sorted(cuts), len(data)]:
        pieces += splitter.feed(data[start:end])
        start = max(start, end)
    assert pieces == whole


words = st.one_of(
    st.sampled_from([*AXES, "R", "Q", "0", "1", "0x3C", "nan", "inf", "-1e400", "ALL", "1.5"]),
    st.floats(-60, 60).map(str),
    st.text(max_size=4),
)
MOVES = ["MOV", "MVR", "SVO", "VLS", "SPI", "FRF", "HLT", "STP", "NLM", "PLM", "SSL"]
QUESTIONS = ["POS?", "VMO?", "SPA?", "SPI?", "SAI?", "ERR?", "HLP?", "HPA?"]
names = st.sampled_from(MOVES + QUESTIONS)


@pytest.mark.long
@hypothesis.settings(max_examples=300)
@given(st.lists(st.tuples(names, st.lists(words, max_size=6)), max_size=8))
def test_any_words_leave_it_within_its_travel_and_its_answers_readable(lines):
    now = [0.0]
    platform = Platform(MOCK, lambda: now[0])
    controller = Controller(MOCK, platform)
    for name, arguments in lines:
        answer = controller.answer(" ".join([name, *arguments]).encode("latin-1", "replace"))
        if answer is not None:
            assert protocol.is_complete(answer)
            protocol.lines_of(answer)
        now[0] += 0.7
        pose = platform.true_pose_at(now[0])
        assert all(
            low - 1e-9 <= value <= high + 1e-9
            for value, (low, high) in zip(pose, MOCK.travel.ends, strict=True)
        )
    assert protocol.parse_error(controller.answer(b"ERR?")) in set(GcsError)
