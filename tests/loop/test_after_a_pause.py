"""After a pause without writes, the mirror goes on from where the D/A's own watchdog has put it."""

import numpy as np
import pytest
from instruments.simulated import events_of, failing, mode_of, until

from fitctl.drivers.interface import DeviceTimeout
from fitctl.messages.commands import SetBiasOffset, Standby
from fitctl.messages.modes import Mode

SAFE_V = 5.0  # where the D/A's own watchdog puts its outputs


@pytest.fixture
def off_bias(simulate_with):
    """An instrument in STANDBY whose mirror rests far off its bias, and the steps of its D/A from then on."""
    simulation = simulate_with("interlocks.dac_watchdog.action=warn")
    simulation.command(Standby())
    simulation.run(0.2)
    assert simulation.command(SetBiasOffset(az_urad=100.0, el_urad=0.0)).accepted
    simulation.run(1.0)
    return simulation


def steps_v(dac):
    """Every step of the D/A that a write makes, from now on, V."""
    steps, send_v = [], dac.send_v

    def send(volts):
        before_v = dac._stack_v.copy()
        send_v(volts)
        steps.append(float(np.abs(dac._stack_v - before_v).max()))

    dac.send_v = send
    return steps


def stall(simulation, duration_s, to_v=None):
    """The computer stands still; where it is given, the D/A goes to a voltage by itself meanwhile."""
    simulation.clock.sleep_until(simulation.clock.now_s() + duration_s)
    if to_v is not None:
        simulation.devices.loops["right"].dac._stack_v[:] = to_v


def test_a_mirror_that_the_watchdog_moved_goes_back_no_faster_than_its_slew(off_bias):
    fsm = off_bias.rig.stellar_loops["right"].fsm
    dac = off_bias.devices.loops["right"].dac
    most_v = fsm.slew_v_per_s * off_bias.rig.camera.period_s + fsm.dac.step_v
    rested_v = dac.read_v()
    assert np.abs(rested_v - SAFE_V).max() > 1.2 * most_v
    steps = steps_v(dac)

    stall(off_bias, 1.5, SAFE_V)
    off_bias.run(1.0)

    assert max(steps) <= most_v
    assert dac.read_v() == pytest.approx(rested_v, abs=fsm.dac.step_v)
    assert any(
        "its own watchdog has moved the mirror" in event.message for event in events_of(off_bias)
    )


def test_a_mirror_that_was_moved_while_other_devices_were_opened_goes_on_from_there(off_bias):
    loop = off_bias.supervisor.loops["right"]
    fsm = off_bias.rig.stellar_loops["right"].fsm
    steps = steps_v(off_bias.devices.loops["right"].dac)

    loop.begin(np.full(3, SAFE_V + 3.0))  # as it was read when opening began
    off_bias.devices.loops["right"].dac._stack_v[:] = SAFE_V
    off_bias.run(0.5)

    assert max(steps) <= fsm.slew_v_per_s * off_bias.rig.camera.period_s + fsm.dac.step_v


def test_a_confirmation_that_waited_for_the_computer_does_not_tell_where_the_mirror_is(off_bias):
    fsm = off_bias.rig.stellar_loops["right"].fsm
    dac = off_bias.devices.loops["right"].dac
    confirm = dac.confirm
    steps = steps_v(dac)

    def confirm_late():
        confirm()
        stall(off_bias, 1.3, SAFE_V)  # the D/A has obeyed; this computer reads its answer later
        dac.confirm = confirm

    dac.confirm = confirm_late
    off_bias.run(2.0)

    assert max(steps) <= fsm.slew_v_per_s * off_bias.rig.camera.period_s + fsm.dac.step_v


def test_outputs_that_stayed_are_no_news(off_bias):
    stall(off_bias, 0.45)
    off_bias.run(0.5)

    assert not any("watchdog has moved" in event.message for event in events_of(off_bias))
    assert mode_of(off_bias) is Mode.STANDBY


def test_a_dac_that_does_not_answer_after_a_pause_has_failed(off_bias):
    dac = off_bias.devices.loops["right"].dac
    sent = steps_v(dac)
    dac.read_v = failing(DeviceTimeout("D/A", "here", "an answer", "none", "look"))
    sent = steps_v(dac)

    stall(off_bias, 0.45)
    off_bias.run(0.5)

    assert mode_of(off_bias) is Mode.SAFE
    assert sent == []


def test_a_short_pause_does_not_ask_the_dac(off_bias):
    off_bias.devices.loops["right"].dac.read_v = failing(AssertionError("asked"))

    stall(off_bias, 0.3)
    off_bias.run(0.5)

    assert mode_of(off_bias) is Mode.STANDBY


def test_the_star_is_held_on_after_a_stall_in_which_the_mirror_was_moved(simulate_with):
    simulation = simulate_with("interlocks.dac_watchdog.action=warn", star_offset_px=(10.0, -6.0))
    simulation.acquire()
    until(simulation, Mode.VERNIER)

    stall(simulation, 1.5, SAFE_V)
    simulation.run(5.0)

    until(simulation, Mode.VERNIER)
