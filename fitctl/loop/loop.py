"""What every loop has: a mode, interlocks, a siderostat, a tick in phases and its record.

A loop's tick is :meth:`Loop.sense`, :meth:`Loop.decide` and :meth:`Loop.send`, for each loop of the rig in
turn, and when all have sent, :meth:`Loop.confirm` and :meth:`Loop.tick_record`. So no loop waits for another's
device or record. Metrology loops come first: a loop that depends on one uses what it decided in the same step.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from fitctl.config import QUANTITIES, AnyLoop, Rig
from fitctl.drivers.interface import AzEl, Frame
from fitctl.logging.records import FailingDevice, MetrologyTick, ModeChange, Place, Severity, Tick
from fitctl.loop.interlocks import Interlocks
from fitctl.loop.quantities import Quantities
from fitctl.loop.search.spiral import SpiralSearch
from fitctl.messages.commands import Acquire, AnyCommand
from fitctl.messages.modes import (
    AT_REST,
    OPERATOR,
    TRANSITIONS,
    Mode,
    Transition,
    Trigger,
    transition,
    usable_commands,
)
from fitctl.messages.telemetry import LoopState
from fitctl.stages.journal import Journal, error_text
from fitctl.stages.periodic import Periodic
from fitctl.stages.servo import ServoState
from fitctl.stages.siderostat import SiderostatStage

Floats = NDArray[np.float64]
_MOST_FAILURES = 20  # some reasons have a number that changes
_SEVERITY: dict[Trigger, Severity] = {
    Trigger.FAULT: "error",
    Trigger.STAR_LOST: "warning",
    Trigger.BEAM_LOST: "warning",
    Trigger.SEARCH_EXHAUSTED: "warning",
}


class Loop(ABC):
    """One loop; a kind of loop adds its sensor, its other stages and its control laws.

    Parameters
    ----------
    name : str
    rig : Rig
    siderostat : SiderostatStage
    journal : Journal
    quantities : Quantities
    places : mapping of str to str
        Where each part of the rig is that this kind of loop measures; interlocks about others are left out.

    Attributes
    ----------
    place_kind : type
        Record of where the loop's star or beam is.
    transitions : tuple of Transition
        The table of modes of this kind of loop.
    mode : Mode
    mode_since_s : float
    last_change : ModeChange or None
    quantities : Quantities
        What interlocks evaluate, as last measured.
    interlocks : Interlocks
    """

    transitions: ClassVar[tuple[Transition, ...]] = TRANSITIONS
    place_kind: ClassVar[type[Place]]
    search: SpiralSearch

    def __init__(
        self,
        name: str,
        rig: Rig,
        siderostat: SiderostatStage,
        journal: Journal,
        quantities: Quantities,
        places: Mapping[str, str],
    ) -> None:
        self.name = name
        self.settings: AnyLoop = rig.loops[name]
        self.siderostat = siderostat
        self.servo = siderostat.servo
        self.mode = Mode.OFF
        self.mode_since_s = journal.clock.now_s()
        self.last_change: ModeChange | None = None
        self.quantities = quantities
        self.interlocks = Interlocks(
            {
                row_name: row
                for row_name, row in rig.interlocks.items()
                if QUANTITIES[row.quantity].part in places
            },
            places,
        )
        self._journal = journal
        self._clock = journal.clock
        # What failed and why, since devices were opened: each is reported once.
        self._failures: deque[tuple[str, str]] = deque(maxlen=_MOST_FAILURES)
        self._search_rests: tuple[bool, ...] = ()  # by what holds it

    # ------------------------------------------------------------ the tick

    @abstractmethod
    def sense(self, frame: Frame | None, frames_lost: int, frames_skipped: int) -> None:
        """Observe star and stages: with the camera's newest frame, or without one.

        `frames_lost` and `frames_skipped` count since the camera was opened.
        """

    @abstractmethod
    def decide(self) -> None:
        """Evaluate what was observed, and choose what the stages are to do."""

    @abstractmethod
    def send(self) -> None:
        """Send the stages what was decided, and wait for nothing."""

    @abstractmethod
    def confirm(self) -> None:
        """Wait for the confirmation of what was sent."""

    @abstractmethod
    def tick_record(self) -> Tick | MetrologyTick:
        """The record of the tick that :meth:`confirm` ended."""

    # ------------------------------------------------------------ for the supervisor

    @property
    def periodic(self) -> list[Periodic]:
        """What runs at a pace of its own, beside the frames."""
        return [self.servo]

    def join(self, loops: Mapping[str, Loop]) -> None:  # noqa: B027 - most loops need no other
        """Learn of the rig's other loops; called once, before the first tick."""

    @property
    def usable_commands(self) -> list[Trigger]:
        """The commands that mean something in the mode."""
        return usable_commands(self.mode, self.transitions)

    @property
    @abstractmethod
    def place(self) -> Place | None:
        """Where its star or beam is, for a supervisor after this one; None if that is unknown."""

    @abstractmethod
    def recall(self, place: Any) -> None:
        """Expect it where a supervisor that was killed had it; `place` is a `place_kind`."""

    @abstractmethod
    def state(self, now_s: float) -> LoopState:
        """The newest of everything, for consoles; may be asked from any thread."""

    def begin(self, stack_v: Floats | None) -> None:
        """Begin anew with devices just opened and checked: every interlock is evaluated anew.

        `stack_v`, shape (3,), is what the D/A was found set to, where the loop has one.
        """
        self._failures.clear()
        self.quantities.begin()
        self.interlocks.reset_all(self._clock.now_s())

    def jog(self, step_sky_arcsec: Floats) -> None:
        """Turn the siderostat by hand, by an angle on the sky, shape (2,)."""
        self.siderostat.jog(step_sky_arcsec)

    def release(self) -> None:  # noqa: B027 - the siderostat's servo has no need of it
        """Send nothing more to devices, which are opened anew or closed, until :meth:`begin`."""

    def rest(self) -> None:  # noqa: B027 - a siderostat rests where it is
        """From now on rest where stages may be left without power."""

    def at_rest(self) -> bool:
        """Whether every stage that can still be commanded is where it may be left without power."""
        return True

    # ------------------------------------------------------------ interlocks

    def _evaluate_interlocks(self, now_s: float) -> None:
        """Evaluate the rig file's table, report what changed, and enforce what is tripped.

        What holds or flattens is for the control laws of each kind of loop.
        """
        interlocks = self.interlocks
        for trip, over in interlocks.evaluate(self.mode.name, now_s, self.quantities.readings):
            if over:
                self._report_event("info", f"interlock {trip.name} is over")
            elif trip.action == "safe":
                self.fail(f"interlock {trip.name}", trip.reason)
            else:
                self._report_event("warning", f"{trip.reason} ({trip.action})")
        if interlocks.tripped:
            self._enforce_interlocks()

    def _enforce_interlocks(self) -> None:
        """What is tripped stays in force, whatever mode the loop is put in."""
        action = self.interlocks.action
        reason = next(trip.reason for trip in self.interlocks.tripped if trip.action == action)
        if action == "safe" and self.mode is not Mode.SAFE:
            self.fire(Trigger.FAULT, reason)
        elif self.interlocks.holds and self.mode is Mode.EXPERIMENT:
            self.fire(Trigger.EXPERIMENT_DONE, reason)

    def reset_interlock(self, name: str) -> str:
        """Reset a tripped interlock by hand; why not, if it cannot be."""
        now_s = self._clock.now_s()
        why_not = self.interlocks.reset(name, now_s, self.quantities.readings)
        if not why_not:
            self._report_event("info", f"interlock {name} is reset by hand")
        return why_not

    def _rest_search(self, servo: ServoState, passed_s: float, holds: tuple[bool, ...]) -> None:
        """While anything holds a search, its siderostat stops on its way, and for the search no time passes.

        `holds` has each reason apart: where another takes over, the siderostat stops anew.
        """
        before, self._search_rests = self._search_rests, ()
        if self.mode is Mode.ACQUISITION and any(holds):
            self._search_rests = holds
            self.search.delay(passed_s)
            if holds != before:
                self.siderostat.hold(servo.newest_rad)

    # ------------------------------------------------------------ modes

    def obey(self, trigger: Trigger, command: AnyCommand) -> None:
        """Fire what a command is for; a search is made as it asks."""
        if isinstance(command, Acquire):
            self.configure_search(command)
        self.fire(trigger, OPERATOR)

    def configure_search(self, asked: Acquire) -> None:  # noqa: B027 - a loop may search for nothing
        """How the next search, and no other, is to be made, as a command asks that was not refused."""

    def fire(self, trigger: Trigger, reason: str) -> bool:
        """Change the mode as the table has it; False where the trigger is not in this mode's rows."""
        row = transition(self.mode, trigger, self.transitions)
        if row is None:
            return False
        now_s, motor_rad = self._clock.now_s(), self.servo.position_rad
        link_rad = self._read_link(now_s)
        source, self.mode = self.mode, row.target
        if source is not self.mode:
            self.mode_since_s = now_s
        self._enter(source, motor_rad)
        motor_az_rad, motor_el_rad = motor_rad.tolist()
        link_az_rad, link_el_rad = link_rad
        change = ModeChange(
            time_s=now_s,
            loop=self.name,
            source=source.name,
            target=row.target.name,
            target_number=int(row.target),
            trigger=trigger.name,
            reason=reason,
            siderostat_az_rad=motor_az_rad,
            siderostat_el_rad=motor_el_rad,
            link_az_rad=link_az_rad,
            link_el_rad=link_el_rad,
        )
        if source is not self.mode or self.last_change is None:
            self.last_change = (
                change  # a STOP of a loop that is SAFE leaves the fault as its reason
            )
        self._journal.record(change)
        self._report_event(
            _SEVERITY.get(trigger, "info"), f"{source.name} -> {row.target.name}: {reason}"
        )
        return True

    def _read_link(self, now_s: float) -> AzEl:
        """Motor angles of the siderostat of the loop's link, read now; NaN without a link."""
        return math.nan, math.nan

    def _enter(self, source: Mode, motor_rad: Floats) -> None:
        """Do what a change from `source` to the mode needs, with the motors at `motor_rad`, shape (2,)."""
        if self.mode in AT_REST:  # in OFF, before the amplifiers lose their power
            self.servo.stop()
        elif self.mode is Mode.STANDBY:
            self.siderostat.hold(motor_rad)

    def fail(self, source: str, reason: str) -> None:
        """Go to SAFE because `source` failed; where that changes nothing, report a reason that is new."""
        changed = self.fire(Trigger.FAULT, reason)
        if not changed and all(reason != known for _, known in self._failures):
            self._report_event("error", reason)
        if (source, reason) not in self._failures:
            self._failures.append((source, reason))

    def device_failed(self, device: FailingDevice, error: Exception) -> None:
        """Record that a device failed while it was used, and :meth:`fail`."""
        reason = error_text(error)
        if (device, reason) not in self._failures:
            self._journal.failure(self.name, device, error)
        self.fail(device, reason)

    def _report_event(self, severity: Severity, message: str) -> None:
        self._journal.event(severity, self.name, message)
