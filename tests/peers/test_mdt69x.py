"""PyPI mdt69x 1.0.11, a public driver of the MDT693B and MDT694B, against our mock on its pty."""

import warnings

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.mocks.mdt693.server import Mdt693Mock

pytestmark = pytest.mark.peer

RIG = load_rig(default_rig_path())
PIEZO = RIG.loops["right"].fsm.piezo
# It takes no echo, and wants the prompt of firmware 1.10 until it has turned compatibility mode on.
SETTINGS = RIG.mocks.loops["right"].mdt693.model_copy(
    update={
        "firmware": "1.10",
        "echo": False,
        "prompt": ">",
        "decimals": 2,
        "xyzvoltage": True,
        "readback_noise_v": 0.0,
        "readback_offset_v": 0.0,
        "readback_settling_s": 0.0,
        "reply_s": 0.005,
    }
)


@pytest.fixture
def controller(in_loop):
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", SyntaxWarning)  # `port is ""` in its source
        mdt69x = pytest.importorskip("mdt69x", reason="PyPI mdt69x is not installed")

    async def made():
        mock = Mdt693Mock(SETTINGS, PIEZO, lambda volts: None, port=0)
        return mock, await mock.start()

    mock, ends = in_loop(made())
    controller = mdt69x.Controller(
        ends.pty_path
    )  # probes, turns echo off and compatibility mode on
    yield controller
    controller.close()
    in_loop(mock.stop())


def test_it_finds_its_device_and_reads_who_it_is(controller, capsys):
    controller.get_id()
    assert "Model MDT693B" in capsys.readouterr().out
    assert controller._firmware_version == "1.10"
    assert controller.get_compatibility() == controller.COMPATIBILITY_ON
    assert controller.get_echo_status() == controller.ECHO_OFF
    assert controller.get_switch_limit() == 150.0


def test_voltages_that_it_sets_are_those_that_it_reads(controller):
    assert controller.set_x_voltage(12.5) == controller.SUCCESS
    assert controller.set_xyz_voltage(12.5, 20.25, 30.0) == controller.SUCCESS
    assert controller.get_x_voltage() == pytest.approx(12.5, abs=0.01)
    assert controller.get_xyz_voltage() == pytest.approx([12.5, 20.25, 30.0], abs=0.01)
    assert controller.set_all_voltage(5) == controller.SUCCESS
    assert controller.get_z_voltage() == pytest.approx(5.0, abs=0.01)


def test_limits_that_it_sets_hold(controller):
    assert controller.set_y_voltage_max(40) == controller.SUCCESS
    assert controller.get_y_voltage_max() == 40.0
    assert controller.set_y_voltage(41) == controller.FAIL
    assert controller.get_sys_voltage_max() == 150.5


def test_master_scan_and_the_knobs_are_its_to_set(controller):
    assert controller.enable_master_scan() == controller.SUCCESS
    assert controller.set_master_voltage(7) == controller.SUCCESS
    assert controller.get_master_voltage() == 7.0
    assert controller.get_x_voltage() == pytest.approx(7.0, abs=0.01)
    assert controller.set_rotary_mode(controller.ROTARY_MODE_FINE) == controller.SUCCESS
    assert controller.get_rotary_mode() == controller.ROTARY_MODE_FINE
    assert controller.disable_push_mode() == controller.SUCCESS
    assert controller.get_push_mode() == controller.PUSH_MODE_ON
    assert controller.set_intensity(3) == controller.SUCCESS
    assert controller.get_intensity() == 3


def test_what_the_device_refuses_is_a_failure_for_it(controller):
    assert controller._send_command("ROTARYMODE=", 3) == controller.FAIL
    assert controller.restore_all() == controller.SUCCESS
