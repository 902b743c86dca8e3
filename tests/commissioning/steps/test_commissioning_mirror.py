"""The step `mirror`: how far it moves the stacks."""

from types import SimpleNamespace

import numpy as np
from commissioning.motor_bench import RIG, site_of

from fitctl.clock import VirtualClock
from fitctl.commissioning.steps.mirror import _swing, moves
from fitctl.commissioning.steps.stacks import Stacks
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.mirror import Mirror
from fitctl.drivers.modbus_dac.protocol import encode_volts

FSM = "loops.right.fsm"
SMALL = load_rig(
    default_rig_path(),
    [f"{FSM}.dac.full_scale_v=4.096", f"{FSM}.bias_v=2.048", f"{FSM}.range_rad=7.0e-5"],
)


class BenchDac:
    """A D/A that refuses what it cannot give."""

    def __init__(self, rig):
        self._fsm = rig.loops["right"].fsm
        self.volts = np.full(3, self._fsm.bias_v)
        self.furthest_v = 0.0

    def read_v(self):
        return self.volts

    def send_v(self, volts):
        encode_volts(volts.tolist(), self._fsm.dac.full_scale_v, self._fsm.dac.bits)
        self.furthest_v = max(self.furthest_v, *np.abs(volts - self._fsm.bias_v))

    def confirm(self):
        pass


def furthest_v(rig):
    dac, clock = BenchDac(rig), VirtualClock()
    star = SimpleNamespace(place_px=lambda _frames: np.zeros(2))
    _swing(site_of(rig, clock), star, Stacks(dac, None, clock), Mirror(rig.loops["right"].fsm), 1)
    return dac.furthest_v


def test_a_stack_is_moved_no_farther_than_the_mirror_s_range():
    assert furthest_v(RIG) == 2.5
    assert 1.5 < furthest_v(SMALL) < SMALL.loops["right"].fsm.swing_v < 2.0


def test_it_says_before_how_far():
    assert moves(site_of(RIG)).startswith("all stacks to 5 V at the D/A, then each by 2.5 V both")
    assert f"then each by {furthest_v(SMALL):.3g} V both ways" in moves(site_of(SMALL))
