"""The C-887 driver: what it sends, what it makes of answers, and how it stops."""

import contextlib
import re
import select
import threading
import time
from types import SimpleNamespace

import pytest
from instruments.c887_settings import MOCK, device
from scripted_server import scripted_server
from serial.urlhandler import protocol_socket

from fitctl.commissioning.steps.ending import stopped_early
from fitctl.config import Fault
from fitctl.drivers.c887 import link
from fitctl.drivers.c887.driver import C887Hexapod, probe_c887
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
    Pose,
)
from fitctl.mocks.c887.server import C887ControllerMock

SIX = "X Y Z U V W"


def each(values):
    return " \n".join(f"{axis}={value}" for axis, value in zip(SIX.split(), values, strict=True))


WELL = {
    "ERR?": "0",
    "*IDN?": "(c)2013 Physik Instrumente (PI) Karlsruhe, C-887, 117040000, 2.3.0.1",
    "CSV?": "2.0",
    "SAI?": " \n".join(SIX.split()),
    "CST? X": "X=M-850.H11",
    f"TMN? {SIX}": each([-50, -50, -25, -15, -15, -30]),
    f"TMX? {SIX}": each([50, 50, 25, 15, 15, 30]),
    "VLS?": "8.0",
    "\x03": each([0.0] * 6),
    "\x05": "0",
    "\x07": "\xb1",
    f"FRF? {SIX}": each([1] * 6),
    f"SVO? {SIX}": each([1] * 6),
}
AT_OPEN = [
    "ERR?",
    "*IDN?",
    "CSV?",
    "SAI?",
    "CST? X",
    f"TMN? {SIX}",
    f"TMX? {SIX}",
    "VLS?",
]
MOVE = "MOV X 1.000000 Y 0.000000 Z 0.000000 U 0.000000 V 0.000000 W -0.500000"


class Script:
    """A controller that answers by a table, a list's items one after the other; the rest it does not answer."""

    def __init__(self, answers):
        self.answers = {**WELL, **answers}
        self.heard = []

    def talk(self, client):
        text = ""
        while data := client.recv(4096):
            text += data.decode("latin-1")
            *commands, text = re.split(r"\n|(?<=[\x03-\x09\x18])", text)
            for command in filter(None, commands):
                self.heard.append(command)
                answer = self.answers.get(command, "")
                if isinstance(answer, list):
                    answer = answer.pop(0) if len(answer) > 1 else answer[0]
                if answer:
                    client.sendall(answer.encode("latin-1") + b"\n")


@pytest.fixture(autouse=True)
def no_wait_after_closing(monkeypatch):
    # pyserial sleeps 0.3 s after closing a socket, for servers that are slow to accept again.
    monkeypatch.setattr(protocol_socket, "time", SimpleNamespace(sleep=lambda _seconds: None))


@pytest.fixture
def scripted():
    """Makes a driver and the scripted controller that it speaks to."""
    with contextlib.ExitStack() as stack:

        def make(answers=(), **update):
            script = Script(dict(answers))
            port = stack.enter_context(scripted_server(script.talk))
            settings = {"response_timeout_s": 0.2} | update
            driver = C887Hexapod(device(f"socket://127.0.0.1:{port}", **settings))
            stack.callback(driver.close)
            return driver, script

        yield make


@pytest.fixture
def mock(in_loop):
    """Makes mocks; `ends` of each says where it is."""
    mocks = []

    async def made(update):
        mock = C887ControllerMock(MOCK.model_copy(update=update))
        mock.ends = await mock.start()
        return mock

    def make(**update):
        mocks.append(in_loop(made(update)))
        mocks[-1].strike = lambda **fault: in_loop(struck(mocks[-1], fault))
        return mocks[-1]

    async def struck(mock, fault):
        mock.faults.set(Fault(device="hexapod", **fault)) if fault else mock.faults.clear()

    yield make
    for one in mocks:
        in_loop(one.stop())


@pytest.fixture(params=["tcp", "serial"])
def hexapod(request, mock):
    """A driver with its mock, over either wire."""
    ends = mock().ends
    port = f"socket://127.0.0.1:{ends.tcp_port}" if request.param == "tcp" else ends.pty_path
    driver = C887Hexapod(device(port))
    driver.open()
    yield driver
    driver.close()


def several(call, *arguments):
    """What is too much in an answer shows with the next question."""
    for _ in range(5):
        call(*arguments)


def arrive(driver):
    end_s = time.monotonic() + 10
    while (reading := driver.pose()).moving:
        assert time.monotonic() < end_s
        time.sleep(0.02)
    return reading


# ---------------------------------------------------------------- on the wire


def test_the_wire_when_it_is_opened(scripted):
    driver, script = scripted()
    identity = driver.open()
    assert script.heard == AT_OPEN, "nothing is set and nothing moves"
    assert (identity.model, identity.serial, identity.firmware) == (
        "C-887 with M-850.H11",
        "117040000",
        "2.3.0.1",
    )


def test_a_move_on_the_wire(scripted):
    driver, script = scripted()
    driver.open()
    del script.heard[:]
    driver.move_to(Pose(x_mm=1.0, w_deg=-0.5), 2.0)
    driver.move_to(Pose(x_mm=1.0, w_deg=-0.5), 2.0)
    assert script.heard == ["\x05", "VLS 2.000000", "ERR?", MOVE, "ERR?", MOVE, "ERR?"]


def test_a_reading_on_the_wire(scripted):
    driver, script = scripted(
        {"\x03": each([1.5, 0, 0, 0, 0, -2.0]), "\x05": "1", "ERR?": ["0", "7"]}
    )
    driver.open()
    del script.heard[:]
    before_s = time.monotonic()
    reading = driver.pose()
    assert script.heard == ["\x05", "\x03", f"FRF? {SIX}", f"SVO? {SIX}", "ERR?"]
    assert reading.pose == Pose(x_mm=1.5, w_deg=-2.0)
    assert before_s <= reading.time_s <= time.monotonic()
    assert (reading.moving, reading.referenced, reading.servos_on) == (True, True, True)
    assert reading.error == "error 7, the pose is out of reach"


def test_a_stop_on_the_wire(scripted):
    driver, script = scripted({"ERR?": ["0", "10"], "\x05": ["1", "0"]})
    driver.open()
    del script.heard[:]
    driver.stop()
    assert script.heard == ["\x18", "ERR?", "\x05", "\x05"]


def test_referencing_on_the_wire(scripted):
    answers = {f"SVO? {SIX}": each([0] * 6), "\x07": ["\xb0", "\xb1"]}
    driver, script = scripted(answers)
    driver.open()
    del script.heard[:]
    driver.reference()
    servos = "SVO X 1 Y 1 Z 1 U 1 V 1 W 1"
    assert script.heard == [
        *(f"SVO? {SIX}", servos, "ERR?", f"FRF {SIX}", "ERR?"),
        *("\x07", "\x07", "ERR?", f"FRF? {SIX}"),
    ]


@pytest.mark.parametrize(
    ("question", "answer", "got"),
    [
        ("*IDN?", "(c)2013 Physik Instrumente (PI) Karlsruhe, C-863.11, 1, 1.2", "C-863.11"),
        ("CSV?", "1.0", "GCS 1"),
        ("SAI?", "1 \n2", "1 2"),
        ("CST? X", "X=H-811.D1", "H-811.D1"),
        (f"TMX? {SIX}", each([50, 50, 12.5, 15, 15, 30]), "-25 to 12.5"),
    ],
)
def test_another_device_than_the_rig_s_is_refused(scripted, question, answer, got):
    driver, _ = scripted({question: answer})
    with pytest.raises(DeviceMismatch, match=re.escape(got)):
        driver.open()


def test_any_stage_will_do_where_the_rig_names_none(scripted):
    driver, _ = scripted({"CST? X": "X=H-850.G2"}, stage="")
    assert driver.open().model == "C-887 with H-850.G2"


# ---------------------------------------------------------------- refusals and failures


@pytest.mark.parametrize("number", [5, 7, 10, 93])
def test_what_the_controller_refuses_names_the_number_and_what_to_do(scripted, number):
    driver, _ = scripted({"ERR?": ["0", str(number)]})
    driver.open()
    with pytest.raises(DeviceRefused, match=f"MOV .* got error {number}, .*; .") as raised:
        driver.move_to(Pose(), 8.0)
    assert raised.value.hint


@pytest.mark.parametrize("number", [500, 501, 1024])
def test_a_fault_of_the_controller_is_a_fault(scripted, number):
    driver, _ = scripted({"ERR?": ["0", str(number)]})
    driver.open()
    with pytest.raises(DeviceFault, match=f"error {number}"):
        driver.move_to(Pose(), 8.0)


@pytest.mark.parametrize(
    ("pose", "velocity_mm_s"),
    [
        (Pose(x_mm=50.1), 1.0),
        (Pose(w_deg=-30.1), 1.0),
        (Pose(y_mm=float("nan")), 1.0),
        (Pose(), 8.1),
        (Pose(), 0.0),
        (Pose(), float("nan")),
    ],
)
def test_what_the_rig_does_not_allow_is_never_sent(scripted, pose, velocity_mm_s):
    driver, script = scripted()
    driver.open()
    del script.heard[:]
    with pytest.raises(DeviceRefused, match=r"collector\.hexapod"):
        driver.move_to(pose, velocity_mm_s)
    assert not script.heard


def test_a_question_that_the_controller_does_not_know_is_refused_with_its_number(scripted):
    driver, _ = scripted({"CST? X": "", "ERR?": ["0", "2"]})
    with pytest.raises(DeviceRefused, match=r"CST\? X to be done, got error 2, an unknown command"):
        driver.open()


def test_silence_ends_within_the_time_limit(scripted):
    driver, _ = scripted({"*IDN?": "", "ERR?": ["0", ""]})
    started_s = time.monotonic()
    with pytest.raises(DeviceTimeout, match=r"\*IDN\? within 0\.2 s"):
        driver.open()
    assert time.monotonic() - started_s < 1.0


def test_an_answer_that_came_while_the_computer_stood_still_is_in_time(scripted, monkeypatch):
    driver, _ = scripted({})
    driver.open()
    since_s = time.monotonic()

    def stands_still():
        """Each look at the clock is 0.3 s after the one before, and the time limit 0.2 s."""
        nonlocal since_s
        since_s += 0.3
        time.sleep(0.02)  # while the answer comes
        return since_s

    monkeypatch.setattr(link, "time", SimpleNamespace(monotonic=stands_still))
    driver.move_to(Pose(), 8.0)


def test_a_move_that_is_not_confirmed_is_named(scripted):
    driver, _ = scripted({"ERR?": ["0", ""]})
    driver.open()
    with pytest.raises(DeviceTimeout, match=r"MOV X .* within 0\.2 s"):
        driver.move_to(Pose(), 8.0)


@pytest.mark.parametrize("answer", ["X=word", "X=1 \nY=1", "X=1\nX=1", "Y=M-850", "\x01"])
def test_an_answer_that_is_none_ends_the_connection(scripted, answer):
    driver, _ = scripted({"VLS?": answer})
    with pytest.raises(DeviceProtocolError):
        driver.open()
    with pytest.raises(DeviceUnreachable, match="open it again"):
        driver.pose()


def test_an_answer_that_nobody_asked_for_ends_the_connection(scripted):
    driver, _ = scripted({"\x05": "0\n0"})
    driver.open()
    with pytest.raises(DeviceProtocolError, match="nothing before"):
        several(driver.pose)


def test_what_an_earlier_client_left_is_no_concern(scripted):
    driver, _ = scripted({"ERR?": ["7", "0"]})
    driver.open()
    assert not driver.pose().error


def test_nobody_there():
    driver = C887Hexapod(device("socket://127.0.0.1:9"))
    with pytest.raises(DeviceUnreachable, match=r"collector\.hexapod\.port"):
        driver.open()
    driver.close()


def test_a_platform_that_does_not_stop_is_a_fault(scripted):
    driver, _ = scripted({"\x05": "1", "ERR?": ["0", "10"]})
    driver.open()
    with pytest.raises(DeviceFault, match="press its emergency stop"):
        driver.stop()


def test_a_reference_move_without_end_is_stopped(scripted):
    driver, script = scripted({"\x07": "\xb0"}, reference_timeout_s=0.2)
    driver.open()
    with pytest.raises(DeviceTimeout, match="reference_timeout_s"):
        driver.reference()
    assert "\x18" in script.heard


# ---------------------------------------------------------------- with the mock


def test_it_goes_where_it_is_sent_over_either_wire(hexapod):
    hexapod.move_to(Pose(x_mm=0.4, u_deg=0.1), 4.0)
    assert hexapod.pose().moving
    reading = arrive(hexapod)
    assert reading.pose == pytest.approx(Pose(x_mm=0.4, u_deg=0.1), abs=1e-6)
    assert reading.referenced
    assert not reading.error


def test_the_velocity_changes_only_at_rest(hexapod):
    hexapod.move_to(Pose(x_mm=2.0), 4.0)
    with pytest.raises(DeviceRefused, match=r"VLS 5 .*error 93"):
        hexapod.move_to(Pose(x_mm=2.0), 5.0)
    hexapod.move_to(Pose(x_mm=0.5), 4.0)
    assert arrive(hexapod).pose.x_mm == pytest.approx(0.5)
    hexapod.move_to(Pose(), 5.0)
    arrive(hexapod)


def test_a_pose_out_of_reach_leaves_the_move_that_runs(hexapod):
    hexapod.move_to(Pose(x_mm=0.5), 8.0)
    with pytest.raises(DeviceRefused, match="error 7"):
        hexapod.move_to(Pose(x_mm=45.0, y_mm=45.0), 8.0)
    assert arrive(hexapod).pose.x_mm == pytest.approx(0.5)


def test_targets_streamed_at_50_hz_are_followed(hexapod):
    started_s = time.monotonic()
    for step in range(50):
        time.sleep(max(0.0, started_s + step / 50 - time.monotonic()))
        hexapod.move_to(Pose(y_mm=0.01 * step), 8.0)
    assert arrive(hexapod).pose.y_mm == pytest.approx(0.49)


def test_referencing_on_request_only(mock):
    controller = mock(referenced=False)
    driver = C887Hexapod(device(f"socket://127.0.0.1:{controller.ends.tcp_port}"))
    driver.open()
    assert not driver.pose().referenced
    with pytest.raises(DeviceRefused, match="reference the hexapod"):
        driver.move_to(Pose(x_mm=1.0), 8.0)
    driver.reference()
    assert driver.pose().referenced
    driver.close()


def test_closing_ends_what_another_thread_does_with_a_typed_error(hexapod):
    ended = []

    def stream():
        try:
            while True:
                hexapod.move_to(Pose(x_mm=0.1), 8.0)
        except Exception as error:
            ended.append(error)

    thread = threading.Thread(target=stream)
    thread.start()
    time.sleep(0.1)
    hexapod.close()
    thread.join(5)
    assert isinstance(ended[0], DeviceUnreachable)


def stop(driver, failures):
    try:
        driver.stop()
    except Exception as error:
        failures.append(error)


def test_a_stop_while_it_is_closed_is_done_or_a_typed_error(mock):
    controller = mock()
    for _ in range(20):
        driver = C887Hexapod(device(f"socket://127.0.0.1:{controller.ends.tcp_port}"))
        driver.open()
        failures = []
        thread = threading.Thread(target=stop, args=(driver, failures))
        thread.start()
        driver.close()
        thread.join(5)
        assert all(isinstance(error, DeviceError) for error in failures), failures


@pytest.mark.parametrize("what", ["a move", "a reference move"])
def test_a_stop_from_another_thread_acts_at_once(mock, what):
    controller = mock(referenced=what != "a reference move", reference_s=5.0)
    driver = C887Hexapod(device(f"socket://127.0.0.1:{controller.ends.tcp_port}"))
    driver.open()
    ended = []

    def work():
        try:
            if what == "a reference move":
                driver.reference()
            driver.move_to(Pose(x_mm=40.0), 8.0)
        except DeviceError as error:
            ended.append(error)

    thread = threading.Thread(target=work)
    thread.start()
    time.sleep(0.3)
    started_s = time.monotonic()
    driver.stop()
    assert time.monotonic() - started_s < 0.5
    thread.join(5)
    assert not thread.is_alive()
    reading = driver.pose()
    assert not reading.moving
    assert reading.pose.x_mm < 10
    if what == "a reference move":
        assert isinstance(ended[0], DeviceFault)
        assert not reading.referenced
    driver.close()


def test_a_probe_asks_and_sets_nothing(mock):
    controller = mock(referenced=False)
    probe = probe_c887(device(f"socket://127.0.0.1:{controller.ends.tcp_port}"))
    assert probe.identity.model == "C-887 with M-850.H11"
    assert probe.disagreements == (
        "the hexapod is not referenced: clear its way, then reference it",
    )
    assert probe.round_trip_s < 0.1
    assert not any(controller.platform.moving().values())


# ---------------------------------------------------------------- faults


@pytest.fixture
def struck(mock):
    """A driver, and ``strike(kind=..., ...)`` for its mock; without a kind all faults end."""
    controller = mock()
    driver = C887Hexapod(
        device(f"socket://127.0.0.1:{controller.ends.tcp_port}", response_timeout_s=0.3)
    )
    driver.open()
    yield driver, controller.strike
    driver.close()


def again(driver):
    """Open it once more and move."""
    driver.open()
    driver.reference()
    driver.move_to(Pose(x_mm=0.1), 8.0)
    assert arrive(driver).pose.x_mm == pytest.approx(0.1)


@pytest.mark.parametrize(
    ("fault", "error"),
    [
        ({"kind": "drop"}, DeviceTimeout),
        ({"kind": "freeze"}, DeviceTimeout),
        ({"kind": "silent"}, DeviceTimeout),
        ({"kind": "delay", "value": 0.5}, DeviceTimeout),
        ({"kind": "disconnect"}, DeviceUnreachable),
        ({"kind": "servo_off"}, DeviceRefused),
        ({"kind": "reference_lost"}, DeviceRefused),
        ({"kind": "motion_error"}, DeviceFault),
        ({"kind": "emergency_stop"}, DeviceFault),
        ({"kind": "false_error", "value": 7.0}, DeviceRefused),
    ],
    ids=lambda one: one["kind"] if isinstance(one, dict) else "",
)
def test_a_fault_is_a_typed_error_and_it_recovers(struck, fault, error):
    driver, strike = struck
    strike(**fault)
    with pytest.raises(error) as raised:
        driver.move_to(Pose(x_mm=1.0), 8.0)
    assert raised.value.hint
    strike()
    again(driver)


def test_doubled_answers_show_in_a_reading(struck):
    driver, strike = struck
    strike(kind="duplicate")
    with pytest.raises(DeviceProtocolError):
        several(driver.pose)
    strike()
    again(driver)


def test_after_a_loss_of_power_it_must_be_referenced(struck):
    driver, strike = struck
    strike(kind="reboot", value=0.1)
    with pytest.raises(DeviceUnreachable, match="reference it"):
        driver.pose()
    time.sleep(0.2)
    driver.open()
    assert not driver.pose().referenced
    again(driver)


def test_a_corrupt_answer_is_an_error_or_a_number_near_by(struck):
    driver, strike = struck
    strike(kind="corrupt")
    for _ in range(20):
        try:
            if driver.pose().error:
                break
        except DeviceError:
            break
    else:
        pytest.fail("twenty readings with a bit wrong in every answer, and none was noticed")
    strike()
    again(driver)


def test_moves_that_another_client_stops_show_in_the_reading(struck):
    driver, strike = struck
    driver.move_to(Pose(x_mm=10.0), 8.0)
    strike(kind="moves_stopped")
    assert "error 10" in driver.pose().error
    time.sleep(0.05)
    assert not driver.pose().moving


def test_an_interrupt_between_a_question_and_its_answer_stops_the_move(hexapod, monkeypatch):
    exchange = link.C887Link._exchange

    def interrupted(line, name, data):
        monkeypatch.setattr(link.C887Link, "_exchange", exchange)
        line._write(name, data)
        assert select.select([line._port], [], [], 5.0)[0], "no answer came"
        raise KeyboardInterrupt

    def step():
        with stopped_early(hexapod.stop, hexapod.open, "it may still move"):
            hexapod.move_to(Pose(x_mm=40.0), 8.0)
            monkeypatch.setattr(link.C887Link, "_exchange", interrupted)
            hexapod.pose()

    with pytest.raises(KeyboardInterrupt):
        step()
    assert not hexapod.pose().moving
