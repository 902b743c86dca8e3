"""Cables that do not go straight: what the drivers undo is what the mocks do."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instruments.mock_bench import ToldMotors

from fitctl.config.wiring import AmplifierWiring
from fitctl.drivers.wiring import WiredDac, WiredPiezo, crossing
from fitctl.mocks.motors import WiredMotors

signs = st.lists(st.sampled_from([-1, 1]), min_size=2, max_size=2)
wirings = st.builds(
    AmplifierWiring,
    axes=st.permutations([0, 1]),
    velocity_signs=signs,
    encoder_signs=signs,
)
angle = st.floats(-1e3, 1e3)


@given(wirings, angle, angle)
def test_a_velocity_reaches_the_motor_that_it_is_for(wiring, az, el):
    motors = ToldMotors()
    WiredMotors(motors, wiring, [1.0, 1.0]).command_velocity_rad_s(
        *crossing(wiring).commands((az, el))
    )
    assert motors.velocity_rad_s == (az, el)


@given(wirings, angle, angle)
def test_an_angle_is_that_of_the_motor_that_has_it(wiring, az, el):
    counted = WiredMotors(ToldMotors(az, el), wiring, [1.0, 1.0]).position_rad()
    assert crossing(wiring).angles(tuple(counted)) == (az, el)


@pytest.mark.parametrize("axis", [0, 1])
def test_current_reaches_the_motor_on_an_axis(axis):
    motors = ToldMotors()
    wiring = AmplifierWiring(axes=[1, 0], velocity_signs=[1, 1], encoder_signs=[1, 1])
    WiredMotors(motors, wiring, [1.0, 1.0]).set_enabled(axis, True)
    assert motors.enabled == [axis == 1, axis == 0]


@pytest.mark.parametrize("channels", itertools.permutations([1, 2, 3]))
def test_each_stack_has_the_channel_that_the_rig_file_names(channels):
    sent = []
    held = np.array([10.0, 20.0, 30.0])
    device = SimpleNamespace(
        open=None,
        confirm=None,
        close=None,
        limit_v=None,
        send_v=sent.append,
        read_v=lambda: held,
        stack_volts=lambda: held,
    )
    WiredDac(device, list(channels)).send_v(np.array([1.0, 2.0, 3.0]))
    for stack, channel in enumerate(channels):
        assert sent[0][channel - 1] == stack + 1
    expected = [10.0 * channel for channel in channels]
    assert WiredDac(device, list(channels)).read_v().tolist() == expected
    assert WiredPiezo(device, list(channels)).stack_volts().tolist() == expected
