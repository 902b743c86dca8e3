"""The siderostat's position servo: proportional, in software around the amplifiers' velocity mode."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from fitctl.config import Siderostat
from fitctl.model.compiled import compilable
from fitctl.model.optics import AzEl


@dataclass(slots=True)
class Axis:
    """One axis: where its motor shall be, and what moves it there.

    `moving_rad` is how far the reference moved in the last period; it falls to zero, at a rate that the
    motor can follow, before the reference turns round.
    """

    target_rad: float
    reference_rad: float
    step_rad: float = 0.0
    moving_rad: float = 0.0
    velocity_rad_s: float = 0.0


@compilable()
def start_move(servo: Any, axis: Any, target_rad: float) -> None:
    """Let one axis be at `target_rad` one set-point period from now, or as soon as the limit allows."""
    most_rad = servo.velocity_limit_rad_s * servo.period_s
    axis.target_rad = target_rad
    step_rad = (target_rad - axis.reference_rad) / servo.periods_per_setpoint
    axis.step_rad = step_rad if abs(step_rad) <= most_rad else math.copysign(most_rad, step_rad)


@compilable(inline=True)
def axis_velocity_rad_s(servo: Any, axis: Any, position_rad: float) -> float:
    """One servo period of one axis: the velocity command for the measured motor angle."""
    # In line and by comparison: it runs 500 times a second for each axis.
    left_rad, step_rad = axis.target_rad - axis.reference_rad, axis.step_rad
    moving_rad, brake_rad = axis.moving_rad, servo.brake_rad
    # The motor, too, has to turn round; without the wait it would be behind until the move ends.
    turns_round = moving_rad * step_rad < 0.0 and not -brake_rad <= moving_rad <= brake_rad
    reference_rad = axis.reference_rad
    if left_rad == 0.0 or turns_round:
        axis.moving_rad = max(0.0, moving_rad - brake_rad) + min(0.0, moving_rad + brake_rad)
    else:
        axis.moving_rad = step_rad
        if -step_rad <= left_rad <= step_rad or step_rad <= left_rad <= -step_rad:
            reference_rad = axis.target_rad
        else:
            reference_rad += step_rad
    axis.reference_rad = reference_rad
    error_rad = reference_rad - position_rad
    if -servo.resolution_rad < error_rad < servo.resolution_rad:
        error_rad = 0.0
    wanted_rad_s, limit_rad_s = servo.gain_per_s * error_rad, servo.velocity_limit_rad_s
    if wanted_rad_s > limit_rad_s:
        wanted_rad_s = limit_rad_s
    elif wanted_rad_s < -limit_rad_s:
        wanted_rad_s = -limit_rad_s
    velocity_rad_s, most_rad_s = axis.velocity_rad_s, servo.velocity_step_rad_s
    change_rad_s = wanted_rad_s - velocity_rad_s
    if change_rad_s > most_rad_s:
        change_rad_s = most_rad_s
    elif change_rad_s < -most_rad_s:
        change_rad_s = -most_rad_s
    velocity_rad_s += change_rad_s
    axis.velocity_rad_s = velocity_rad_s
    return velocity_rad_s


class PositionServo:
    """Motor angle to velocity command, both axes.

    Set-points come at the frame rate; between them the reference moves in a straight line, so that a
    search is a smooth walk. Before it turns round it waits until the motor has slowed down: a motor
    that still turns the other way would look stuck until the move ends. With the amplifier's own lag and
    one period of latency the loop is a second-order one of 45 Hz. Both axes' angles and velocities are
    pairs of plain floats, which are several times quicker than arrays.

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
        self.gain_per_s = gain_per_s
        self.velocity_limit_rad_s = velocity_limit_rad_s
        self.velocity_step_rad_s = acceleration_limit_rad_s2 * period_s
        # Half of what the motor can: it is behind by its lag.
        self.brake_rad = 0.5 * self.velocity_step_rad_s * period_s
        self.period_s = period_s
        self.resolution_rad = resolution_rad
        self.periods_per_setpoint = max(1, round(setpoint_period_s / period_s))
        self.reset((0.0, 0.0))

    def reset(self, position_rad: AzEl) -> None:
        """Rest at `position_rad`."""
        az_rad, el_rad = position_rad
        self._az, self._el = Axis(az_rad, az_rad), Axis(el_rad, el_rad)

    def move_to(self, target_rad: AzEl) -> None:
        """Be at `target_rad` one set-point period from now, or as soon as the limit allows."""
        az_rad, el_rad = target_rad
        start_move(self, self._az, az_rad)
        start_move(self, self._el, el_rad)

    def step(self, position_rad: AzEl) -> AzEl:
        """One servo period: velocity command for the measured motor angles."""
        az_rad, el_rad = position_rad
        return (
            axis_velocity_rad_s(self, self._az, az_rad),
            axis_velocity_rad_s(self, self._el, el_rad),
        )

    def following_error_rad(self, position_rad: AzEl) -> float:
        """How far the motors are from the moving reference; the larger of the axes."""
        az_rad, el_rad = position_rad
        az_error_rad = abs(self._az.reference_rad - az_rad)
        el_error_rad = abs(self._el.reference_rad - el_rad)
        return az_error_rad if az_error_rad > el_error_rad else el_error_rad


def position_servo(siderostat: Siderostat, setpoint_period_s: float) -> PositionServo:
    """The servo that a rig file asks for, with set-points `setpoint_period_s` apart."""
    return PositionServo(
        siderostat.servo.gain_per_s,
        siderostat.velocity_limit_rad_s,
        siderostat.acceleration_limit_rad_s2,
        1.0 / siderostat.servo.rate_hz,
        setpoint_period_s,
        siderostat.encoder_count_rad,
    )
