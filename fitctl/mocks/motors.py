"""What a mock amplifier turns: two motors with encoders, and what can go wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from fitctl.mocks.faults import FaultKind, Faults

AXES = ("az", "el")

AXIS_FAULTS = {
    "amplifier_fault": FaultKind(
        "an amplifier is in fault; when this has ended, until it is reset", parts=AXES
    ),
    "encoder_jump": FaultKind("an encoder counts that much more", "counts", 1000, AXES),
    "stuck_axis": FaultKind("a motor does not turn, whatever its amplifier does", parts=AXES),
}


class Motors(Protocol):
    """The plant's side of an amplifier."""

    def position_rad(self) -> Sequence[float]:
        """Both motors' angles now."""
        ...

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors at these velocities; to be said again and again."""
        ...

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give one motor current, or take it away."""
        ...


class FaultyMotors:
    """Motors and encoders as `AXIS_FAULTS` have them: a jumped encoder, a stuck axis.

    Parameters
    ----------
    motors : Motors
    faults : Faults
        With `AXIS_FAULTS` among its kinds.
    counts_per_rad : float
        Of the encoders.
    """

    def __init__(self, motors: Motors, faults: Faults, counts_per_rad: float) -> None:
        self._motors = motors
        self._counts_per_rad = counts_per_rad
        self._faults = faults

    def position_rad(self) -> tuple[float, float]:
        """What the encoders say."""
        az_rad, el_rad = self._motors.position_rad()
        return az_rad + self._jump_rad("az"), el_rad + self._jump_rad("el")

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors that turn."""
        az, el = (
            0.0 if self._faults.strikes("stuck_axis", axis) else velocity
            for axis, velocity in zip(AXES, (az, el), strict=True)
        )
        self._motors.command_velocity_rad_s(az, el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give one motor current, or take it away."""
        self._motors.set_enabled(axis, enabled)

    def _jump_rad(self, axis: str) -> float:
        return (self._faults.value("encoder_jump", axis) or 0.0) / self._counts_per_rad
