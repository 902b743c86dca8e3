"""One axis of the mock drive: the state machine of CiA 402-2 and its reactions to faults.

Known limitations: the quick-stop ramp is the plant's own answer to a zero velocity command, and only
waited for; quick-stop options 2 and 6 alone; no ramps in profile velocity mode, which follows its target
like the cyclic one. Invented constant: `QUICK_STOP_S`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from enum import Enum, auto

from fitctl.drivers.cia402 import protocol
from fitctl.drivers.cia402.protocol import State

QUICK_STOP_S = 0.02
STOP_THEN_DISABLE = 2
STOP_AND_STAY = 6


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


class Axis:
    """State, mode, target and fault of one axis.

    Parameters
    ----------
    set_enabled : callable
        Called with True when the motor gets current and with False when it loses it.
    changed : callable
        Called after each change of state.
    """

    def __init__(self, set_enabled: Callable[[bool], None], changed: Callable[[], None]) -> None:
        self.state = State.SWITCH_ON_DISABLED
        self.mode = 0
        self.unit_velocity = protocol.UNIT_RPM
        self.target_velocity = 0
        self.quick_stop_option = STOP_THEN_DISABLE
        self.error_code = 0
        self.fault_persists = False
        self.controlword = 0
        self._set_enabled = set_enabled
        self._changed = changed
        self._stopped_timer: asyncio.TimerHandle | None = None

    @property
    def velocity_rad_s(self) -> float:
        """What the motor is told: the target if operation is enabled in a velocity mode, else zero."""
        follows = self.state is State.OPERATION_ENABLED and self.mode in {
            protocol.PROFILE_VELOCITY,
            protocol.CYCLIC_SYNCHRONOUS_VELOCITY,
        }
        return self.target_velocity * self.unit_rad_s if follows else 0.0

    @property
    def unit_rad_s(self) -> float:
        """One unit of velocity on the wire."""
        exponent = (self.unit_velocity >> 24 ^ 0x80) - 0x80
        return 10.0 ** (exponent + 3) / protocol.MILLI_RPM_PER_RAD_S

    def statusword(self, *, remote: bool) -> int:
        """Object 6041; `remote` while the controlword is listened to."""
        word = self.state | protocol.SW_VOLTAGE_ENABLED
        if remote:
            word |= protocol.SW_REMOTE
        if (
            self.state is State.OPERATION_ENABLED
            and self.mode == protocol.CYCLIC_SYNCHRONOUS_VELOCITY
        ):
            word |= protocol.SW_FOLLOWS_COMMAND
        return word

    def control(self, controlword: int) -> None:
        """Take a controlword: a fault reset is an edge, everything else a level."""
        resets = controlword & ~self.controlword & protocol.CW_FAULT_RESET
        self.controlword = controlword
        if self.state is State.FAULT:
            if resets and not self.fault_persists:
                self.error_code = 0
                self._enter(State.SWITCH_ON_DISABLED)
            return
        command = command_of(controlword)
        resumes = command is Command.ENABLE_OPERATION and self.quick_stop_option == STOP_AND_STAY
        if self.state is State.QUICK_STOP_ACTIVE and resumes:
            self._enter(State.OPERATION_ENABLED)
        else:
            self._enter(TRANSITIONS.get((self.state, command), self.state))

    def fault(self, error_code: int) -> None:
        """Stop the motor, then take its current away and stay in FAULT (transitions 13 and 14)."""
        if self.state in protocol.FAULT_STATES:
            return
        self.error_code = error_code
        powered = self.state in protocol.POWERED_STATES
        self._enter(State.FAULT_REACTION_ACTIVE if powered else State.FAULT)

    def quick_stop(self) -> None:
        """Stop as if the controlword had asked for it."""
        self._enter(TRANSITIONS.get((self.state, Command.QUICK_STOP), self.state))

    def power_off(self) -> None:
        """Forget everything but the wiring: reset of the node, or end of the mock."""
        self.error_code = self.target_velocity = self.controlword = self.mode = 0
        self.unit_velocity = protocol.UNIT_RPM
        self.quick_stop_option = STOP_THEN_DISABLE
        self._enter(State.SWITCH_ON_DISABLED)

    def _enter(self, state: State) -> None:
        if state is self.state:
            return
        was_powered = self.state in protocol.POWERED_STATES
        self.state = state
        if self._stopped_timer:
            self._stopped_timer.cancel()
            self._stopped_timer = None
        stays = state is State.QUICK_STOP_ACTIVE and self.quick_stop_option == STOP_AND_STAY
        if state in {State.QUICK_STOP_ACTIVE, State.FAULT_REACTION_ACTIVE} and not stays:
            loop = asyncio.get_running_loop()
            self._stopped_timer = loop.call_later(QUICK_STOP_S, self._has_stopped)
        powered = state in protocol.POWERED_STATES
        if powered != was_powered:
            self._set_enabled(powered)
        self._changed()

    def _has_stopped(self) -> None:
        stopped = self.state is State.FAULT_REACTION_ACTIVE
        self._enter(State.FAULT if stopped else State.SWITCH_ON_DISABLED)
