"""One loop's siderostat as the loop commands it: a set-point within its travel."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.stages.servo import SiderostatServo

Floats = NDArray[np.float64]
_NOTHING = np.zeros(2)


class SiderostatStage:
    """Set-points of one siderostat.

    Parameters
    ----------
    rig : Rig
    loop_name : str
    servo : SiderostatServo

    Attributes
    ----------
    servo : SiderostatServo
        Follows the set-point, at a pace of its own.
    setpoint_rad : array, shape (2,)
        Motor angles as commanded.
    travel_rad : float
        Of the motors, each way from the encoders' zero.
    wanted_fraction : float
        Of the travel: the set-point before it was limited.
    """

    def __init__(self, rig: Rig, loop_name: str, servo: SiderostatServo) -> None:
        siderostat = rig.loops[loop_name].siderostat
        self.servo = servo
        self.setpoint_rad = np.zeros(2)
        self.wanted_fraction = 0.0
        self._beyond_rad = _NOTHING
        self._motor_sky_arcsec_per_rad = siderostat.sky_arcsec_per_motor_rad
        self.travel_rad = siderostat.travel_rad

    def hold(self, motor_rad: Floats) -> None:
        """Servo about where the motors are, shape (2,)."""
        self.servo.hold(motor_rad)
        self.setpoint_rad = self.servo.setpoint_rad
        self.wanted_fraction = 0.0
        self._beyond_rad = _NOTHING

    def jog(self, step_sky_arcsec: Floats) -> None:
        """Move the set-point by an angle on the sky, shape (2,)."""
        self.move_by(step_sky_arcsec / self._motor_sky_arcsec_per_rad)

    @property
    def wanted_rad(self) -> Floats:
        """The set-point as :meth:`undo` would have it without an end of the travel, shape (2,)."""
        return self.setpoint_rad + self._beyond_rad

    def move_by(self, step_rad: Floats) -> None:
        """Move the set-point by motor angles, shape (2,); what the travel cuts off is lost."""
        self._move(self.setpoint_rad + step_rad)

    def move_to(self, setpoint_rad: Floats) -> None:
        """Move the set-point, shape (2,), no farther than its travel; what the travel cuts off is lost."""
        self._beyond_rad = _NOTHING
        self._move(setpoint_rad)

    def undo(self, step_rad: Floats) -> None:
        """Move the set-point by motor angles, shape (2,), against what turns the star by a known angle.

        What the travel's end cuts off is kept for the next call: when that turn goes back, the set-point stays
        at the end until it is wanted nearer.
        """
        self.undo_to(self.wanted_rad + step_rad)

    def undo_to(self, wanted_rad: Floats) -> None:
        """Move the set-point as :meth:`undo` does, but to a place, shape (2,)."""
        self.move_to(wanted_rad)
        if self.wanted_fraction > 1.0:
            self._beyond_rad = wanted_rad - self.setpoint_rad

    def _move(self, setpoint_rad: Floats) -> None:
        most_rad = self.travel_rad
        az_rad, el_rad = (setpoint_rad + self._beyond_rad).tolist()
        self.wanted_fraction = max(abs(az_rad), abs(el_rad)) / most_rad
        within = self.wanted_fraction <= 1.0 and self._beyond_rad is _NOTHING
        self.setpoint_rad = setpoint_rad if within else np.clip(setpoint_rad, -most_rad, most_rad)
        self.servo.move_to(self.setpoint_rad)
