import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fitctl.controllers.position_servo import PositionServo

GAIN_PER_S, SPEED_RAD_S, ACCELERATION_RAD_S2 = 135.0, 60.0, 6000.0
PERIOD_S, SETPOINT_PERIOD_S = 0.002, 0.02
FOLLOWING_LIMIT_RAD = 1.0  # of the shipped rigs
moves = st.lists(st.tuples(st.floats(-50, 50), st.floats(-50, 50)), min_size=1, max_size=10)


def make_servo():
    return PositionServo(GAIN_PER_S, SPEED_RAD_S, ACCELERATION_RAD_S2, PERIOD_S, SETPOINT_PERIOD_S)


def drive(servo, targets, periods_each=10):
    """Ideal motors under the servo: velocities and positions, shape (periods, 2)."""
    position_rad = (0.0, 0.0)
    velocities, positions = [], []
    for target in targets:
        servo.move_to(target)
        for _ in range(periods_each):
            velocity_rad_s = servo.step(position_rad)
            moved_rad = np.array(position_rad) + np.array(velocity_rad_s) * PERIOD_S
            position_rad = tuple(moved_rad.tolist())
            velocities.append(velocity_rad_s)
            positions.append(position_rad)
    return np.array(velocities), np.array(positions)


def test_at_rest_it_commands_nothing():
    assert make_servo().step((0.0, 0.0)) == (0.0, 0.0)


def test_a_displaced_motor_is_driven_back_in_proportion():
    velocity_rad_s = make_servo().step((0.01, -0.02))
    assert velocity_rad_s == pytest.approx([-GAIN_PER_S * 0.01, GAIN_PER_S * 0.02])


@given(targets=moves)
def test_speed_and_acceleration_stay_within_their_limits(targets):
    velocities, _ = drive(make_servo(), targets)
    assert np.abs(velocities).max() <= SPEED_RAD_S
    change = np.abs(np.diff(velocities, axis=0, prepend=0.0))
    assert change.max() <= ACCELERATION_RAD_S2 * PERIOD_S * (1 + 1e-12)


@pytest.mark.long
@given(targets=moves)
def test_the_motors_arrive_and_stay(targets):
    last = targets[-1]
    _, positions = drive(make_servo(), [*targets, *[last] * 200])
    assert positions[-1] == pytest.approx(np.array(last), abs=1e-6)


def test_between_set_points_the_reference_moves_in_a_straight_line():
    servo = make_servo()
    servo.move_to((0.5, 0.0))
    references = []
    for _ in range(12):
        servo.step((0.0, 0.0))
        references.append(servo.following_error_rad((0.0, 0.0)))
    assert references[:10] == pytest.approx(np.arange(1, 11) * 0.05)
    assert references[10:] == [0.5, 0.5]


def test_a_far_set_point_is_approached_at_the_speed_limit():
    servo = make_servo()
    servo.move_to((30.0, 0.0))
    for _ in range(10):
        servo.step((0.0, 0.0))
    assert servo.following_error_rad((0.0, 0.0)) == pytest.approx(10 * SPEED_RAD_S * PERIOD_S)


def test_the_following_error_is_that_of_the_worse_axis():
    servo = make_servo()
    assert servo.following_error_rad((0.1, -0.3)) == pytest.approx(0.3)


def test_a_reset_forgets_the_motion():
    servo = make_servo()
    drive(servo, [(5.0, 5.0)])
    servo.reset((7.0, 8.0))
    assert servo.step((7.0, 8.0)) == (0.0, 0.0)
    assert servo.following_error_rad((7.0, 8.0)) == 0.0


def test_an_error_below_one_encoder_count_is_left_alone():
    servo = PositionServo(
        GAIN_PER_S, SPEED_RAD_S, ACCELERATION_RAD_S2, PERIOD_S, SETPOINT_PERIOD_S, 0.0016
    )
    velocity_rad_s = servo.step((-0.0015, -0.0017))
    assert velocity_rad_s == pytest.approx([0.0, GAIN_PER_S * 0.0017])


class LaggingMotors:
    """Motors that take a command two periods late, as over a bus, and then follow it within a period."""

    def __init__(self):
        self.position_rad = np.zeros(2)
        self._velocity_rad_s = np.zeros(2)
        self._commands = [np.zeros(2)] * 2

    def turn(self, velocity_rad_s):
        self._commands.append(np.array(velocity_rad_s))
        wanted_rad_s = self._commands.pop(0)
        self._velocity_rad_s += (1 - np.exp(-1)) * (wanted_rad_s - self._velocity_rad_s)
        self.position_rad = self.position_rad + PERIOD_S * self._velocity_rad_s
        return tuple(self.position_rad.tolist())


turns = st.lists(
    st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.integers(1, 6)), min_size=1, max_size=6
)


@given(turns=turns)
@example(turns=[(1.534, 0.0, 1), (-3.645, 0.0, 6)])
def test_motors_that_turn_round_at_full_speed_do_not_look_stuck(turns):
    servo, motors = make_servo(), LaggingMotors()
    position_rad, behind_rad = (0.0, 0.0), []
    for az_rad, el_rad, setpoints in turns:
        for _ in range(setpoints):
            servo.move_to((az_rad, el_rad))
            for _ in range(10):
                position_rad = motors.turn(servo.step(position_rad))
                behind_rad.append(servo.following_error_rad(position_rad))
    assert max(behind_rad) < FOLLOWING_LIMIT_RAD
