import os
import threading
import time
import tty
from contextlib import contextmanager

import pytest

from fitctl import config
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import (
    DeviceMismatch,
    DeviceProtocolError,
    DeviceRefused,
    DeviceTimeout,
    DeviceUnreachable,
)
from fitctl.drivers.mdt693.driver import Mdt693
from fitctl.mocks.mdt693.device import Dialect
from fitctl.mocks.mdt693.server import Mdt693Mock

PIEZO = (
    load_rig(default_rig_path())
    .loops["right"]
    .fsm.piezo.model_copy(update={"response_timeout_s": 0.4})
)


@pytest.fixture
def start(in_loop):
    """Start a mock; more are stopped at the end."""
    mocks = []

    def started(model="MDT693B", firmware="2.04", switch_v=150, dialect=None):
        async def made():
            settings = config.Mdt693Mock(
                model=model, firmware=firmware, limit_switch_v=switch_v, reply_s=0.005
            )
            return Mdt693Mock(settings, PIEZO, lambda volts: None, port=0, dialect=dialect)

        mock = in_loop(made())
        mock.ends = in_loop(mock.start())
        mocks.append(mock)
        return mock

    yield started
    for mock in mocks:
        in_loop(mock.stop())


@contextmanager
def opened(port, **changes):
    driver = Mdt693(PIEZO.model_copy(update={"port": port, **changes}))
    try:
        driver.identity = driver.open()
        yield driver
    finally:
        driver.close()


def tcp(mock):
    return f"socket://127.0.0.1:{mock.ends.tcp_port}"


@contextmanager
def scripted_amplifier(answers):
    """A pty that answers commands from a table, and nothing to what is not in it."""
    master, slave = os.openpty()
    tty.setraw(slave)

    def serve():
        pending = b""
        while True:
            pending += os.read(master, 100)
            *commands, pending = pending.split(b"\r")
            for command in commands:
                if command == b"end":
                    return
                os.write(master, answers.get(command, b""))

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield os.ttyname(slave)
    finally:
        os.write(slave, b"\rend\r")
        thread.join(10)
        os.close(master)
        os.close(slave)


@pytest.mark.parametrize(("wire", "echo"), [("tcp", True), ("pty", False)])
@pytest.mark.parametrize(
    ("model", "firmware", "dialect"),
    [
        ("MDT693A", "1.0", None),
        ("MDT693B", "1.05", None),
        ("MDT693B", "2.04", None),
        ("MDT693B", "2.04", Dialect("> ", all_voltages=False, limit_as_position=True)),
    ],
    ids=["693A", "693B firmware 1", "693B firmware 2", "693B, the odd one"],
)
def test_every_dialect_is_understood(start, model, firmware, dialect, wire, echo):
    mock = start(model, firmware, dialect=dialect)
    mock.amplifier.echo = echo
    mock.set_external_input_v([5.0, 0.0, 3.3])
    with opened(tcp(mock) if wire == "tcp" else mock.ends.pty_path) as piezo:
        assert (piezo.identity.model, piezo.identity.firmware) == (model, firmware)
        assert piezo.stack_volts() == pytest.approx([75.0, 0.0, 49.5])
        assert piezo.limit_v() == 150.0
        assert mock.amplifier.echo is echo


def test_a_693b_in_compatibility_mode_is_understood_and_left_so(start):
    mock = start()
    mock.amplifier.compatible = True
    with opened(mock.ends.pty_path) as piezo:
        assert piezo.stack_volts() == pytest.approx([0.0, 0.0, 0.0])
    assert mock.amplifier.compatible


def test_a_wrong_limit_switch_is_a_mismatch_that_says_what_to_do(start):
    mock = start(switch_v=100)
    expected = r"voltage-limit switch at 150\.5 V, got 100 V; set .* or correct piezo\.limit_v"
    with pytest.raises(DeviceMismatch, match=expected), opened(mock.ends.pty_path):
        pass
    with opened(mock.ends.pty_path, limit_v=100.5) as piezo:
        assert piezo.limit_v() == 100.0


def test_one_channels_wrong_high_limit_is_named(start):
    mock = start()
    mock.amplifier.execute("ymax=120")
    expected = r"channel y's high limit at 150\.5 V, got 120 V"
    with pytest.raises(DeviceMismatch, match=expected), opened(mock.ends.pty_path):
        pass


def test_what_an_earlier_client_left_half_typed_does_no_harm(start):
    mock = start()
    left = os.open(mock.ends.pty_path, os.O_RDWR | os.O_NOCTTY)
    os.write(left, b"xvolta")
    with opened(mock.ends.pty_path) as piezo:
        assert piezo.identity.model == "MDT693B"
    os.close(left)


def test_silence_is_a_timeout_and_the_driver_finds_its_way_back(start):
    mock = start()
    with opened(mock.ends.pty_path) as piezo:
        mock.silent = True
        started_s = time.monotonic()
        with pytest.raises(DeviceTimeout, match=r"within 0\.4 s, got none"):
            piezo.limit_v()
        assert 0.3 < time.monotonic() - started_s < 2
        mock.silent = False
        assert piezo.limit_v() == 150.0


def test_garbage_is_a_protocol_error_and_the_driver_finds_its_way_back(start):
    mock = start()
    with opened(mock.ends.pty_path) as piezo:
        mock.garbled = True
        with pytest.raises(DeviceProtocolError, match="baud_rate"):
            piezo.stack_volts()
        mock.garbled = False
        assert piezo.stack_volts() == pytest.approx([0.0, 0.0, 0.0])


def test_a_late_answer_is_not_taken_for_the_next_one(start):
    mock = start()
    mock.amplifier.echo = False
    with opened(mock.ends.pty_path) as piezo:
        mock._reply_s = 0.5
        with pytest.raises(DeviceTimeout):
            piezo.limit_v()
        mock._reply_s = 0.005
        assert piezo.stack_volts() == pytest.approx([0.0, 0.0, 0.0])


def test_a_command_refused_after_open_is_named(start):
    mock = start()
    with opened(mock.ends.pty_path) as piezo:
        mock.amplifier.is_a = True
        with pytest.raises(DeviceRefused, match="an answer to vlimit"):
            piezo.limit_v()


def test_a_lost_link_is_unreachable_until_opened_again(start, in_loop):
    mock = start()

    async def drop():
        mock.drop_links()

    with opened(tcp(mock)) as piezo:
        in_loop(drop())
        with pytest.raises(DeviceUnreachable, match="broken link"):
            piezo.stack_volts()
        with pytest.raises(DeviceUnreachable, match="open it again"):
            piezo.stack_volts()
        piezo.open()
        assert piezo.limit_v() == 150.0


def test_no_port_is_unreachable_and_close_is_always_safe():
    driver = Mdt693(PIEZO.model_copy(update={"port": "/dev/no-such-port"}))
    with pytest.raises(DeviceUnreachable, match=r"piezo\.port"):
        driver.open()
    driver.close()
    driver.close()


def test_a_device_that_is_no_mdt693_is_not_used():
    answers = {b"": b">", b"id?": b"id?\rTC200 heater\r>"}
    with (
        scripted_amplifier(answers) as path,
        pytest.raises(DeviceProtocolError, match="no MDT693"),
        opened(path),
    ):
        pass


def test_answers_without_a_prompt_are_complete_when_nothing_more_comes():
    answers = {
        b"": b"!",
        b"id?": b"id?\r*\r\r\rModel MDT693B\rFirmware Version: 1.05\r\r*",
        b"xyzvoltage?": b"xyzvoltage?\r!",
        b"serial?": b"serial?\r140421-07\r*",
        b"vlimit?": b"vlimit?\r*[ 100]\r*",
        **{f"{name}max?".encode(): f"{name}max?\r*100.5".encode() for name in "xyz"},
    }
    with scripted_amplifier(answers) as path, opened(path, limit_v=100.5) as piezo:
        assert piezo.identity.serial == "140421-07"
        assert piezo.limit_v() == 100.0
