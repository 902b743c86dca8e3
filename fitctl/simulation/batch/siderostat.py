"""The siderostat of a batched run: amplifiers, encoders and servo, as ``SiderostatServo`` uses them."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.position_servo import axis_velocity_rad_s, start_move
from fitctl.model.compiled import compilable
from fitctl.model.optics import turned
from fitctl.simulation.batch.records import MOST_HISTORY

Floats = NDArray[np.float64]
_HISTORY = MOST_HISTORY - 1  # a power of two less one


@compilable(inline=True)
def motor_px(s: Any, az_rad: float, el_rad: float) -> tuple[float, float]:
    """``Scales.motor_px``."""
    az, el = turned(s.scale.siderostat_turn, az_rad, el_rad)
    return s.scale.motor_px_per_rad * az, s.scale.motor_px_per_rad * el


@compilable(inline=True)
def motor_rad(s: Any, az_px: float, el_px: float) -> tuple[float, float]:
    """``Scales.motor_rad``."""
    az, el = turned(s.scale.siderostat_back, az_px, el_px)
    return az / s.scale.motor_px_per_rad, el / s.scale.motor_px_per_rad


@compilable()
def siderostat_to(s: Any, r: Any, az_rad: float, el_rad: float) -> None:
    """``SiderostatStage.move_to``."""
    r.setpoint_rad[0] = max(-s.travel_rad, min(s.travel_rad, az_rad))
    r.setpoint_rad[1] = max(-s.travel_rad, min(s.travel_rad, el_rad))
    r.setpoint_is_new = 1


@compilable()
def undo_turn(s: Any, r: Any, az_rad: float, el_rad: float) -> None:
    """``SiderostatStage.undo``."""
    az_rad += r.setpoint_rad[0] + r.beyond_rad[0]
    el_rad += r.setpoint_rad[1] + r.beyond_rad[1]
    siderostat_to(s, r, az_rad, el_rad)
    r.beyond_rad[0] = az_rad - r.setpoint_rad[0]
    r.beyond_rad[1] = el_rad - r.setpoint_rad[1]


@compilable(inline=True)
def read_encoders(s: Any, r: Any, w: Any, plant: Any) -> None:
    """``SimulatedAmplifiers.exchange``, but for the command, and the reading that the servo keeps."""
    entry = r.readings & _HISTORY
    w.read_s[entry] = r.now_s
    for axis in range(2):
        counts = np.floor(plant.motor_rad[axis] / s.servo.resolution_rad)
        r.position_rad[axis] = counts * s.servo.resolution_rad
        w.read_rad[entry, axis] = r.position_rad[axis]
    r.readings += 1


@compilable(inline=True)
def servo_period(s: Any, r: Any, w: Any, plant: Any) -> bool:
    """``SiderostatServo.period``, the plant being there; False where the motors do not follow."""
    if r.setpoint_is_new:
        start_move(s.servo, r.axes[0], r.setpoint_rad[0])
        start_move(s.servo, r.axes[1], r.setpoint_rad[1])
        r.setpoint_is_new = 0
    az_rad_s = axis_velocity_rad_s(s.servo, r.axes[0], r.position_rad[0])
    el_rad_s = axis_velocity_rad_s(s.servo, r.axes[1], r.position_rad[1])
    plant.velocity_rad_s[0], plant.velocity_rad_s[1] = az_rad_s, el_rad_s
    read_encoders(s, r, w, plant)
    following_error_rad = max(
        abs(r.axes[0].reference_rad - r.position_rad[0]),
        abs(r.axes[1].reference_rad - r.position_rad[1]),
    )
    if following_error_rad <= s.following_limit_rad:
        r.followed_s = r.now_s
    return r.now_s - r.followed_s <= s.following_s


@compilable()
def position_at(s: Any, r: Any, w: Any, time_s: float, at_rad: Floats) -> None:
    """``SiderostatServo.position_at``, into `at_rad`."""
    oldest = max(0, r.readings - s.readings)
    for reading in range(r.readings - 1, oldest, -1):
        after, before = reading & _HISTORY, (reading - 1) & _HISTORY
        t1, t0 = w.read_s[after], w.read_s[before]
        if t0 <= time_s:
            part = min(1.0, (time_s - t0) / (t1 - t0)) if t1 > t0 else 1.0
            for axis in range(2):
                start_rad = w.read_rad[before, axis]
                at_rad[axis] = start_rad + part * (w.read_rad[after, axis] - start_rad)
            return
    for axis in range(2):
        at_rad[axis] = w.read_rad[oldest & _HISTORY, axis]
