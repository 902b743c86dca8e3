"""One axis of the mock controller: motions, homing, software limits, faults."""

import hypothesis
import pytest
from hypothesis import given
from hypothesis import strategies as st
from instruments.ensemble_axis import parameters

from fitctl.drivers.ensemble.protocol import (
    FAULT_MASKS,
    AxisFault,
    AxisStatus,
    Parameter,
)
from fitctl.mocks.ensemble.axis import HOME_OFFSET, Axis

PERIOD_S = 0.002


def enabled_axis(**state):
    axis = Axis(parameters(), **state)
    assert axis.enable()
    return axis


def run(axis, seconds):
    """A motor that follows exactly."""
    for _ in range(round(seconds / PERIOD_S)):
        axis.step(axis.feedback + axis.motor_velocity * PERIOD_S, PERIOD_S)


def test_a_free_run_ramps_up_and_stays():
    axis = enabled_axis()
    axis.free_run(2.0)
    run(axis, 0.1)
    assert axis.velocity == pytest.approx(1.0)  # 10 units a second, a second
    run(axis, 0.5)
    assert axis.velocity == pytest.approx(2.0)
    assert axis.motor_velocity == pytest.approx(2.0, rel=1e-3)
    assert axis.status & AxisStatus.CLOCKWISE


@hypothesis.settings(max_examples=20)
@given(st.floats(-4.9, 4.9), st.floats(0.5, 20.0))
@pytest.mark.long
def test_a_move_ends_where_it_should_and_rests(position, speed):
    axis = enabled_axis()
    axis.move_to(position, speed)
    run(axis, 4 + abs(position) / speed)
    assert axis.command == position
    assert axis.feedback == pytest.approx(position, abs=1e-3)
    assert axis.status & AxisStatus.IN_POSITION
    assert not axis.moving
    assert not axis.faults


LIMIT_SIDES = pytest.mark.parametrize(
    ("outward", "fault"),
    [(1, AxisFault.CW_SOFTWARE_LIMIT), (-1, AxisFault.CCW_SOFTWARE_LIMIT)],
    ids=["high", "low"],
)


@LIMIT_SIDES
def test_beyond_a_software_limit_it_stops_and_only_leads_back(outward, fault):
    axis = enabled_axis()
    axis.free_run(4.0 * outward)
    run(axis, 3.0)
    assert axis.faults == fault
    assert axis.command == pytest.approx(5.0 * outward, abs=0.1)
    assert not axis.free_run(-1.0 * outward)
    axis.acknowledge()
    run(axis, 0.1)
    assert not axis.faults, "at rest beyond the limit no fault appears by itself"
    assert axis.free_run(-1.0 * outward)
    run(axis, 1.0)
    assert axis.command * outward < 4.8
    assert not axis.faults


@LIMIT_SIDES
def test_beyond_a_software_limit_a_motion_outward_faults_again(outward, fault):
    axis = enabled_axis()
    axis.free_run(4.0 * outward)
    run(axis, 3.0)
    axis.acknowledge()
    assert axis.free_run(1.0 * outward)
    run(axis, PERIOD_S)
    assert axis.faults == fault


@LIMIT_SIDES
def test_enabled_at_rest_beyond_a_software_limit_an_axis_is_well(outward, fault):
    axis = Axis(parameters())
    axis.step(6.0 * outward, PERIOD_S)
    assert axis.enable()
    run(axis, 0.1)
    assert not axis.faults
    assert axis.free_run(-1.0 * outward)


def test_the_direction_bit_is_of_the_last_motion():
    axis = enabled_axis()
    assert not axis.status & AxisStatus.CLOCKWISE
    for velocity, clockwise in ((1.0, True), (-1.0, False), (1.0, True)):
        axis.free_run(velocity)
        run(axis, 0.3)
        axis.abort()
        run(axis, 0.3)
        assert not axis.moving
        assert bool(axis.status & AxisStatus.CLOCKWISE) is clockwise
    axis.disable()
    run(axis, 0.1)
    assert axis.status & AxisStatus.CLOCKWISE


def test_the_velocity_feedback_is_the_encoders():
    axis = enabled_axis()
    axis.free_run(2.0)
    run(axis, 0.5)
    assert axis.feedback_velocity == pytest.approx(2.0, rel=0.01)
    axis.step(axis.feedback, 0.0)  # a command between two cycles
    assert axis.feedback_velocity == pytest.approx(2.0, rel=0.01)
    axis.disable()
    for _ in range(20):
        axis.step(axis.feedback - 0.001, PERIOD_S)  # turned by hand
    assert axis.feedback_velocity == pytest.approx(-0.5)
    run(axis, 0.1)
    assert axis.feedback_velocity == 0


@pytest.mark.parametrize("end", [Axis.abort, Axis.disable, lambda axis: axis.free_run(0.0)])
def test_homing_that_is_ended_leaves_the_axis_unhomed(end):
    axis = enabled_axis()
    axis.move_to(1.0, 10.0)
    run(axis, 2.0)
    axis.home()
    run(axis, 0.1)
    assert axis.status & AxisStatus.HOMING
    end(axis)
    run(axis, 3.0)
    assert not axis.status & (AxisStatus.HOMING | AxisStatus.HOMED)
    assert axis.command > 0.5


def test_home_is_beside_the_marker_by_the_offset():
    axis = Axis(parameters() | {HOME_OFFSET: 0.25})
    axis.enable()
    encoder = 0.0
    axis.set_program_position(7.0)
    for goal in (1.0, None):
        assert axis.home() if goal is None else axis.move_to(goal, 10.0)
        for _ in range(2000):
            encoder += axis.motor_velocity * PERIOD_S
            axis.step(encoder, PERIOD_S)
    assert axis.homed
    assert encoder == pytest.approx(0.25, abs=1e-3)
    assert axis.feedback == pytest.approx(0.0, abs=1e-3)
    assert axis.command == axis.offset == 0.0


def test_before_it_is_homed_no_software_limit_acts():
    axis = enabled_axis(homed=False)
    axis.move_to(7.0, 10.0)
    run(axis, 3.0)
    assert axis.command == 7.0
    assert not axis.faults
    assert axis.home()
    run(axis, 10.0)
    assert axis.homed
    axis.free_run(4.0)
    run(axis, 3.0)
    assert axis.faults == AxisFault.CW_SOFTWARE_LIMIT


@pytest.mark.parametrize(
    ("masks", "fault", "ends", "powered"),
    [
        ((0, 0x30, 0x30), 0, False, True),
        ((0x30, 0, 0), AxisFault.CW_SOFTWARE_LIMIT, False, True),
        ((0x30, 0, 0x30), AxisFault.CW_SOFTWARE_LIMIT, True, True),
        ((0x30, 0x30, 0), AxisFault.CW_SOFTWARE_LIMIT, True, False),
    ],
)
def test_the_fault_masks_decide_what_a_software_limit_does(masks, fault, ends, powered):
    axis = Axis(parameters() | dict(zip(FAULT_MASKS, masks, strict=True)))
    axis.enable()
    axis.free_run(4.0)
    run(axis, 3.0)
    assert axis.faults == fault
    assert axis.moving is not ends
    assert axis.enabled is powered


def test_without_software_limits_it_runs_on():
    table = parameters() | {Parameter.SOFTWARE_LIMIT_LOW: 0.0, Parameter.SOFTWARE_LIMIT_HIGH: 0.0}
    axis = Axis(table)
    axis.enable()
    axis.free_run(4.0)
    run(axis, 10.0)
    assert axis.command > 30
