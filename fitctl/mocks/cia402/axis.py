"""One axis of the mock drive: the state machine of CiA 402-2, and what velocity it asks of its motor.

Known limitations: no current limits, so quick-stop options 3 and 7 are refused; a disable by shutdown or
by disable operation does not slow down first (605B and 605C are 0); no jerk limit; no supervision of
its motor, so that a stuck one is for the master to notice. Invented constants: the rates at power-up
(`RATE_RPM_PER_S`), that a limit is approached no faster than the quick-stop rate stops from, and that
limits with the lower one not below the upper one are none.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from enum import Enum, auto

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State

RATE_RPM_PER_S = 60_000
RAD_S_PER_RPM = 2 * math.pi / 60
_SHORTEST_S = 1e-9  # infinite rate times no time is not a number
_STOPPING = frozenset({State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE})

QUICK_STOP_OPTIONS = frozenset({0, 1, 2, 5, 6})
"""0 no ramp, 1 and 5 the deceleration, 2 and 6 the quick-stop deceleration; 5 and 6 stay powered."""
_STAY_OPTIONS = frozenset({5, 6})
_SLOW_OPTIONS = frozenset({1, 5})
FAULT_REACTIONS = frozenset({0, 1, 2})
"""0 no ramp, 1 the deceleration, 2 the quick-stop deceleration."""
DEFAULT_OPTION = 2


class Command(Enum):
    """What the lower bits of a controlword ask for."""

    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    SHUTDOWN = auto()
    SWITCH_ON = auto()
    ENABLE_OPERATION = auto()


TRANSITIONS = {
    (State.SWITCH_ON_DISABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.READY_TO_SWITCH_ON, Command.SWITCH_ON): State.SWITCHED_ON,
    (State.READY_TO_SWITCH_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,
    (State.READY_TO_SWITCH_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.READY_TO_SWITCH_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.ENABLE_OPERATION): State.OPERATION_ENABLED,
    (State.SWITCHED_ON, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.SWITCHED_ON, Command.QUICK_STOP): State.SWITCH_ON_DISABLED,
    (State.SWITCHED_ON, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, Command.SWITCH_ON): State.SWITCHED_ON,
    (State.OPERATION_ENABLED, Command.SHUTDOWN): State.READY_TO_SWITCH_ON,
    (State.OPERATION_ENABLED, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
    (State.OPERATION_ENABLED, Command.QUICK_STOP): State.QUICK_STOP_ACTIVE,
    (State.QUICK_STOP_ACTIVE, Command.DISABLE_VOLTAGE): State.SWITCH_ON_DISABLED,
}
"""CiA 402-2, transitions 2 to 12; 16 depends on the quick-stop option, 13 to 15 are faults."""


def command_of(controlword: int) -> Command:
    """Read the command bits of a controlword, most urgent first."""
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


def exponent_of(unit: int) -> int:
    """The power of ten in the top byte of object 60A9, signed."""
    return (unit >> 24 ^ 0x80) - 0x80


class Axis:
    """State, mode, target, ramp and fault of one axis.

    Parameters
    ----------
    set_enabled : callable
        Called with True when the motor gets current and with False when it loses it.
    changed : callable
        Called after each change of state.

    Attributes
    ----------
    demand_rad_s : float
        Velocity command of the motor.
    limited : bool
        A software position limit holds the axis back.
    fault_persists : bool
        The cause of the fault is still there: a reset does not help.
    """

    def __init__(self, set_enabled: Callable[[bool], None], changed: Callable[[], None]) -> None:
        self.state = State.SWITCH_ON_DISABLED
        self.demand_rad_s = 0.0
        self.limited = False
        self.fault_persists = False
        self._set_enabled = set_enabled
        self._changed = changed
        self._set_defaults()

    def _set_defaults(self) -> None:
        self.mode = 0
        self.unit_velocity = protocol.UNIT_RPM
        self.target_velocity = 0
        self.acceleration = self.deceleration = self.quick_stop_rate = RATE_RPM_PER_S
        self.quick_stop_option = self.fault_reaction = DEFAULT_OPTION
        self.abort_option = protocol.ABORT_IS_FAULT
        self.limits_counts = [0, 0]
        self.error_code = 0
        self.controlword = 0

    @property
    def unit_rad_s(self) -> float:
        """One unit of velocity on the wire."""
        return 10.0 ** exponent_of(self.unit_velocity) * RAD_S_PER_RPM

    @property
    def moves(self) -> bool:
        """Its demand moves on with time, also without a message."""
        follows = self.state is State.OPERATION_ENABLED
        return self.state in _STOPPING or (
            follows and (self.demand_rad_s != 0 or self._wanted_rad_s() != 0)
        )

    def statusword(self, *, remote: bool) -> int:
        """Object 6041; `remote` while the controlword is listened to."""
        word = self.state | protocol.SW_VOLTAGE_ENABLED
        if remote:
            word |= protocol.SW_REMOTE
        if self.state is State.OPERATION_ENABLED:
            if self.limited:
                word |= protocol.SW_INTERNAL_LIMIT
            if self.mode == protocol.CYCLIC_SYNCHRONOUS_VELOCITY:
                word |= protocol.SW_FOLLOWS_COMMAND
            elif self.mode == protocol.PROFILE_VELOCITY:
                word |= protocol.SW_SPEED_ZERO if self.demand_rad_s == 0 else 0
                at_target = self.demand_rad_s == self._wanted_rad_s()
                word |= protocol.SW_TARGET_REACHED if at_target else 0
        return word

    def control(self, controlword: int) -> None:
        """Obey a controlword: a fault reset is an edge, everything else a level."""
        resets = controlword & ~self.controlword & protocol.CW_FAULT_RESET
        self.controlword = controlword
        if self.state is State.FAULT:
            if resets and not self.fault_persists:
                self.error_code = 0
                self._enter(State.SWITCH_ON_DISABLED)
            return
        command = command_of(controlword)
        resumes = command is Command.ENABLE_OPERATION and self.quick_stop_option in _STAY_OPTIONS
        if self.state is State.QUICK_STOP_ACTIVE and resumes:
            self._enter(State.OPERATION_ENABLED)
        else:
            self.command(command)

    def advance(self, elapsed_s: float, position_counts: int, rad_per_count: float) -> None:
        """Bring the demand on by some time; a motor that was to be stopped and has been loses current.

        Parameters
        ----------
        elapsed_s : float
        position_counts : int
            Where the axis is, for its software limits.
        rad_per_count : float
        """
        wanted_rad_s = self._wanted_rad_s()
        allowed_rad_s = self._within_limits(wanted_rad_s, position_counts, rad_per_count)
        self.limited = allowed_rad_s != wanted_rad_s
        step_rad_s = allowed_rad_s - self.demand_rad_s
        most_rad_s = self._rate_rad_s2(wanted_rad_s) * max(elapsed_s, _SHORTEST_S)
        brakes = self.limited and abs(allowed_rad_s) < abs(self.demand_rad_s)
        if brakes or abs(step_rad_s) <= most_rad_s:
            self.demand_rad_s = allowed_rad_s
        else:
            self.demand_rad_s += math.copysign(most_rad_s, step_rad_s)
        if self.state in _STOPPING and self.demand_rad_s == 0:
            self._has_stopped()

    def fault(self, error_code: int) -> bool:
        """Stop the motor, then take its current away and stay in FAULT (transitions 13 and 14).

        Returns
        -------
        bool
            False if the axis was in a fault already.
        """
        if self.state in protocol.FAULT_STATES:
            return False
        self.error_code = error_code
        powered = self.state in protocol.POWERED_STATES
        self._enter(State.FAULT_REACTION_ACTIVE if powered else State.FAULT)
        return True

    def command(self, command: Command) -> None:
        """Do as if the controlword had asked for it."""
        self._enter(TRANSITIONS.get((self.state, command), self.state))

    def power_off(self) -> None:
        """Forget everything but the wiring: reset of the node, or end of the mock."""
        self._set_defaults()
        self._enter(State.SWITCH_ON_DISABLED)

    # ------------------------------------------------------------ velocity
    def _wanted_rad_s(self) -> float:
        """Where the demand is to go: the target if operation is enabled in a velocity mode, else zero."""
        halts = self.mode == protocol.PROFILE_VELOCITY and self.controlword & protocol.CW_HALT
        follows = self.state is State.OPERATION_ENABLED and self.mode in {
            protocol.PROFILE_VELOCITY,
            protocol.CYCLIC_SYNCHRONOUS_VELOCITY,
        }
        return self.target_velocity * self.unit_rad_s if follows and not halts else 0.0

    def _within_limits(
        self, wanted_rad_s: float, position_counts: int, rad_per_count: float
    ) -> float:
        low, high = self.limits_counts
        if low >= high or wanted_rad_s == 0:
            return wanted_rad_s
        left = high - position_counts if wanted_rad_s > 0 else position_counts - low
        stops_from_rad_s = math.sqrt(
            2 * self.quick_stop_rate * RAD_S_PER_RPM * max(0, left) * rad_per_count
        )
        return math.copysign(min(abs(wanted_rad_s), stops_from_rad_s), wanted_rad_s)

    def _rate_rad_s2(self, wanted_rad_s: float) -> float:
        """How fast the demand may change now."""
        rpm_per_s = math.inf
        if self.state is State.QUICK_STOP_ACTIVE:
            rpm_per_s = self._stop_rate(self.quick_stop_option)
        elif self.state is State.FAULT_REACTION_ACTIVE:
            rpm_per_s = self._stop_rate(self.fault_reaction)
        elif self.state is State.OPERATION_ENABLED and self.mode == protocol.PROFILE_VELOCITY:
            slows = abs(wanted_rad_s) < abs(self.demand_rad_s)
            rpm_per_s = self.deceleration if slows else self.acceleration
        return rpm_per_s * RAD_S_PER_RPM

    def _stop_rate(self, option: int) -> float:
        if option == 0:
            return math.inf
        return self.deceleration if option in _SLOW_OPTIONS else self.quick_stop_rate

    # ------------------------------------------------------------ state
    def _enter(self, state: State) -> None:
        if state is self.state:
            return
        was_powered = self.state in protocol.POWERED_STATES
        self.state = state
        powered = state in protocol.POWERED_STATES
        if not powered:
            self.demand_rad_s = 0.0
            self.limited = False
        if powered != was_powered:
            self._set_enabled(powered)
        self._changed()

    def _has_stopped(self) -> None:
        if self.state is State.FAULT_REACTION_ACTIVE:
            self._enter(State.FAULT)
        elif self.quick_stop_option not in _STAY_OPTIONS:
            self._enter(State.SWITCH_ON_DISABLED)
