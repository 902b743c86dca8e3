"""The siderostat's position servo: proportional, in software around the amplifiers' velocity mode."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


class PositionServo:
    """Motor angle to velocity command, both axes.

    Set-points come at the frame rate; between them the reference moves in a straight line, so that a
    search is a smooth walk. With the amplifier's own lag and one period of latency the loop is a
    second-order one of 45 Hz.

    Parameters
    ----------
    gain_per_s : float
        Velocity command per position error.
    velocity_limit_rad_s, acceleration_limit_rad_s2 : float
        Of the motor.
    period_s, setpoint_period_s : float
        The servo's own, and the time between set-points.
    """

    def __init__(
        self,
        gain_per_s: float,
        velocity_limit_rad_s: float,
        acceleration_limit_rad_s2: float,
        period_s: float,
        setpoint_period_s: float,
    ) -> None:
        self._gain_per_s = gain_per_s
        self._velocity_limit = velocity_limit_rad_s
        self._velocity_step = acceleration_limit_rad_s2 * period_s
        self._period_s = period_s
        self._periods_per_setpoint = max(1, round(setpoint_period_s / period_s))
        self.reset(np.zeros(2))

    def reset(self, position_rad: Floats) -> None:
        """Rest at `position_rad`, shape (2,)."""
        self.reference_rad = np.array(position_rad, dtype=float)
        self._target_rad = self.reference_rad
        self._step_rad = np.zeros(2)
        self._velocity_rad_s = np.zeros(2)

    def move_to(self, target_rad: Floats) -> None:
        """Be at `target_rad`, shape (2,), one set-point period from now, or as soon as the limit allows."""
        self._target_rad = np.array(target_rad, dtype=float)
        most = self._velocity_limit * self._period_s
        step = (self._target_rad - self.reference_rad) / self._periods_per_setpoint
        self._step_rad = np.clip(step, -most, most)

    def step(self, position_rad: Floats) -> Floats:
        """One servo period: velocity command, shape (2,), for the measured motor angles."""
        left = self._target_rad - self.reference_rad
        arrives = np.abs(left) <= np.abs(self._step_rad)
        self.reference_rad = np.where(
            arrives, self._target_rad, self.reference_rad + self._step_rad
        )
        wanted = self._gain_per_s * (self.reference_rad - position_rad)
        wanted = np.clip(wanted, -self._velocity_limit, self._velocity_limit)
        change = np.clip(wanted - self._velocity_rad_s, -self._velocity_step, self._velocity_step)
        self._velocity_rad_s = self._velocity_rad_s + change
        return self._velocity_rad_s
