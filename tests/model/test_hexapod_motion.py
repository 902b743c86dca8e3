"""Trapezoidal moves of six axes: limits, ends, and what holds when a move is planned anew in motion."""

import itertools
import math

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from fitctl.model.hexapod_motion import HexapodMotion, MotionLimits, at_rest, plan_move, plan_stop

LIMITS = MotionLimits(8.0, 6.0, 20.0, 15.0)
MOST = np.array([8.0] * 3 + [6.0] * 3)
HARDEST = np.array([20.0] * 3 + [15.0] * 3)
START = (1.0, -2.0, 3.0, 0.5, 0.0, -4.0)

poses = st.tuples(
    *[st.one_of(st.just(0.0), st.floats(-50, 50), st.floats(-1e-3, 1e-3)) for _ in range(6)]
)
courses = st.lists(st.tuples(poses, st.floats(0.0, 6.0)), min_size=1, max_size=6)


def course(moves):
    """The trajectories of moves, each planned a time after the one before, and when each began."""
    planned, now_s = [(0.0, at_rest(START))], 0.0
    for target, after_s in moves:
        now_s += after_s
        planned.append((now_s, plan_move(planned[-1][1], now_s, target, LIMITS)))
    return planned


def test_a_short_move_accelerates_halfway_and_decelerates():
    move = plan_move(at_rest([0.0] * 6), 0.0, (0.2, 0, 0, 0, 0, 0), LIMITS)
    assert move.ends_s == pytest.approx(2 * math.sqrt(0.2 / 20.0))
    halfway_s = move.ends_s / 2
    assert move.pose_at(halfway_s)[0] == pytest.approx(0.1)
    assert move.velocity_at(halfway_s)[0] == pytest.approx(20.0 * halfway_s)


def test_a_long_move_cruises_at_the_limit():
    move = plan_move(at_rest([0.0] * 6), 5.0, (0, -40.0, 0, 0, 0, 0), LIMITS)
    assert move.ends_s == pytest.approx(5.0 + 40.0 / 8.0 + 8.0 / 20.0)
    assert move.velocity_at(7.0)[1] == pytest.approx(-8.0)
    assert move.pose_at(move.ends_s + 100.0) == pytest.approx([0, -40.0, 0, 0, 0, 0], abs=1e-15)


def test_a_pose_is_read_at_many_times_at_once():
    move = plan_move(at_rest(START), 0.0, (10.0, 0, 0, 0, 0, 0), LIMITS)
    times_s = np.linspace(-1.0, 3.0, 12).reshape(3, 4)
    poses_then = move.pose_at(times_s)
    assert poses_then.shape == (3, 4, 6)
    assert np.array_equal(poses_then[1, 2], move.pose_at(times_s[1, 2]))
    assert np.array_equal(poses_then[0, 0], START), "before the plan, where it began"


@given(target=poses)
def test_from_rest_the_way_is_straight_and_the_platform_within_its_limits(target):
    move = plan_move(at_rest(START), 0.0, target, LIMITS)
    times_s = np.linspace(0.0, move.ends_s, 200)
    way = np.array(target) - START
    gone = (move.pose_at(times_s) - START) @ way / max(way @ way, 1e-300)
    assert np.allclose(move.pose_at(times_s), START + gone[:, None] * way, atol=1e-9)
    velocities = move.velocity_at(times_s)
    assert np.all(np.hypot.reduce(velocities[:, :3], axis=1) <= 8.0 * (1 + 1e-9))
    assert np.all(np.hypot.reduce(velocities[:, 3:], axis=1) <= 6.0 * (1 + 1e-9))


@given(moves=courses)
@pytest.mark.long
def test_every_plan_ends_at_its_target_at_rest(moves):
    for (_, trajectory), (target, _) in zip(course(moves)[1:], moves, strict=True):
        before_s = math.nextafter(trajectory.ends_s, -math.inf)
        assert np.allclose(trajectory.pose_at(before_s), target, atol=1e-8)
        assert np.allclose(trajectory.velocity_at(before_s), 0.0, atol=1e-4)
        assert np.array_equal(trajectory.pose_at(trajectory.ends_s), target)
        assert not np.any(trajectory.velocity_at(trajectory.ends_s))


@given(moves=courses)
@pytest.mark.long
def test_pose_and_velocity_are_continuous_where_a_move_is_planned_anew(moves):
    planned = course(moves)
    for (_, before), (began_s, after) in itertools.pairwise(planned):
        assert np.allclose(before.pose_at(began_s), after.pose_at(began_s), atol=1e-9)
        assert np.allclose(before.velocity_at(began_s), after.velocity_at(began_s), atol=1e-9)


@pytest.mark.long
@example(
    moves=[  # planned anew while it brakes already, onto the same target: rounding decides
        ((0, 0, 0, 0, 0, 0), 0.0),
        ((0, 0, 12.375, 0, 0, 0), 0.0),
        ((0, 0, 0, 0, 28.82334187045789, 0), 4.0),
        ((0, 0, 0, 0, 28.82334187045789, 0), 5.143638933526166),
    ]
)
@example(  # planned anew when its velocity is too small to have a direction
    moves=[((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 0.0), ((1.0, 0.0, 0.0, 0.0, 0.0, 0.0), 5e-324)]
)
@given(moves=courses)
def test_no_axis_passes_its_velocity_or_acceleration(moves):
    for began_s, trajectory in course(moves):
        times_s = np.linspace(began_s, trajectory.ends_s + 0.1, 400)
        velocities = trajectory.velocity_at(times_s)
        assert np.all(np.abs(velocities) <= MOST * (1 + 1e-9))
        changes = np.abs(np.diff(velocities, axis=0))
        assert np.all(changes <= HARDEST * (times_s[1] - times_s[0]) * (1 + 1e-6) + 1e-9)
        # The pose is the integral of that velocity, which is linear but for a few corners.
        steps = np.diff(trajectory.pose_at(times_s), axis=0)
        means = (velocities[1:] + velocities[:-1]) / 2 * (times_s[1] - times_s[0])
        assert np.allclose(steps, means, atol=20.0 * (times_s[1] - times_s[0]) ** 2)


@given(after_s=st.floats(0.0, 6.0), lower=st.floats(0.05, 1.0), goal=st.floats(-50, 50))
def test_a_lower_velocity_limit_is_reached_and_kept(after_s, lower, goal):
    fast = plan_move(at_rest([0.0] * 6), 0.0, (50.0, 0, 0, 0, 0, 0), LIMITS)
    slow = LIMITS._replace(velocity_mm_s=8.0 * lower)
    move = plan_move(fast, after_s, (goal, 0, 0, 0, 0, 0), slow)
    braked_s = after_s + 8.0 / 20.0
    times_s = np.linspace(braked_s, max(move.ends_s, braked_s), 200)
    assert np.all(np.abs(move.velocity_at(times_s)) <= 8.0 * lower * (1 + 1e-9))


@given(moves=courses, after_s=st.floats(0.0, 4.0))
@pytest.mark.long
def test_a_stop_brakes_all_axes_together_along_their_line(moves, after_s):
    began_s, trajectory = course(moves)[-1]
    at_s = began_s + after_s
    stop = plan_stop(trajectory, at_s, LIMITS)
    pose, velocity = trajectory.pose_at(at_s), trajectory.velocity_at(at_s)
    assert stop.ends_s - at_s <= math.sqrt(3) * max(8.0 / 20.0, 6.0 / 15.0) * (1 + 1e-9)
    halfway = (stop.ends_s + at_s) / 2
    assert np.allclose(stop.velocity_at(halfway), velocity / 2, atol=1e-9)
    assert np.allclose(stop.target, pose + velocity * (stop.ends_s - at_s) / 2, atol=1e-9)
    assert np.array_equal(stop.pose_at(stop.ends_s), stop.target)


@pytest.mark.long
@pytest.mark.parametrize("rate_hz", [20, 50])
def test_targets_streamed_along_a_sine_are_followed_smoothly(rate_hz):
    """1 mm at 0.05 Hz, as the collector moves: the platform stays within a period's way of the sine."""
    direction = np.array([0.8, 0.6, 0, 0, 0, 0])
    motion, now_s, errors, speeds = at_rest([0.0] * 6), 0.0, [], []
    while now_s < 40.0:
        wanted = math.sin(2 * math.pi * 0.05 * (now_s + 1 / rate_hz))
        motion = plan_move(motion, now_s, wanted * direction, LIMITS)
        times_s = now_s + np.arange(20) / 20 / rate_hz
        along = motion.pose_at(times_s) @ direction
        errors.append(along - np.sin(2 * math.pi * 0.05 * times_s))
        speeds.append(np.abs(motion.velocity_at(times_s) @ direction))
        now_s += 1 / rate_hz
    fastest = 2 * math.pi * 0.05
    assert np.max(np.abs(errors)) <= fastest / rate_hz
    assert np.max(speeds) <= 2 * fastest


@given(moves=courses)
@pytest.mark.long
def test_a_motion_remembers_where_it_was_before_it_was_planned_anew(moves):
    motion, now_s, seen = HexapodMotion(START), 0.0, []
    for target, after_s in moves:
        seen += [(at_s, motion.pose_at(at_s)) for at_s in (now_s, now_s + after_s * 0.7)]
        now_s += after_s
        motion.move_to(now_s, target, LIMITS)
    for at_s, pose in seen:
        assert np.allclose(motion.pose_at(at_s), pose, atol=1e-9)
    motion.stop(now_s, LIMITS)
    assert not any(motion.moving_at(now_s + 1.0))
    assert np.array_equal(motion.pose_at(now_s + 1.0), motion.target)
