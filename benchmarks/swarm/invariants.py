"""What must be true at every moment, whatever happens: evaluated at each tick and at each thing sent."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.devices.hexapod import SwarmHexapod
from benchmarks.swarm.lines import WRONG_S, Line
from benchmarks.swarm.motion import STUCK_S, WELL_S, Motion
from benchmarks.swarm.own_stars import OwnStars, turned_by
from benchmarks.swarm.zeros import Zeros
from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.controllers.pair import LEARNT
from fitctl.logging.records import (
    AnyRecord,
    ControllerChange,
    DeviceFailure,
    DevicesOpened,
    Event,
    MetrologyTick,
    ModeChange,
    PiezoReading,
    Tick,
)
from fitctl.loop.loop import Loop
from fitctl.messages.commands import (
    AnyCommand,
    Experiment,
    Jog,
    Look,
    MoveCollector,
    Off,
    Recover,
    Release,
    Reply,
    SequenceControl,
    SetBiasOffset,
    Standby,
    Stop,
)
from fitctl.messages.modes import AT_REST, OPERATOR, Mode, Trigger
from fitctl.model.drives import experiment_s
from fitctl.model.plant import Plant
from fitctl.service.admission import Sender
from fitctl.stages.journal import NO_MISTAKE
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]
NO_EXCEPTION = "no exception escapes"
ANSWERED_ONCE = "a command is answered once"
POWER_S = 1.0  # a loop may have power without need, or need without power, no longer than this
_CAUSE_S = 10.0  # before a fault, in which its cause must have been
_LEADS_TO: dict[type, frozenset[Mode]] = {
    Off: frozenset({Mode.OFF}),
    Release: frozenset({Mode.OFF, Mode.SAFE, Mode.STANDBY}),
    Stop: AT_REST,
}
"""Modes of a loop once such a command has been accepted for it."""
_FOR_ALL = {"Status", "RecentEvents"}
_OF_THIS_MACHINE = {"RecorderReport", "LearnerReport"}
_OF_COMMANDERS = {"Stop", "TakeOver", "SequenceControl", "SequenceReport"}
_MOST_STEP_S = 1.0  # and as much for each loop with a D/A, which is read after a pause
_MOST_PERIODS = 2.0  # a frame on which a tick acts is no older than that and its delay
_MOST_BUSY_S = 60.0
_MOST_VIOLATIONS = 20
_MOST_ALIKE = 3
_MOST_UNREAD_S = 14.0  # interlock piezo_limit does not wait longer
# As `made_safe` in the fault catalogue, tests/faults/devices.py.
_SAFE_S, _SAFE_BY_PIEZO_S = 3.0, 8.0
_RESTS_S = 1.0  # beyond the time after which a drive without its master stops by itself
_SURELY = 1.2  # times the following error limit: a servo that is behind so far must notice
_COLLECTOR_RESTS_S = 3.0
_SEQUENCE_ENDS_S = 15.0
_EXPERIMENT_ENDS_S = 1.0  # after its last motion


class Violation(NamedTuple):
    """Something that must not be."""

    invariant: str
    at_s: float
    detail: str


class _Lasting:
    """For how long something has been so without a pause, by name; the machine's stalls do not count."""

    def __init__(self) -> None:
        self._since_s: dict[str, float] = {}

    def lasted_s(self, name: str, *, is_so: bool, now_s: float, from_s: float = -math.inf) -> float:
        """For how long it has been so, as far as that was after `from_s`; 0 if it is not so now."""
        if not is_so:
            self._since_s.pop(name, None)
            return 0.0
        since_s = self._since_s[name] = max(from_s, self._since_s.get(name, now_s))
        return now_s - since_s

    def is_so(self, name: str) -> bool:
        """It was so when last judged."""
        return name in self._since_s

    def leave_out(self, left_out_s: float) -> None:
        """Do not count a time."""
        for name in self._since_s:
            self._since_s[name] += left_out_s

    def clear(self) -> None:
        """Begin anew."""
        self._since_s.clear()


class Invariants:
    """Of one supervisor's life.

    Parameters
    ----------
    rig : Rig
    clock : Clock
    amplifiers : mapping of str to SwarmAmplifiers
        By loop.
    lines : mapping of str to Line
        By device.
    plant : Plant
        Where the stars truly are.
    """

    def __init__(
        self,
        rig: Rig,
        clock: Clock,
        amplifiers: Mapping[str, SwarmAmplifiers],
        lines: Mapping[str, Line],
        plant: Plant,
    ) -> None:
        self.violations: list[Violation] = []
        self.hexapod: SwarmHexapod | None = None
        self._rig = rig
        self._clock = clock
        self._amplifiers = amplifiers
        self._lines = lines
        self._supervisor: Supervisor | None = None
        self.zeros = Zeros(clock, lines, self.violated)
        self.own_stars = OwnStars(rig, clock, lines, plant, self.violated)
        self.motion = Motion(
            rig, clock, amplifiers, lines, plant, self.violated, self.zeros.is_lost
        )
        self._stellar_loops = rig.stellar_loops
        self._needed = {name: list(self._needed_devices(name)) for name in rig.loops}
        camera = rig.camera
        self._oldest_s = camera.frame_delay_s + _MOST_PERIODS * camera.period_s
        self._most_step_s = _MOST_STEP_S * (1 + len(self._stellar_loops))
        self._busy_since_s = math.inf
        self._stepped_s = 0.0
        self._powerless, self._unneeded = _Lasting(), _Lasting()
        self._silent, self._turning, self._stopped_for = _Lasting(), _Lasting(), _Lasting()
        self._experimenting, self._sticking, self._ending = _Lasting(), _Lasting(), _Lasting()
        self._ended_run = ""  # the sequence that was ordered to end last
        self._lasting = (
            self._powerless,
            self._unneeded,
            self._silent,
            self._turning,
            self._stopped_for,
            self._experimenting,
            self._sticking,
            self._ending,
        )
        self._ticked_s = 0.0
        self._experiment_s: dict[str, float] = {}  # by loop: how long the newest takes
        self._collector_is_stopped = False
        self.nothing_fails = False
        self._power_up_s: dict[str, float] = {}
        self._stop_answered_s: dict[str, float] = {}
        self._ticks: Counter[str] = Counter()  # by loop: recorded in this step
        self._texts: Counter[str] = Counter()  # of errors, since devices were opened
        self._piezo_read_s: dict[str, float] = {}
        self._lease = "", -math.inf
        self._admitted: list[tuple[AnyCommand, str]] = []  # and not yet passed on
        self._opened: set[str] = set()
        self._struck_s: dict[str, float] = {}  # by device

    def _needed_devices(self, name: str) -> Iterator[tuple[str, float]]:
        """The devices whose silence makes a loop go to SAFE in any other mode but OFF, and within what time.

        A siderostat ends its servo, a D/A or a camera fails in the tick that uses it, interlock frame_missing
        is for a camera that sends nothing, and interlock diode_samples for photodiodes. A piezo amplifier has
        longer: it is read once a second, and has failed at the second bad answer.
        """
        yield f"{name} siderostat", _SAFE_S
        if name in self._rig.metrology_loops:
            yield f"{name} photodiodes", _SAFE_S
        else:
            yield "camera", _SAFE_S
            yield f"{name} D/A", _SAFE_S
            yield f"{name} piezo", _SAFE_BY_PIEZO_S

    def watch(self, supervisor: Supervisor | None) -> None:
        """Watch this one from now on; without one, what needs none."""
        self._supervisor = supervisor
        self.zeros.watch(supervisor)
        self.own_stars.watch(supervisor)
        self.motion.watch(supervisor)
        self._lease = "", -math.inf
        self._admitted.clear()
        self._opened.clear()
        self._power_up_s.clear()
        self._stop_answered_s.clear()
        self._texts.clear()
        self._piezo_read_s = dict.fromkeys(self._rig.loops, math.inf)
        self._ticks.clear()
        for lasting in self._lasting:
            lasting.clear()
        self._collector_is_stopped = False
        self._busy_since_s = math.inf
        # A machine that stands still does so for the next supervisor too.
        self._stepped_s = max(self._stepped_s, self._clock.now_s())

    def violated(self, invariant: str, detail: str) -> None:
        """Note a violation; the first of each invariant says enough."""
        known = any(one.invariant == invariant for one in self.violations)
        if not known and len(self.violations) < _MOST_VIOLATIONS:
            self.violations.append(Violation(invariant, self._clock.now_s(), detail))

    def stalled(self, until_s: float, added_s: float) -> None:
        """The machine stands still, `added_s` longer than was known, and nothing can be expected of it."""
        self._stepped_s = max(self._stepped_s, until_s)
        self.motion.stall_ended_s = until_s
        self._ticked_s += added_s  # so that a stall is not left out twice
        for name in self.motion.stopped_s:
            self.motion.stopped_s[name] = max(self.motion.stopped_s[name], self._stepped_s)
        for lasting in self._lasting:
            lasting.leave_out(added_s)

    # ------------------------------------------------------------ commands and records

    def admitted(self, sender: Sender, command: AnyCommand, refusal: str) -> None:
        """The service has let a command in, or refused it: nobody may do more or less than is theirs."""
        name, now_s = type(command).__name__, self._clock.now_s()
        holder, heard_s = self._lease
        holder = holder if now_s - heard_s <= self._rig.service.lease_s else ""
        if name in _FOR_ALL:
            may = True
        elif name in _OF_THIS_MACHINE:
            may = sender.is_local
        elif name in _OF_COMMANDERS:
            may = sender.role == "commander"
        else:
            may = sender.role == "commander" and holder in {"", sender.name}
        if may == bool(refusal):
            self.violated(
                "lease and rights are kept", f"{sender.name}, {name}, {holder!r} has it: {refusal}"
            )
        takes = name not in _FOR_ALL | _OF_THIS_MACHINE | _OF_COMMANDERS or name == "TakeOver"
        if may and (takes or (holder == sender.name and name not in _OF_THIS_MACHINE)):
            self._lease = sender.name, now_s

    def obeyed(self, command: AnyCommand, sender: str) -> None:
        """The service passes a command on to the supervisor, as its sender's."""
        for number, (admitted, by) in enumerate(self._admitted):
            if admitted is command and by == sender:
                del self._admitted[number]
                return
        self.violated(
            "lease and rights are kept", f"{type(command).__name__} of {sender} was not admitted"
        )

    def posted(self, command: AnyCommand, sender: str) -> None:
        """A command is on its way to the supervisor."""
        self._admitted.append((command, sender))
        if isinstance(command, Stop):
            for name in self._named(command):
                self.motion.stopped_s[name] = self._clock.now_s()
        elif isinstance(command, SetBiasOffset | Off):  # `off` ends an offset
            for name in self._named(command):
                self.motion.mirror_moved(name)
        elif isinstance(command, Jog):
            self.motion.jogged_s |= dict.fromkeys(self._named(command), self._clock.now_s())

    def answered(self, command: AnyCommand, reply: Reply) -> None:
        """A command was obeyed or refused."""
        if not reply.accepted:
            return
        now_s = self._clock.now_s()
        if isinstance(command, SequenceControl) and command.action == "end":
            status = self._supervisor.sequences.status() if self._supervisor else None
            self._ended_run = status.run if status else ""
        if isinstance(command, Stop | MoveCollector):  # a stop of whichever loop
            stops = isinstance(command, Stop) or command.action == "stop"
            self._collector_is_to_stop(is_so=stops)
        # A command for all loops is carried out where it is possible; a stop is so everywhere.
        for_each = command.loop or isinstance(command, Stop)
        leads_to = (_LEADS_TO if for_each else {}).get(type(command), frozenset(Mode))
        for name in self._named(command):
            mode = self._supervisor.loops[name].mode if self._supervisor else Mode.OFF
            if mode not in leads_to:
                self.violated(
                    "a command that is accepted is carried out",
                    f"{name}: in {mode.name} after {type(command).__name__}",
                )
            if isinstance(command, Stop):
                self._stop_answered_s[name] = now_s
            elif isinstance(command, SetBiasOffset):
                self.motion.mirror_moved(name)
            elif isinstance(command, Jog):
                self.motion.jogged_s[name] = now_s
            elif isinstance(command, Standby | Recover):
                self._power_up_s[name] = now_s
            elif isinstance(command, Look):
                self.own_stars.pointed_at(name)
            elif isinstance(command, Experiment):
                self._experiment_s[name] = experiment_s(command.drives)
                self.motion.experiment_began(name, command.drives)

    def _collector_is_to_stop(self, *, is_so: bool) -> None:
        if not (is_so and self._collector_is_stopped):
            self._stopped_for.clear()
        self._collector_is_stopped = is_so

    def _named(self, command: AnyCommand) -> list[str]:
        return [name for name in self._rig.loops if command.loop in {"", name}]

    def record(self, record: AnyRecord) -> None:
        """The supervisor makes a record."""
        match record:
            case Tick(number=number):  # the most frequent first
                self._ticks[record.loop] += 1
                if number >= 0:
                    self._acted_on(record)
                    self.own_stars.follows(record)
            case MetrologyTick():
                self._ticks[record.loop] += 1
            case ModeChange():
                self._without_mistake(record.reason)
                self._mode_changed(record)
            case Event():
                self._without_mistake(record.message)
                self._reported(record)
            case DeviceFailure():
                self._without_mistake(record.error)
            case DevicesOpened():
                self._without_mistake(record.error)
                self._texts.clear()
                if not record.error:
                    self.zeros.opened(record, again=record.loop in self._opened)
                    self._opened.add(record.loop)
            case ControllerChange():
                self._controller_changed(record)
            case PiezoReading():
                self._piezo_read_s[record.loop] = record.time_s

    def _without_mistake(self, text: str) -> None:
        """A mistake in fitctl that a thread takes for a fault of its device has its own text."""
        if NO_MISTAKE in text:
            self.violated(NO_EXCEPTION, text)

    def _controller_changed(self, change: ControllerChange) -> None:
        """Another design is in force; the learner's was not chosen by an operator."""
        if (
            change.reason.startswith(OPERATOR)
            or self._supervisor is None
            or change.target != LEARNT
        ):
            return
        loop = self._supervisor.stellar_loops[change.loop]
        if loop.mode is not Mode.VERNIER or loop.learning.setting != "on":
            self.violated(
                "a learnt design comes by itself only while the star is held",
                f"{loop.name}: in {loop.mode.name}, learn = {loop.learning.setting!r}",
            )

    def _acted_on(self, tick: Tick) -> None:
        oldest_s = self._oldest_s
        received_s = tick.mid_exposure_s + tick.frame_age_s
        if tick.frame_age_s > oldest_s and self._camera_well(received_s):
            self.violated(
                "a tick acts on the newest frame",
                f"{tick.loop}: one of {tick.frame_age_s:.3f} s, at most {oldest_s:.3f} s",
            )

    def _camera_well(self, received_s: float) -> bool:
        """Nothing had been wrong with the camera's line for a while by then, and it loses no frames.

        If each frame that came during a stall is lost, one from before the stall is the newest.
        """
        line = self._lines["camera"]
        return not line.is_bad and "drops" not in line.wrong and received_s - line.healed_s > WELL_S

    def _mode_changed(self, change: ModeChange) -> None:
        name = change.loop
        if change.target == Mode.ACQUISITION.name:
            self.own_stars.searched(name)
        is_safe = change.target == Mode.SAFE.name and change.source != Mode.SAFE.name
        if is_safe or (change.target == Mode.OFF.name and self._all_others_are_off(name)):
            self._collector_is_to_stop(is_so=True)
        if change.target == Mode.STANDBY.name and change.source in {"OFF", "SAFE"}:
            self.motion.stopped_s.pop(name, None)
            stop_s = self._stop_answered_s.get(name, -math.inf)
            if self._power_up_s.get(name, math.inf) < stop_s:
                self.violated("a stop has the last word", f"{name}: powered up after it")
        if "following error below" in change.reason and not self._was_stuck(name):
            self.violated("an axis that is not stuck is not called so", f"{name}: {change.reason}")
        if change.trigger == Trigger.FAULT.name and not self._has_cause(name, change.reason):
            self.violated("without a fault nothing fails", f"{name}: {change.reason}")

    def _all_others_are_off(self, name: str) -> bool:
        loops = self._supervisor.loops if self._supervisor else {}
        return all(loop.mode is Mode.OFF for other, loop in loops.items() if other != name)

    def struck(self, device: str) -> None:
        """Something happens to a device at once, or begins."""
        self._struck_s[device] = self._clock.now_s()

    def _has_cause(self, name: str, reason: str) -> bool:
        """Whether the device that a reason names, of the loop or its link, failed, or the machine stalled.

        Interlocks also watch the sky, the star and the computer, which have no device here.
        """
        if self.nothing_fails:
            return False
        now_s = self._clock.now_s()
        if reason.startswith("interlock") or now_s - self.motion.stall_ended_s < _CAUSE_S:
            return True
        return any(
            line.is_bad
            or line.wrong
            or now_s - max(line.healed_s, self._struck_s.get(device, -math.inf)) < _CAUSE_S
            for device, line in self._lines.items()
            if device.partition(" ")[0] in {*turned_by(self._rig, name), "camera", "hexapod"}
            and reason.startswith(line.device)
        )

    def _was_stuck(self, name: str) -> bool:
        """Its motors do not move or an encoder is wrong, or that was so recently, or before a recent stall."""
        stalled = self._clock.now_s() - self.motion.stall_ended_s < STUCK_S
        within_s = WRONG_S if stalled else STUCK_S
        line = self._lines[f"{name} siderostat"]
        return any(line.was_wrong(fault, within_s) for fault in ("stuck", "encoder"))

    def _reported(self, event: Event) -> None:
        if event.message.startswith("waits for "):
            self.own_stars.begins_to_wait(event.source)
        elif event.message.startswith("no longer waits for "):
            self.own_stars.goes_on(event.source)
        if event.severity == "error" and event.source in self._rig.loops:
            if "->" not in event.message:
                self._texts[event.message] += 1
            if self._texts[event.message] > _MOST_ALIKE:
                self.violated("a cause is reported once", f"{event.source}: {event.message}")

    # ------------------------------------------------------------ what is sent

    def powered_unread(self, name: str) -> None:
        """Motors are given power, and nobody has read where they are."""
        self.violated("encoders are read before motors have power", name)

    def closed(self, reached: set[str]) -> None:
        """A supervisor has ended in good order: no amplifiers keep power that it had reached until then."""
        for name, amplifiers in self._amplifiers.items():
            line = amplifiers.line
            was_well = not line.is_bad and self._clock.now_s() - line.healed_s > WELL_S
            if amplifiers.powered and name in reached and was_well:
                self.violated("an orderly end disables the amplifiers", name)

    # ------------------------------------------------------------ once a tick

    def tick(self) -> None:
        """What must be true after a step."""
        supervisor = self._supervisor
        if supervisor is None:
            return
        now_s = self._clock.now_s()
        since_tick_s, self._ticked_s = now_s - self._ticked_s, now_s
        took_s, self._stepped_s = now_s - self._stepped_s, now_s
        if took_s > self._most_step_s:
            self.violated("a step ends", f"one took {took_s:.2f} s")
        jobs = supervisor._device_jobs
        self._busy_since_s = min(self._busy_since_s, now_s) if jobs.busy else math.inf
        if now_s - self._busy_since_s > _MOST_BUSY_S:
            self.violated("opening and closing end", f"busy for {_MOST_BUSY_S:g} s")
        for name, piezo in supervisor.piezos.items():
            if not piezo.is_open or jobs.busy:
                self._piezo_read_s[name] = now_s
            elif now_s - self._piezo_read_s[name] > _MOST_UNREAD_S and piezo.error == "":
                self.violated("an open piezo amplifier is read", f"{name}: not for a long time")
        if jobs.busy:
            self._silent.leave_out(since_tick_s)
            self._sticking.leave_out(since_tick_s)
        for name, loop in supervisor.loops.items():
            if self._ticks[name] != 1 and loop.mode is not Mode.OFF:
                self.violated(
                    "each step records one tick of each loop",
                    f"{name}: {self._ticks[name]} in {loop.mode.name}",
                )
            self._stuck(name, loop, now_s)
            self._power(name, loop.mode, busy=jobs.busy, now_s=now_s)
            self._safe_in_time(name, loop.mode, now_s)
            self._turns(name, loop.mode, now_s)
            self.motion.stands(name, loop, now_s)
            self._experiments(name, loop.mode, now_s)
        self._ticks.clear()
        self._collector_rests(now_s)
        self._sequence_ends(supervisor, now_s)

    def _sequence_ends(self, supervisor: Supervisor, now_s: float) -> None:
        """A sequence that somebody orders to end does so."""
        status = supervisor.sequences.status() if self._ended_run else None
        goes_on = (
            status is not None
            and status.run == self._ended_run
            and status.state in {"running", "paused"}
        )
        lasted_s = self._ending.lasted_s("", is_so=goes_on, now_s=now_s)
        if lasted_s > _SEQUENCE_ENDS_S:
            self.violated("a sequence that is ordered to end does so", f"not in {lasted_s:.1f} s")

    def _safe_in_time(self, name: str, mode: Mode, now_s: float) -> None:
        """A loop with a device that has been silent, or has reported a fault, for long is in SAFE or OFF."""
        for device, most_s in self._needed[name]:
            line = self._lines[device]
            # Over a bad line, fewer answers report a fault.
            fault = self._fault_of(name, device) if line.is_readable else ""
            states = {
                "silent": (line.is_silent, line.answered_s),
                "failing": (fault, line.healed_s),
            }
            for state, (is_so, from_s) in states.items():
                lasted_s = self._silent.lasted_s(
                    f"{name}: {device} {state}",
                    is_so=mode not in AT_REST and bool(is_so),
                    now_s=now_s,
                    from_s=from_s,
                )
                if lasted_s > most_s:
                    how = ", ".join(
                        [*line.faults, *line.at_times, *line.wrong, *filter(None, [fault])]
                    )
                    self.violated(
                        "a loop without one of its devices is SAFE in time",
                        f"{name}: in {mode.name} after {device} was {state} for {lasted_s:.2f} s ({how})",
                    )

    def _stuck(self, name: str, loop: Loop, now_s: float) -> None:
        """A loop whose motors do not move, far from where they are sent, is SAFE in time."""
        line, servo = self._lines[f"{name} siderostat"], loop.servo
        if "stuck" not in line.wrong and not self._sticking.is_so(name):
            return
        wanted_rad, away_rad = servo._wanted_rad, 0.0
        if wanted_rad is not None:
            away_rad = max(
                abs(wanted - at) for wanted, at in zip(wanted_rad, servo.position_rad, strict=True)
            )
        siderostat = self._rig.loops[name].siderostat
        stuck_s = self._sticking.lasted_s(
            name,
            is_so="stuck" in line.wrong
            and loop.mode not in AT_REST
            and line.is_readable
            and away_rad > _SURELY * siderostat.servo.following_error_limit_rad,
            now_s=now_s,
            from_s=line.healed_s,
        )
        if stuck_s > _SAFE_S + away_rad / siderostat.velocity_limit_rad_s:
            self.violated(
                "a loop whose motors are stuck is SAFE in time",
                f"{name}: in {loop.mode.name}, {away_rad:.2f} rad from where it is sent for {stuck_s:.2f} s",
            )

    def _experiments(self, name: str, mode: Mode, now_s: float) -> None:
        """An experiment ends after its last motion."""
        lasted_s = self._experimenting.lasted_s(name, is_so=mode is Mode.EXPERIMENT, now_s=now_s)
        if lasted_s > self._experiment_s.get(name, 0.0) + _EXPERIMENT_ENDS_S:
            self.violated("an experiment ends", f"{name}: in EXPERIMENT for {lasted_s:.2f} s")

    def _fault_of(self, name: str, device: str) -> str:
        """The fault that a device reports whenever it answers, if that demands SAFE."""
        kind = device.rpartition(" ")[2]
        if kind == "siderostat":
            return self._amplifiers[name].fault
        wrong = self._lines[device].wrong
        return ", ".join(sorted(wrong)) if kind in {"D/A", "piezo"} else ""

    def _turns(self, name: str, mode: Mode, now_s: float) -> None:
        """Motors stand still in OFF and SAFE; a drive without a watchdog cannot be stopped over a bad line."""
        amplifiers = self._amplifiers[name]
        line = amplifiers.line
        turns = mode in AT_REST and amplifiers.velocity_rad_s != (0.0, 0.0)
        if turns and amplifiers.watches_nobody:
            turns = name in self._opened and line.connected and not line.is_bad
        turned_s = self._turning.lasted_s(name, is_so=turns, now_s=now_s)
        if turned_s > amplifiers.master_timeout_s + _RESTS_S:
            self.violated(
                "motors stand still in OFF and SAFE",
                f"{name}: {amplifiers.velocity_rad_s} rad/s for {turned_s:.2f} s in {mode.name}",
            )

    def _collector_rests(self, now_s: float) -> None:
        """A stop, a loop that goes to SAFE, or `off` for the last loop, brings the platform to rest."""
        hexapod = self.hexapod
        if hexapod is None:
            return
        line = hexapod.line
        stopped_s = self._stopped_for.lasted_s(
            "",
            is_so=self._collector_is_stopped and line.connected and not line.is_bad,
            now_s=now_s,
            from_s=line.healed_s,
        )
        # A course is many short moves: between two of them the platform is at rest.
        if stopped_s > _COLLECTOR_RESTS_S and hexapod.moves:
            self.violated(
                "a stop stops the collector",
                f"it moves {stopped_s:.2f} s after a stop, SAFE, or `off` for all loops",
            )

    def _power(self, name: str, mode: Mode, *, busy: bool, now_s: float) -> None:
        """Whether the amplifiers have power where they need it, and none where nobody does.

        Amplifiers that watch nobody keep it where their link broke, or their supervisor was killed.
        """
        amplifiers = self._amplifiers[name]
        if amplifiers.watches_nobody and (
            name not in self._opened or not amplifiers.line.connected
        ):
            self._unneeded.lasted_s(name, is_so=False, now_s=now_s)
            return
        reachable = amplifiers.line.connected and not amplifiers.line.is_bad
        rests = mode in AT_REST
        powerless_s = self._powerless.lasted_s(
            name, is_so=not (rests or busy or amplifiers.powered), now_s=now_s
        )
        if powerless_s > POWER_S:
            self.violated(
                "a loop that points has power", f"{name}: none in {mode.name} for {POWER_S:g} s"
            )
        unneeded = rests and not busy and amplifiers.powered and (reachable or mode is Mode.OFF)
        unneeded_s = self._unneeded.lasted_s(name, is_so=unneeded, now_s=now_s)
        most_s = POWER_S + (self._rig.supervisor.safe_disable_after_s if mode is Mode.SAFE else 0.0)
        if unneeded_s > most_s:
            self.violated(
                "amplifiers have no power that nobody needs",
                f"{name}: powered in {mode.name} for {most_s:g} s",
            )
