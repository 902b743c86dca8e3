"""Set-points of a siderostat: limited by the travel, and what the limit cuts off."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from fitctl.config import default_rig_path, load_rig
from fitctl.stages.siderostat import SiderostatStage


class Servo:
    """Keeps the set-point that it was given last."""

    setpoint_rad = np.zeros(2)

    def move_to(self, setpoint_rad):
        self.setpoint_rad = setpoint_rad

    hold = move_to


@pytest.fixture
def stage():
    return SiderostatStage(load_rig(default_rig_path()), "right", Servo())


def steps(*axes):
    return [np.array([step, -0.5 * step]) for step in axes]


def test_the_servo_is_given_no_setpoint_beyond_the_travel(stage):
    stage.move_to(np.array([3.0, -2.0]) * stage.travel_rad)
    assert stage.servo.setpoint_rad.tolist() == [stage.travel_rad, -stage.travel_rad]
    assert stage.wanted_fraction == 3.0


def test_a_turn_that_is_undone_beyond_the_travels_end_and_goes_back_leaves_the_setpoint_where_it_was(
    stage,
):
    stage.undo_to(np.array([1.0, 2.0]))
    for step in steps(0.7 * stage.travel_rad, 0.7 * stage.travel_rad, -0.2 * stage.travel_rad):
        stage.undo(step)
        assert np.abs(stage.servo.setpoint_rad).max() <= stage.travel_rad
    assert stage.servo.setpoint_rad[0] == stage.travel_rad
    assert stage.wanted_fraction > 1.1
    stage.undo(*steps(-1.2 * stage.travel_rad))
    assert stage.servo.setpoint_rad == pytest.approx([1.0, 2.0], abs=1e-9)


def test_a_place_beyond_the_travel_that_is_undone_is_wanted_until_the_next(stage):
    stage.undo_to(np.array([1.5, 0.0]) * stage.travel_rad)
    assert stage.wanted_rad.tolist() == [1.5 * stage.travel_rad, 0.0]
    stage.undo_to(np.zeros(2))
    assert stage.wanted_rad.tolist() == [0.0, 0.0]


@given(
    st.lists(
        st.tuples(
            st.sampled_from(["move_by", "move_to", "undo", "undo_to"]),
            st.tuples(st.floats(-300.0, 300.0), st.floats(-300.0, 300.0)),
        ),
        max_size=8,
    )
)
@pytest.mark.long
def test_whatever_is_asked_for_no_setpoint_is_beyond_the_travel(moves):
    one = SiderostatStage(load_rig(default_rig_path()), "right", Servo())
    for method, rad in moves:
        getattr(one, method)(np.array(rad))
        assert np.abs(one.servo.setpoint_rad).max() <= one.travel_rad


def test_the_steps_of_a_control_law_are_not_made_up_for(stage):
    for step in steps(1.5 * stage.travel_rad, -0.2 * stage.travel_rad):
        stage.move_by(step)
    assert stage.servo.setpoint_rad[0] == pytest.approx(0.8 * stage.travel_rad)


def test_an_absolute_setpoint_ends_what_was_still_to_be_undone(stage):
    stage.undo(*steps(1.5 * stage.travel_rad))
    stage.move_to(np.zeros(2))
    stage.undo(np.zeros(2))
    assert stage.servo.setpoint_rad.tolist() == [0.0, 0.0]


def test_holding_where_the_motors_are_ends_it_too(stage):
    stage.undo(*steps(1.5 * stage.travel_rad))
    stage.hold(np.zeros(2))
    stage.undo(np.zeros(2))
    assert stage.servo.setpoint_rad.tolist() == [0.0, 0.0]
