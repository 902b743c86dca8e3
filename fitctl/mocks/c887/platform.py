"""The hexapod behind the controller: where its platform is, where it can go, what keeps it there. No I/O."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence

from fitctl.config import C887Mock
from fitctl.drivers.c887.protocol import AXES, GcsError
from fitctl.model.hexapod_motion import Floats, HexapodMotion, MotionLimits, Trajectory

ABRUPT = 10.0  # times the acceleration: #24 and STP brake so hard, HLT brakes as a move does
_PIVOT = ("R", "S", "T")
_ROTATIONS = AXES[3:]
_AT_ZERO_DEG = 1e-6


class GcsFailure(Exception):
    """The controller does not do this, and latches an error number."""

    def __init__(self, number: GcsError) -> None:
        super().__init__(number.name)
        self.number = number


class Platform:
    """A platform on six struts with self-locking screws: without servo or power it stays where it is.

    Parameters
    ----------
    settings : C887Mock
    now_s : callable
        The time.

    Attributes
    ----------
    servos_on, referenced : bool
        Of all axes together: the struts move every axis.
    velocity_mm_s : float
    pivot : dict
        R, S and T in mm.
    soft_limits : dict
        Low and high end of each axis, which act where `soft_limits_on`.
    stuck, swapped : bool
        What a fault does to it: it does not move, X and Y are exchanged.
    blocked : GcsError
        Why the servos cannot be switched on; NONE: they can.
    error : int
        Latched by what the platform does; the controller fetches it.
    """

    def __init__(self, settings: C887Mock, now_s: Callable[[], float]) -> None:
        self._settings = settings
        self._now_s = now_s
        self._ends = dict(zip(AXES, settings.travel.ends, strict=True))
        self._motion = HexapodMotion()
        self.stuck = self.swapped = False
        self.blocked = GcsError.NONE
        self.error = GcsError.NONE
        self.referenced = settings.referenced
        self._power_up()

    def power_up(self) -> None:
        """After a loss of power it stands where it stood, and does not know where that is."""
        self.stop(GcsError.NONE)
        self.referenced = False
        self._power_up()

    def _power_up(self) -> None:
        self.servos_on = True
        self.velocity_mm_s = self._settings.velocity_limit_mm_s
        self.pivot = dict.fromkeys(_PIVOT, 0.0)
        self.soft_limits = dict(self._ends)
        self.soft_limits_on = dict.fromkeys(AXES, True)
        self._target = dict(zip(AXES, self._motion.target.tolist(), strict=True))
        self._referenced_s: float | None = None

    # ------------------------------------------------------------ readings
    def plans_since(self, time_s: float) -> list[tuple[float, Trajectory]]:
        """How it has moved since a recent time: when each plan began, and the plan."""
        return self._motion.plans_since(time_s)

    def true_pose_at(self, time_s: float) -> Floats:
        """Where it really is, shape (6,), mm and degrees; referenced or not."""
        return self._motion.pose_at(time_s)

    def position(self) -> dict[str, float]:
        """What the controller measures; zero before it is referenced."""
        pose = self._motion.pose_at(self._now_s()) if self.referenced else [0.0] * len(AXES)
        return {axis: float(value) for axis, value in zip(AXES, pose, strict=True)}

    def target(self) -> dict[str, float]:
        """Where the last accepted command sent it."""
        return dict(self._target)

    def moving(self) -> dict[str, bool]:
        """Which axes move."""
        if self.referencing:
            return dict.fromkeys(AXES, True)
        return dict(zip(AXES, self._motion.moving_at(self._now_s()), strict=True))

    def on_target(self) -> dict[str, bool]:
        """Which axes have arrived."""
        ready = self.referenced and self.servos_on
        return {axis: ready and not moves for axis, moves in self.moving().items()}

    @property
    def referencing(self) -> bool:
        """A reference move runs; one that is over takes effect here."""
        if self._referenced_s is not None and self._now_s() >= self._referenced_s:
            self._referenced_s = None
            self.referenced = True
            self._target = dict.fromkeys(AXES, 0.0)
        return self._referenced_s is not None

    def travel(self, end: int) -> dict[str, float]:
        """The low (0) or high (1) end of each axis, the others at zero."""
        return {axis: ends[end] for axis, ends in self._ends.items()}

    # ------------------------------------------------------------ commands
    def reference(self) -> None:
        """Go to the reference switches, and take that place for zero. Raises GcsFailure."""
        self._check_can_move()
        if self.referencing:
            return
        self.referenced = False
        self._plan([0.0] * len(AXES))
        ends_s = max(self._motion.ends_s, self._now_s() + self._settings.reference_s)
        self._referenced_s = math.inf if self.stuck else ends_s

    def check_reach(self, targets: Mapping[str, float]) -> None:
        """Raises GcsFailure where a pose cannot be reached, axes that are not named being at their targets."""
        goal = {**self._target, **targets}
        for axis, value in goal.items():
            low, high = self._ends[axis]
            if self.soft_limits_on[axis]:
                low, high = (
                    max(low, self.soft_limits[axis][0]),
                    min(high, self.soft_limits[axis][1]),
                )
            if not low <= value <= high:
                raise GcsFailure(GcsError.POSITION_OUT_OF_LIMITS)
        used = sum((value / self._ends[axis][value > 0]) ** 2 for axis, value in goal.items())
        if used > 1 + 1e-9:
            raise GcsFailure(GcsError.POSITION_OUT_OF_LIMITS)

    def move(self, targets: Mapping[str, float]) -> None:
        """Go to a pose. Raises GcsFailure, and goes on with what it did."""
        self._check_can_move()
        if self.referencing or not self.referenced:
            raise GcsFailure(GcsError.NOT_REFERENCED_OR_SERVO_OFF)
        self.check_reach(targets)
        self._target |= targets
        goal = dict(self._target)
        if self.swapped:
            goal["X"], goal["Y"] = goal["Y"], goal["X"]
        self._plan(list(goal.values()))

    def stop(self, number: GcsError = GcsError.STOPPED, *, abrupt: bool = True) -> None:
        """End every motion, also a reference move, and latch an error."""
        self.error = number or self.error
        if self.referencing:
            self._referenced_s = None
        now_s = self._now_s()
        self._motion.stop(now_s, self._limits(ABRUPT if abrupt else 1.0))
        self._target = dict(zip(AXES, self._motion.target.tolist(), strict=True))

    def switch_servos(self, *, on: bool) -> None:
        """All servos on or off; without them it stops. Raises GcsFailure."""
        if on and self.blocked:
            raise GcsFailure(self.blocked)
        if not on:
            self.stop(GcsError.NONE)
        self.servos_on = on

    def set_velocity(self, velocity_mm_s: float) -> None:
        """VLS, while it stands still. Raises GcsFailure."""
        if not 0 < velocity_mm_s <= self._settings.velocity_limit_mm_s:
            raise GcsFailure(GcsError.VELOCITY_OUT_OF_LIMITS)
        self._check_at_rest()
        self.velocity_mm_s = velocity_mm_s

    def set_pivot(self, values: Mapping[str, float]) -> None:
        """SPI, while it stands still without rotation. Raises GcsFailure."""
        self._check_at_rest()
        position = self.position()
        if any(abs(position[axis]) > _AT_ZERO_DEG for axis in _ROTATIONS):
            raise GcsFailure(GcsError.PIVOT_NOT_POSSIBLE)
        self.pivot |= values

    def set_soft_limits(self, end: int, values: Mapping[str, float]) -> None:
        """Low (0) or high (1) ends, within the travel. Raises GcsFailure."""
        self._check_at_rest()
        for axis, value in values.items():
            if not self._ends[axis][0] <= value <= self._ends[axis][1]:
                raise GcsFailure(GcsError.PARAMETER_OUT_OF_RANGE)
        for axis, value in values.items():
            ends = list(self.soft_limits[axis])
            ends[end] = value
            self.soft_limits[axis] = (ends[0], ends[1])

    def switch_soft_limits(self, values: Mapping[str, bool]) -> None:
        """SSL, while it stands still. Raises GcsFailure."""
        self._check_at_rest()
        self.soft_limits_on |= values

    def _check_can_move(self) -> None:
        if self.blocked:
            raise GcsFailure(self.blocked)
        if not self.servos_on:
            raise GcsFailure(GcsError.NOT_REFERENCED_OR_SERVO_OFF)

    def _check_at_rest(self) -> None:
        if any(self.moving().values()):
            raise GcsFailure(GcsError.NOT_WHILE_MOVING)

    def _plan(self, goal: Sequence[float]) -> None:
        if not self.stuck:
            self._motion.move_to(self._now_s(), goal, self._limits())

    def _limits(self, harder: float = 1.0) -> MotionLimits:
        settings = self._settings
        part = self.velocity_mm_s / settings.velocity_limit_mm_s
        return MotionLimits(
            self.velocity_mm_s,
            settings.velocity_limit_deg_s * part,
            settings.acceleration_mm_s2 * harder,
            settings.acceleration_deg_s2 * harder,
        )
