"""How a hexapod gets from pose to pose: trapezoidal velocity on six axes that end together.

A pose is six numbers, X Y Z in mm and U V W in degrees. Each axis accelerates at a constant rate to a
cruise velocity, keeps it and decelerates at the same rate. The axis that needs longest goes as fast as its
limits allow; the others cruise slower, so that all arrive at one time. From rest, or where the target lies on
the line along which the hexapod moves already, all axes share one profile and the path is straight.

A trajectory can be planned anew at any time: the new one begins with the pose and the velocity of the old one,
so that both are continuous, and only the acceleration steps.

With v0 the velocity at the start, a the acceleration, d the distance left and T the time that it may take:
where d > v0 abs(v0) / 2 a (else all signs change), the axis cruises at vc > 0, and

    T = (vc - v0) / a + (d + v0**2 / 2 a) / vc    for vc >= v0,
    T = v0 / a + (d - v0**2 / 2 a) / vc           for vc < v0.

Both fall with vc, and they meet at vc = v0: every T above the shortest has one vc, in closed form.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
AXES = 6
_REMEMBERED = 100
_TRANSLATIONS, _ROTATIONS = slice(0, 3), slice(3, 6)
_STRAIGHT = 1e-9  # sine of the angle between velocity and way within which they are one line
_NO_WAY = 1e-13  # mm or degrees: below, rounding decides
_NO_VELOCITY = 1e-290  # mm/s or degrees/s: below, floats have no digits left for a direction
_LEAST_PART = 1e-12  # of the line, so that no axis has an acceleration of zero


class MotionLimits(NamedTuple):
    """How fast the platform may move.

    Attributes
    ----------
    velocity_mm_s, acceleration_mm_s2 : float
        Along a straight line, of the platform; otherwise of each of X, Y and Z.
    velocity_deg_s, acceleration_deg_s2 : float
        Likewise of U, V and W.
    """

    velocity_mm_s: float
    velocity_deg_s: float
    acceleration_mm_s2: float
    acceleration_deg_s2: float


@dataclass(frozen=True)
class Trajectory:
    """Where the platform is at any time from the start of the plan on.

    Attributes
    ----------
    target : array, shape (6,)
        Where it ends, at rest.
    ends_s : float
        When the last axis arrives.
    """

    target: Floats
    ends_s: float
    _starts_s: (
        Floats  # of each axis' phases, shape (4, 6): acceleration, cruise, deceleration, rest
    )
    _pose: Floats  # there, likewise
    _velocity: Floats
    _acceleration: Floats

    def pose_at(self, time_s: ArrayLike) -> Floats:
        """The pose at one time, shape (6,), or at many, shape (..., 6); before the plan, where it begins."""
        since_s, phase, axis = self._phases(time_s)
        moved = since_s * (
            self._velocity[phase, axis] + since_s / 2 * self._acceleration[phase, axis]
        )
        return self._pose[phase, axis] + moved

    def velocity_at(self, time_s: ArrayLike) -> Floats:
        """Velocities in mm/s and degrees/s, shapes as of :meth:`pose_at`."""
        since_s, phase, axis = self._phases(time_s)
        return self._velocity[phase, axis] + since_s * self._acceleration[phase, axis]

    def moving_at(self, time_s: float) -> tuple[bool, ...]:
        """Which axes have not arrived yet."""
        return tuple(bool(rests_s > time_s) for rests_s in self._starts_s[-1])

    def _phases(self, time_s: ArrayLike) -> tuple[Floats, NDArray[np.intp], NDArray[np.intp]]:
        times_s = np.asarray(time_s, dtype=np.float64)[..., None]
        phase = sum((times_s >= start_s).astype(np.intp) for start_s in self._starts_s[1:])
        phase = np.asarray(phase, dtype=np.intp)
        axis = np.broadcast_to(np.arange(AXES), phase.shape)
        return np.maximum(times_s - self._starts_s[phase, axis], 0.0), phase, axis


class HexapodMotion:
    """A platform that is given targets as time goes on; its recent past stays exact.

    Parameters
    ----------
    pose : sequence of six floats
        Where it stands.
    """

    def __init__(self, pose: Sequence[float] | Floats = (0.0,) * AXES) -> None:
        self._plans = deque([(-math.inf, at_rest(pose))], maxlen=_REMEMBERED)

    @property
    def target(self) -> Floats:
        """Where it ends, shape (6,)."""
        return self._plans[-1][1].target

    @property
    def ends_s(self) -> float:
        """When it arrives."""
        return self._plans[-1][1].ends_s

    def move_to(
        self, time_s: float, target: Sequence[float] | Floats, limits: MotionLimits
    ) -> None:
        """Go to `target` from `time_s` on; times must not go back."""
        self._plans.append((time_s, plan_move(self._plans[-1][1], time_s, target, limits)))

    def stop(self, time_s: float, limits: MotionLimits) -> None:
        """Brake from `time_s` on."""
        self._plans.append((time_s, plan_stop(self._plans[-1][1], time_s, limits)))

    def pose_at(self, time_s: float) -> Floats:
        """The pose at a time, shape (6,); exact unless more than a hundred plans have been made since."""
        return self._plan_at(time_s).pose_at(time_s)

    def velocity_at(self, time_s: float) -> Floats:
        """Velocities in mm/s and degrees/s, shape (6,)."""
        return self._plan_at(time_s).velocity_at(time_s)

    def moving_at(self, time_s: float) -> tuple[bool, ...]:
        """Which axes have not arrived yet."""
        return self._plan_at(time_s).moving_at(time_s)

    def plans_since(self, time_s: float) -> list[tuple[float, Trajectory]]:
        """The plans made after a time, oldest first: when each begins, and what it is."""
        return [plan for plan in self._plans if plan[0] > time_s]

    def _plan_at(self, time_s: float) -> Trajectory:
        plans = reversed(self._plans)
        return next((plan for since_s, plan in plans if since_s <= time_s), self._plans[0][1])


def at_rest(pose: Sequence[float] | Floats) -> Trajectory:
    """A hexapod that stands still."""
    where = np.array(pose, dtype=np.float64)
    still = np.zeros((4, AXES))
    return Trajectory(where, 0.0, np.zeros((4, AXES)), np.tile(where, (4, 1)), still, still)


def plan_move(
    now: Trajectory, time_s: float, target: Sequence[float] | Floats, limits: MotionLimits
) -> Trajectory:
    """From where `now` is at `time_s`, moving as it is then, to `target`, as fast as the limits allow.

    Velocities above the limits at the start, of a plan with others, come down to them.
    """
    pose, velocity = now.pose_at(time_s), now.velocity_at(time_s)
    goal = np.array(target, dtype=np.float64)
    cruise, acceleration = _axis_limits(goal - pose, velocity, limits)
    each = np.transpose([pose, velocity, goal, cruise, acceleration])
    axes = [_Axis(*one) for one in each.tolist()]
    lasts_s = max(axis.shortest_s for axis in axes)
    return _trajectory(time_s, goal, [axis.phases(lasts_s) for axis in axes])


def plan_stop(now: Trajectory, time_s: float, limits: MotionLimits) -> Trajectory:
    """Brake all axes together, as hard as the limits allow; along a straight line if they move on one."""
    pose, velocity = now.pose_at(time_s), now.velocity_at(time_s)
    lasts_s = max(
        math.hypot(*velocity[_TRANSLATIONS]) / limits.acceleration_mm_s2,
        math.hypot(*velocity[_ROTATIONS]) / limits.acceleration_deg_s2,
    )
    goal = pose + velocity * lasts_s / 2
    rates = -velocity / lasts_s if lasts_s else velocity
    each = np.transpose([pose, velocity, rates]).tolist()
    return _trajectory(time_s, goal, [_phases(x, v, a, lasts_s, 0.0, 0.0) for x, v, a in each])


def _axis_limits(way: Floats, velocity: Floats, limits: MotionLimits) -> tuple[Floats, Floats]:
    """Velocity and acceleration that each axis may have, so that a straight way is gone straight."""
    most = [limits.velocity_mm_s] * 3 + [limits.velocity_deg_s] * 3
    hardest = [limits.acceleration_mm_s2] * 3 + [limits.acceleration_deg_s2] * 3
    line = way if np.any(way) else velocity
    size = math.hypot(*line)
    if size == 0:
        return np.array(most), np.array(hardest)
    line = line / size
    across = velocity - line * (velocity @ line)
    if math.hypot(*across) > _STRAIGHT * math.hypot(*velocity):
        return np.array(most), np.array(hardest)
    mm, deg = math.hypot(*line[_TRANSLATIONS]), math.hypot(*line[_ROTATIONS])
    speed = _least(limits.velocity_mm_s, mm, limits.velocity_deg_s, deg)
    rate = _least(limits.acceleration_mm_s2, mm, limits.acceleration_deg_s2, deg)
    # Rounding can leave an axis a velocity that its way does not ask for: it is braked with the others.
    moves = math.hypot(*velocity)
    along = np.abs(velocity) / moves if moves > _NO_VELOCITY else np.zeros(AXES)
    parts = np.maximum(np.maximum(np.abs(line), along), _LEAST_PART)
    return speed * parts, rate * parts


def _least(limit_mm: float, mm: float, limit_deg: float, deg: float) -> float:
    """What is allowed along a line whose unit has so many mm and degrees."""
    return min(limit_mm / mm if mm else math.inf, limit_deg / deg if deg else math.inf)


class _Axis:
    """One axis' way, turned so that its cruise is positive."""

    def __init__(self, x: float, v0: float, goal: float, most: float, a: float) -> None:
        self._x, self._v0, self._a = x, v0, a
        beyond = goal - x - v0 * abs(v0) / (2 * a)  # of where it comes to rest if it brakes now
        self._sign = math.copysign(1.0, beyond)
        self._v, self._d = self._sign * v0, self._sign * (goal - x)
        self._reach = max(self._d + self._v**2 / (2 * a), 0.0)
        self._fastest = min(most, math.sqrt(a * self._reach))
        self._brakes = abs(beyond) < _NO_WAY or self._reach < _NO_WAY
        self.shortest_s = abs(v0) / a if self._brakes else self._lasts_s(self._fastest)

    def _lasts_s(self, cruise: float) -> float:
        v, a = self._v, self._a
        if cruise >= v:
            return (cruise - v) / a + self._reach / cruise
        return v / a + (self._d - v * v / (2 * a)) / cruise

    def phases(self, lasts_s: float) -> _Phases:
        """Arrive after `lasts_s`, by the cruise velocity that takes so long."""
        v, a = self._v, self._a
        if self._brakes:
            braked_s = abs(self._v0) / a
            return _phases(self._x, self._v0, -math.copysign(a, self._v0), braked_s, 0.0, 0.0)
        if v > 0 and lasts_s > self._lasts_s(v):
            cruise = min((self._d - v * v / (2 * a)) / (lasts_s - v / a), v)
        else:
            whole = lasts_s + v / a
            root = math.sqrt(max(whole * whole - 4 * self._reach / a, 0.0))
            cruise = min(2 * self._reach / (whole + root), self._fastest)
        to_cruise_s, to_rest_s = abs(cruise - v) / a, cruise / a
        kept_s = max(lasts_s - to_cruise_s - to_rest_s, 0.0)
        first = self._sign * math.copysign(a, cruise - v)
        return _phases(self._x, self._v0, first, to_cruise_s, kept_s, to_rest_s)


class _Phases(NamedTuple):
    """Durations of an axis' first three phases, then what each of the four begins with."""

    lasts_s: tuple[float, float, float]
    pose: tuple[float, float, float, float]
    velocity: tuple[float, float, float, float]
    acceleration: tuple[float, float, float, float]


def _phases(
    x: float, v0: float, first: float, first_s: float, kept_s: float, last_s: float
) -> _Phases:
    cruise = v0 + first * first_s if last_s or kept_s else 0.0
    last = -cruise / last_s if last_s else 0.0
    x1 = x + first_s * (v0 + cruise) / 2
    x2 = x1 + kept_s * cruise
    x3 = x2 + last_s * cruise / 2
    return _Phases(
        (first_s, kept_s, last_s),
        (x, x1, x2, x3),
        (v0, cruise, cruise, 0.0),
        (first, 0.0, last, 0.0),
    )


def _trajectory(time_s: float, goal: Floats, axes: list[_Phases]) -> Trajectory:
    lasts_s = np.array([axis.lasts_s for axis in axes]).T
    starts_s = time_s + np.concatenate([np.zeros((1, AXES)), np.cumsum(lasts_s, axis=0)])
    pose = np.array([axis.pose for axis in axes]).T
    pose[-1] = goal
    return Trajectory(
        goal,
        float(starts_s[-1].max()),
        starts_s,
        pose,
        np.array([axis.velocity for axis in axes]).T,
        np.array([axis.acceleration for axis in axes]).T,
    )
