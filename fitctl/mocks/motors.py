"""What a mock amplifier turns: two motors with encoders, and what can go wrong with them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

from fitctl.config.wiring import AmplifierWiring
from fitctl.mocks.faults import FaultKind, Faults

AXES = ("az", "el")

AXIS_FAULTS = {
    "amplifier_fault": FaultKind(
        "an amplifier is in fault, after the end of the fault until it is reset", parts=AXES
    ),
    # Half a turn: twice the position error that the Ensemble has for a fault.
    "encoder_jump": FaultKind("an encoder counts this much more", "counts", 2000, AXES),
    "stuck_axis": FaultKind("a motor does not turn, whatever its amplifier does", parts=AXES),
}


class Motors(Protocol):
    """The plant's side of an amplifier: azimuth is axis 0, elevation axis 1."""

    def position_rad(self) -> Sequence[float]:
        """Both motors' angles now."""
        ...

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors at these velocities; must be repeated."""
        ...

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give one motor current, or take it away."""
        ...


class WiredMotors:
    """Motors on the amplifiers' axes as a rig's cables have them: axis 0 and 1 in place of az and el.

    Parameters
    ----------
    motors : Motors
    wiring : AmplifierWiring
    velocity_gains : sequence of float
        How many times faster than commanded axis 0 and 1 turn their motors.
    ends_rad : sequence of float
        Where azimuth and elevation meet an end, either way from zero. They stop there at the next command,
        a little beyond it.
    """

    def __init__(
        self,
        motors: Motors,
        wiring: AmplifierWiring,
        velocity_gains: Sequence[float],
        ends_rad: Sequence[float] = (math.inf, math.inf),
    ) -> None:
        self._motors = motors
        self._ends_rad = ends_rad
        self._velocity_gains = velocity_gains
        self._axes = wiring.axes
        self._velocity_signs, self._encoder_signs = wiring.velocity_signs, wiring.encoder_signs

    def position_rad(self) -> Sequence[float]:
        """What the encoders on axis 0 and 1 count, as angles."""
        turned = [
            sign * angle
            for sign, angle in zip(self._encoder_signs, self._motors.position_rad(), strict=True)
        ]
        return [turned[self._axes.index(axis)] for axis in range(2)]

    def command_velocity_rad_s(self, az: float, el: float) -> None:
        """Drive the motors on axis 0, which gets `az`, and on axis 1."""
        commanded = (az * self._velocity_gains[0], el * self._velocity_gains[1])
        turned = (
            sign * commanded[axis]
            for sign, axis in zip(self._velocity_signs, self._axes, strict=True)
        )
        turned_az, turned_el = (
            0.0 if abs(at) >= end and at * velocity > 0 else velocity
            for velocity, at, end in zip(
                turned, self._motors.position_rad(), self._ends_rad, strict=True
            )
        )
        self._motors.command_velocity_rad_s(turned_az, turned_el)

    def set_enabled(self, axis: int, enabled: bool) -> None:
        """Give the motor on one axis current, or take it away."""
        self._motors.set_enabled(self._axes.index(axis), enabled)


class FaultyMotors:
    """Motors and incremental encoders as `AXIS_FAULTS` have them: a jumped encoder, a stuck axis.

    The encoders count from where the motors stood when power came: at zero first, and after each
    `reboot` wherever it found them.

    Parameters
    ----------
    motors : Motors
    faults : Faults
        With `WIRE_FAULTS` and `AXIS_FAULTS` among its kinds.
    counts_per_rev : int
        Of the encoders.

    Attributes
    ----------
    counts_per_rad : float
        Of the encoders.
    """

    def __init__(self, motors: Motors, faults: Faults, counts_per_rev: int) -> None:
        self.counts_per_rad = counts_per_rev / (2 * math.pi)
        self._motors = motors
        self._faults = faults
        self._zero_rad: Sequence[float] = (0.0, 0.0)
        faults.on_change(self._fault_changed)

    def position_counts(self) -> tuple[int, int]:
        """What both encoders say: counts, however many bits they take."""
        az_rad, el_rad = self._motors.position_rad()
        return self._counts(0, az_rad), self._counts(1, el_rad)

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

    def _counts(self, axis: int, angle_rad: float) -> int:
        turned = math.floor((angle_rad - self._zero_rad[axis]) * self.counts_per_rad + 0.5)
        return turned + round(self._faults.value("encoder_jump", AXES[axis]) or 0.0)

    def _fault_changed(self, kind: str) -> None:
        if kind == "reboot" and self._faults.value("reboot") is None:
            self._zero_rad = tuple(self._motors.position_rad())
