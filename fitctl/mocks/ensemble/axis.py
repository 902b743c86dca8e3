"""One axis of the mock controller: a trajectory with ramps, a position loop about it, and its faults.

Everything in the controller's own units. Places are about the home, those of the program about wherever
POSOFFSET has put its zero.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from fitctl.drivers.ensemble.protocol import FAULT_MASKS, AxisFault, AxisStatus, Parameter

LOOP_GAIN_PER_S = 30.0
DEFAULT_SPEED = 1.0
HOME_SPEED, HOME_OFFSET, HOME_RAMP_RATE = 76, 77, 78
"""Parameters of homing, by the numbers of the maker's header."""
LONGEST_STEP_S = 0.02
VELOCITY_WINDOW_S = 0.02
_IN_POSITION_PART = 0.1  # of the position error threshold

_UNCONNECTED_INPUTS = (
    AxisStatus.CW_END_OF_TRAVEL | AxisStatus.CCW_END_OF_TRAVEL | AxisStatus.HOME_LIMIT
)
"""Inputs with nothing on them: the controller pulls them high."""

_DISABLING = (
    AxisFault.POSITION_ERROR
    | AxisFault.AMPLIFIER
    | AxisFault.OVER_CURRENT
    | AxisFault.EMERGENCY_STOP
)


class Axis:
    """State of one axis.

    Parameters
    ----------
    parameters : mapping of int to float
        By parameter number; what SETPARM changes shows here at once.
    homed : bool
        Whether it is homed at power-up.

    Attributes
    ----------
    causes : AxisFault
        What cannot be acknowledged away, because it is so now.
    homed : bool
        Only then its software limits act, as far as the fault masks have them.
    offset : float
        A place of the program, less the same one about the home.
    feedback_velocity : float
        Of the encoder, whether the axis has power or not: a mean over `VELOCITY_WINDOW_S` or a little more.
    """

    def __init__(self, parameters: Mapping[int, float], *, homed: bool = True) -> None:
        self.enabled = False
        self.faults = AxisFault(0)
        self.causes = AxisFault(0)
        self.homed = homed
        self.offset = 0.0
        self.ramp_rate = parameters[Parameter.DEFAULT_RAMP_RATE]
        self.speed = DEFAULT_SPEED
        self.command = 0.0
        self.velocity = 0.0
        self.feedback = 0.0
        self.feedback_velocity = 0.0
        self._parameters = parameters
        self._goal_velocity = 0.0
        self._goal: float | None = None
        self._rate = self.ramp_rate
        self._changes = 0.0
        self._clockwise = False
        self._coordinated = False
        self._homing = False
        self._home = 0.0
        self._window_s = 0.0
        self._window_began_at = 0.0

    # ------------------------------------------------------------ commands; False is refused
    def enable(self) -> bool:
        """Power up, holding where it is."""
        self._update_faults()
        if self.faults:
            return False
        if not self.enabled:
            self.enabled = True
            self._rest_at(self.feedback)
        return True

    def disable(self) -> None:
        """Power down at once."""
        self.enabled = False
        self._rest_at(self.feedback)

    def acknowledge(self) -> None:
        """Clear the faults whose cause is gone."""
        self.faults = AxisFault(0)
        self._update_faults()

    def free_run(self, velocity: float) -> bool:
        """Run at a velocity from now on, for good."""
        if not self.enabled or self.faults:
            return False
        self._goal, self._goal_velocity, self._rate = None, velocity, self.ramp_rate
        self._coordinated = self._homing = False
        return True

    def move_to(self, position: float, speed: float, *, coordinated: bool = False) -> bool:
        """Move to a place and stay there; a coordinated move is its plane's motion."""
        if not self.enabled or self.faults:
            return False
        self._coordinated, self._homing = coordinated, False
        self._goal, self._goal_velocity, self._rate = position, abs(speed), self.ramp_rate
        return True

    def home(self) -> bool:
        """Move to the marker, which is where the encoder was at power-up, and HomeOffset beyond.

        That place is zero from then on, also the program's. ABORT, DISABLE, a fault or another motion leave
        the axis unhomed.
        """
        if not self.enabled or self.faults:
            return False
        self._coordinated, self._homing, self.homed = False, True, False
        self._goal = self._parameters[HOME_OFFSET] - self._home
        self._goal_velocity = self._parameters[HOME_SPEED]
        self._rate = self._parameters[HOME_RAMP_RATE]
        return True

    def set_program_position(self, position: float) -> None:
        """Let the place where the trajectory is have that position in the program; nothing moves."""
        self.offset = position - self.command

    def abort(self) -> None:
        """Stop, at the rate for that."""
        self._goal, self._goal_velocity, self._homing = None, 0.0, False
        self._rate = self._parameters[Parameter.ABORT_DECEL_RATE]

    # ------------------------------------------------------------ readings
    @property
    def moving(self) -> bool:
        """Its trajectory is not at its end."""
        return self.velocity != 0 or self._goal is not None or self._goal_velocity != 0

    @property
    def moving_in_plane(self) -> bool:
        """Its trajectory is a coordinated move, not at its end."""
        return self._coordinated and self.moving

    @property
    def status(self) -> AxisStatus:
        """The bits of AXISSTATUS."""
        near = _IN_POSITION_PART * self._position_error_limit
        flags = {
            AxisStatus.ENABLED: self.enabled,
            AxisStatus.HOMED: self.homed,
            AxisStatus.HOMING: self._homing,
            AxisStatus.IN_POSITION: self.enabled and abs(self.error) < near and not self.moving,
            AxisStatus.MOVING: self.moving,
            AxisStatus.ACCELERATING: self._changes > 0,
            AxisStatus.DECELERATING: self._changes < 0,
            AxisStatus.CLOCKWISE: self._clockwise,
            AxisStatus.EMERGENCY_STOP: bool(self.causes & AxisFault.EMERGENCY_STOP),
        }
        return _UNCONNECTED_INPUTS | sum(flag for flag, holds in flags.items() if holds)

    @property
    def error(self) -> float:
        """Position error: where the trajectory is, less where the encoder is."""
        return self.command - self.feedback

    @property
    def velocity_error(self) -> float:
        """How fast the trajectory runs, less how fast the encoder turns."""
        return self.velocity - self.feedback_velocity

    @property
    def motor_velocity(self) -> float:
        """What the position loop asks of the motor."""
        return self.velocity + LOOP_GAIN_PER_S * self.error if self.enabled else 0.0

    # ------------------------------------------------------------ time
    def step(self, feedback: float, period_s: float) -> None:
        """What the controller did in a period, with what the encoder reads at its end.

        A real controller goes on while this computer stands still: the trajectory makes up for it, in steps of
        at most `LONGEST_STEP_S`, as the motors did.
        """
        self.feedback = feedback - self._home
        self._measure_velocity(feedback, period_s)
        if self.enabled:
            steps = math.ceil(period_s / LONGEST_STEP_S)
            for _ in range(steps):
                self._advance(period_s / steps)
        else:
            self.command = feedback
        self._update_faults()

    def _measure_velocity(self, feedback: float, period_s: float) -> None:
        self._window_s += period_s
        if self._window_s >= VELOCITY_WINDOW_S:
            self.feedback_velocity = (feedback - self._window_began_at) / self._window_s
            self._window_s, self._window_began_at = 0.0, feedback

    def _advance(self, period_s: float) -> None:
        wanted = self._goal_velocity
        if self._goal is not None:
            left = self._goal - self.command
            wanted = math.copysign(min(wanted, math.sqrt(2 * self._rate * abs(left))), left)
            if abs(left) <= abs(self.velocity) * period_s or abs(left) < self._rate * period_s**2:
                self._arrive(self._goal)
                return
        most = self._rate * period_s
        change = max(-most, min(most, wanted - self.velocity))
        self._changes = change * self.velocity if self.velocity else abs(change)
        self.velocity += change
        self.command += self.velocity * period_s
        if self.velocity:
            self._clockwise = self.velocity > 0
        if self.homed:
            self._check_limits()

    def _arrive(self, goal: float) -> None:
        homed = self._homing
        self._rest_at(goal)
        if homed:
            self._home += goal
            self.feedback -= goal
            self.command = self.offset = 0.0
            self.homed = True

    def _check_limits(self) -> None:
        low, high = self._software_limits
        fault = AxisFault(0)
        if self.velocity > 0 and self.command > high:
            fault = AxisFault.CW_SOFTWARE_LIMIT
        elif self.velocity < 0 and self.command < low:
            fault = AxisFault.CCW_SOFTWARE_LIMIT
        raised, disabling, stopping = (int(self._parameters[mask]) for mask in FAULT_MASKS)
        fault &= raised
        self.faults |= fault
        if fault & disabling:
            self.disable()
        elif fault & stopping:
            self.abort()

    def _update_faults(self) -> None:
        """Latch the faults that are present; the grave ones disable the axis."""
        self.faults |= self.causes
        if self.enabled and abs(self.error) > self._position_error_limit:
            self.faults |= AxisFault.POSITION_ERROR
        if self.enabled and self.faults & _DISABLING:
            self.disable()

    @property
    def _position_error_limit(self) -> float:
        return self._parameters[Parameter.POSITION_ERROR_THRESHOLD] or math.inf

    @property
    def _software_limits(self) -> tuple[float, float]:
        low = self._parameters[Parameter.SOFTWARE_LIMIT_LOW]
        high = self._parameters[Parameter.SOFTWARE_LIMIT_HIGH]
        return (low, high) if low < high else (-math.inf, math.inf)

    def _rest_at(self, position: float) -> None:
        self.command, self.velocity, self._changes = position, 0.0, 0.0
        self._homing = False
        self._goal, self._goal_velocity = None, 0.0
