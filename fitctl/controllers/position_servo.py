"""The siderostat's position servo: proportional, in software around the amplifiers' velocity mode."""

from __future__ import annotations

import math
from dataclasses import dataclass

AzEl = tuple[float, float]


@dataclass(slots=True)
class _Axis:
    """One axis: where its motor shall be, and what moves it there."""

    target_rad: float
    reference_rad: float
    step_rad: float = 0.0
    velocity_rad_s: float = 0.0


class PositionServo:
    """Motor angle to velocity command, both axes.

    Set-points come at the frame rate; between them the reference moves in a straight line, so that a
    search is a smooth walk. With the amplifier's own lag and one period of latency the loop is a
    second-order one of 45 Hz. Both axes' angles and velocities are pairs of plain floats, which are
    several times quicker than arrays.

    Parameters
    ----------
    gain_per_s : float
        Velocity command per position error.
    velocity_limit_rad_s, acceleration_limit_rad_s2 : float
        Of the motor.
    period_s, setpoint_period_s : float
        The servo's own, and the time between set-points.
    resolution_rad : float
        One encoder count. A smaller error is left alone: acting on it would hunt between two counts.
    """

    def __init__(
        self,
        gain_per_s: float,
        velocity_limit_rad_s: float,
        acceleration_limit_rad_s2: float,
        period_s: float,
        setpoint_period_s: float,
        resolution_rad: float = 0.0,
    ) -> None:
        self._gain_per_s = gain_per_s
        self._velocity_limit = velocity_limit_rad_s
        self._velocity_step = acceleration_limit_rad_s2 * period_s
        self._period_s = period_s
        self._resolution_rad = resolution_rad
        self._periods_per_setpoint = max(1, round(setpoint_period_s / period_s))
        self.reset((0.0, 0.0))

    def reset(self, position_rad: AzEl) -> None:
        """Rest at `position_rad`."""
        az_rad, el_rad = position_rad
        self._az, self._el = _Axis(az_rad, az_rad), _Axis(el_rad, el_rad)

    def move_to(self, target_rad: AzEl) -> None:
        """Be at `target_rad` one set-point period from now, or as soon as the limit allows."""
        most = self._velocity_limit * self._period_s
        for axis, target in zip((self._az, self._el), target_rad, strict=True):
            axis.target_rad = target
            step_rad = (target - axis.reference_rad) / self._periods_per_setpoint
            axis.step_rad = step_rad if abs(step_rad) <= most else math.copysign(most, step_rad)

    def step(self, position_rad: AzEl) -> AzEl:
        """One servo period: velocity command for the measured motor angles."""
        az_rad, el_rad = position_rad
        return self._velocity_rad_s(self._az, az_rad), self._velocity_rad_s(self._el, el_rad)

    def following_error_rad(self, position_rad: AzEl) -> float:
        """How far the motors are from the moving reference; the larger of the axes."""
        az_rad, el_rad = position_rad
        az_error_rad = abs(self._az.reference_rad - az_rad)
        el_error_rad = abs(self._el.reference_rad - el_rad)
        return az_error_rad if az_error_rad > el_error_rad else el_error_rad

    def _velocity_rad_s(self, axis: _Axis, position_rad: float) -> float:
        # In line and by comparison: it runs 500 times a second for each axis.
        left_rad, step_rad = axis.target_rad - axis.reference_rad, axis.step_rad
        if -step_rad <= left_rad <= step_rad or step_rad <= left_rad <= -step_rad:
            axis.reference_rad = axis.target_rad
        else:
            axis.reference_rad += step_rad
        error_rad = axis.reference_rad - position_rad
        if -self._resolution_rad < error_rad < self._resolution_rad:
            error_rad = 0.0
        wanted_rad_s, limit_rad_s = self._gain_per_s * error_rad, self._velocity_limit
        if wanted_rad_s > limit_rad_s:
            wanted_rad_s = limit_rad_s
        elif wanted_rad_s < -limit_rad_s:
            wanted_rad_s = -limit_rad_s
        was_rad_s, most_rad_s = axis.velocity_rad_s, self._velocity_step
        change_rad_s = wanted_rad_s - was_rad_s
        if change_rad_s > most_rad_s:
            change_rad_s = most_rad_s
        elif change_rad_s < -most_rad_s:
            change_rad_s = -most_rad_s
        axis.velocity_rad_s = velocity_rad_s = was_rad_s + change_rad_s
        return velocity_rad_s
