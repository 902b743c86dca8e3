"""Moving stages by hand: each press of an arrow key is one command of one step, and only where it may be."""

import pytest

from fitctl.messages.commands import Jog, SetBiasOffset, SetTarget
from fitctl.tui.jog import AGAIN_S, STAGES, JogPad
from fitctl.tui.state import ConsoleState
from tests.instruments.fake_supervisor import START_S, FakeSupervisor


def loop_in(mode, bias_offset_urad=(0.0, 0.0)):
    supervisor = FakeSupervisor(mode)
    supervisor.bias_offset_urad = bias_offset_urad
    state = ConsoleState(START_S)
    state.accept(supervisor.message(), START_S)
    return state.loop


@pytest.mark.parametrize("mode", ["OFF", "ACQUISITION", "SAFE", "EXPERIMENT"])
def test_nothing_is_moved_where_nothing_may_be(mode):
    assert JogPad().press(loop_in(mode), 1, 0, 0.0) is None


def test_in_standby_it_is_the_siderostat_and_then_the_mirror():
    pad, loop = JogPad(), loop_in("STANDBY", (3.0, 0.0))
    assert pad.press(loop, 1, 0, 0.0) == Jog(az_sky_arcsec=2.0, el_sky_arcsec=0.0)
    pad.next_stage()
    assert pad.press(loop, 0, -1, 0.0) == SetBiasOffset(az_urad=3.0, el_urad=-5.0)
    pad.next_stage()
    assert pad.stage(loop).name == "siderostat"


@pytest.mark.parametrize("mode", ["COARSE", "VERNIER"])
def test_while_a_star_is_held_it_is_the_target(mode):
    assert JogPad().press(loop_in(mode), -1, 0, 0.0) == SetTarget(az_px=23.5, el_px=19.5)


def test_quick_presses_add_up_and_a_late_one_begins_where_it_is():
    pad, loop = JogPad(), loop_in("VERNIER")
    for number in range(3):
        command = pad.press(loop, 1, 0, 10.0 + 0.1 * number)
    assert command == SetTarget(az_px=25.5, el_px=19.5)
    assert pad.press(loop, 1, 0, 10.2 + 1.1 * AGAIN_S) == SetTarget(az_px=24.5, el_px=19.5)


def test_steps_go_from_the_finest_to_the_coarsest_and_no_farther():
    for stage in STAGES:
        pad = JogPad()
        pad.change_step(stage, -10)
        assert pad.step(stage) == min(stage.steps)
        seen = []
        for _ in range(len(stage.steps) + 2):
            seen.append(pad.step(stage))
            pad.change_step(stage, 1)
        assert seen == sorted(seen)
        assert seen[-1] == max(stage.steps)
