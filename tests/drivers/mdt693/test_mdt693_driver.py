import itertools
import os
import threading
import tty
from contextlib import contextmanager

import pytest
from mdt693_bench import PIEZO, opened

from fitctl.drivers.interface import (
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceUnreachable,
)
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.drivers.probe import round_trip_s

A_301 = {"model": "MDT693A", "firmware": "3.01"}
B_105 = {"model": "MDT693B", "firmware": "1.05", "prompt": "*"}
B_110 = {
    "model": "MDT693B",
    "firmware": "1.10",
    "prompt": ">",
    "decimals": 2,
    "xyzvoltage": True,
}
ODD = {"model": "MDT693B", "firmware": "1.23", "prompt": "> ", "vlimit_as": "position"}
COMPATIBLE = B_110 | {"compatibility_mode": True}


@contextmanager
def scripted_amplifier(answers):
    """A pty that answers commands from a table, in turn, and nothing to what is not in it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    turns = {
        command: itertools.cycle([turn] if isinstance(turn, bytes) else turn)
        for command, turn in answers.items()
    }

    def serve():
        pending = b""
        while True:
            pending += os.read(master, 100)
            *commands, pending = pending.split(b"\r")
            for command in commands:
                if command == b"end":
                    return
                if command in turns:
                    os.write(master, next(turns[command]))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        os.write(slave, b"\rend\r")
        thread.join(10)
        os.close(master)
        os.close(slave)


B_SESSION = {
    b"": b"!",
    b"id?": b"id?\r*\r\r\rModel MDT693B\rFirmware Version: 1.05\r\r*",
    b"xyzvoltage?": b"xyzvoltage?\r!",
    b"serial?": b"serial?\r140421-07\r*",
    b"vlimit?": b"vlimit?\r*[ 100]\r*",
    b"sysmin?": b"sysmin?\r!",
    b"sysmax?": b"sysmax?\r!",
    **{f"{name}max?".encode(): f"{name}max?\r*100.5\r*".encode() for name in "xyz"},
    **{f"{name}min?".encode(): f"{name}min?\r*0\r*".encode() for name in "xyz"},
    b"xvoltage?": b"xvoltage?\r*[  24.8]\r*",
    b"yvoltage?": b"yvoltage?\r*[   1.4]\r*",
    b"zvoltage?": b"zvoltage?\r*[   0.2]\r*",
}
A_SESSION = {
    b"": b"\r!\0",
    b"id?": b"id?\r!\0",
    b"I": b"i\r*     \r\r\rModel MDT693A Piezo Control Module\rFirmware Version: 3.01\r\r",
    b"%": b"%\r*[ 150]\r",
    **{f"{name}H?".encode(): f"{name}h?\r*150".lower().encode() for name in "XYZ"},
    **{f"{name}L?".encode(): f"{name}l?\r*0\0".lower().encode() for name in "XYZ"},
    b"XR?": b"xr?\r*[   1.6]\r",
    b"YR?": b"yr?\r*[     1]\r",
    b"ZR?": b"zr?\r*[  50.5]\r",
}


@pytest.mark.long
@pytest.mark.parametrize(
    ("dialect", "wire", "echo"),
    [
        (A_301, "pty", False),
        (B_105, "pty", True),
        (B_105, "tcp", False),
        (B_110, "tcp", True),
        (B_110, "pty", False),
        (ODD, "pty", True),
        (ODD, "tcp", False),
        (COMPATIBLE, "pty", True),
        (COMPATIBLE, "tcp", False),
    ],
    ids=str,
)
def test_every_dialect_is_understood_and_left_as_it_is(start, dialect, wire, echo):
    bench = start(**dialect, echo=echo)
    bench.mock.set_external_input_v([5.0, 0.0, 3.3])
    with bench.opened(getattr(bench, wire)) as piezo:
        identity = piezo.identity
        assert (identity.model, identity.firmware) == (dialect["model"], dialect["firmware"])
        assert piezo.stack_volts() == pytest.approx([75.0, 0.0, 49.5])
        assert piezo.limit_v() == 150.0
    assert bench.controller.echo is echo
    assert bench.controller.compatible is dialect.get("compatibility_mode", False)


def test_the_recorded_b_is_understood():
    with scripted_amplifier(B_SESSION) as path, opened(path, limit_v=100.5) as piezo:
        assert (piezo.identity.serial, piezo.identity.firmware) == ("140421-07", "1.05")
        assert piezo.limit_v() == 100.0
        assert piezo.stack_volts() == pytest.approx([24.8, 1.4, 0.2])


def test_the_recorded_a_is_understood_with_its_nuls_and_without_prompts():
    with scripted_amplifier(A_SESSION) as path, opened(path) as piezo:
        assert (piezo.identity.model, piezo.identity.firmware) == ("MDT693A", "3.01")
        assert piezo.limit_v() == 150.0
        assert piezo.stack_volts() == pytest.approx([1.6, 1.0, 50.5])


def test_one_wrong_answer_is_not_believed():
    turns = {b"xvoltage?": [b"xvoltage?\r*[  %s.8]\r*" % n for n in (b"24", b"64", b"25")]}
    with (
        scripted_amplifier(B_SESSION | turns) as path,
        opened(path, limit_v=100.5) as piezo,
    ):
        assert piezo.stack_volts()[0] == pytest.approx(25.8)


def test_a_round_trip_is_one_question(start):
    """Which a reading is not: three channels, each asked for twice."""
    with start(reply_s=0.03).opened() as piezo:
        one_s, reading_s = round_trip_s(piezo.ask_once), round_trip_s(piezo.stack_volts)
        assert one_s >= 0.03
        assert reading_s > 3 * one_s


def test_a_device_without_a_serial_number_is_taken():
    nameless = {
        command: answer.replace(command + b"\r", b"") for command, answer in B_SESSION.items()
    }
    with (
        scripted_amplifier(nameless | {b"serial?": b"*"}) as path,
        opened(path, limit_v=100.5) as piezo,
    ):
        assert piezo.identity.serial == ""


# ---------------------------------------------------------------- limits


def test_a_wrong_limit_switch_is_a_mismatch_that_says_what_to_do(start):
    bench = start(limit_switch_v=100)
    expected = r"voltage-limit switch at 150\.5 V, got 100 V; set .* or correct piezo\.limit_v"
    with pytest.raises(DeviceMismatch, match=expected), bench.opened():
        pass
    with bench.opened(limit_v=100.5) as piezo:
        assert piezo.limit_v() == 100.0


@pytest.mark.parametrize(
    ("command", "expected"),
    [
        ("ymax=120", r"channel y's high limit at 150\.5 V, got 120 V"),
        ("zmin=20", r"channel z's low limit at 0 V, got 20 V"),
        ("sysmax=120", r"channel x's high limit at 150\.5 V, got 120 V"),
        ("sysmin=20", r"channel x's low limit at 0 V, got 20 V"),
    ],
)
def test_whichever_limit_is_wrong_is_named(start, command, expected):
    bench = start()
    bench.do(bench.controller.answer, command)
    with pytest.raises(DeviceMismatch, match=expected), bench.opened():
        pass


def test_a_limit_of_the_system_that_no_channel_shows_is_found_too():
    told = {b"sysmin?": b"sysmin?\r*0\r*", b"sysmax?": b"sysmax?\r*90.0\r*"}
    with (
        scripted_amplifier(B_SESSION | told) as path,
        pytest.raises(DeviceMismatch, match=r"the system's high limit at 100\.5 V, got 90 V"),
        opened(path, limit_v=100.5),
    ):
        pass


# ---------------------------------------------------------------- what is no MDT693


def test_what_an_earlier_client_left_half_typed_does_no_harm(start):
    bench = start()
    left = os.open(bench.pty, os.O_RDWR | os.O_NOCTTY)
    os.write(left, b"xvolta")
    with bench.opened() as piezo:
        assert piezo.identity.model == "MDT693B"
    os.close(left)


def test_a_command_refused_after_open_is_named():
    refused_later = {b"vlimit?": [b"vlimit?\r*[ 100]\r*"] * 2 + [b"vlimit?\r!"]}
    with (
        scripted_amplifier(B_SESSION | refused_later) as path,
        opened(path, limit_v=100.5) as piezo,
        pytest.raises(DeviceRefused, match="an answer to vlimit"),
    ):
        piezo.limit_v()


def test_echo_that_someone_else_changes_is_noticed(start):
    bench = start()
    with bench.opened() as piezo:
        bench.controller.echo = False
        with pytest.raises(DeviceProtocolError, match="echoed, as at open"):
            piezo.limit_v()


def test_a_device_that_is_no_mdt693_is_not_used():
    answers = {b"": b">", b"id?": b"id?\rTC200 heater\r>"}
    with (
        scripted_amplifier(answers) as path,
        pytest.raises(DeviceProtocolError, match="no MDT693"),
        opened(path),
    ):
        pass


def test_no_port_is_unreachable_and_close_is_always_safe():
    driver = Mdt693(PIEZO.model_copy(update={"port": "/dev/no-such-port"}))
    with pytest.raises(DeviceUnreachable, match=r"piezo\.port"):
        driver.open()
    driver.close()
    driver.close()
