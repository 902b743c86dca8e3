"""What must be true at every moment, whatever happens: evaluated at each tick and at each thing sent."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.lines import Line
from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import AzEl
from fitctl.logging.records import AnyRecord, DevicesOpened, Event, ModeChange, PiezoReading, Tick
from fitctl.messages.commands import AnyCommand, Look, Recover, Reply, Standby, Stop
from fitctl.messages.modes import FOLLOWING, Mode, Trigger
from fitctl.model.plant import Plant
from fitctl.service.admission import Sender
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]
_SLACK = 1.0 + 1e-6
POWER_S = 1.0  # a loop may have power without need, or need without power, no longer than this
_AT_REST = frozenset({Mode.OFF, Mode.SAFE})
_FOLLOWING = frozenset(mode.name for mode in FOLLOWING)
_SLOWLY = frozenset({Mode.OFF, Mode.SAFE, Mode.STANDBY})
_FOR_ALL = {"Status", "RecentEvents"}
_OF_THIS_MACHINE = {"RecorderReport", "LearnerReport"}
_OF_COMMANDERS = {"Stop", "TakeOver", "SequenceControl", "SequenceReport"}
_MOST_STEP_S = 1.0  # and as much for each loop with a D/A, which is read after a pause
_MOST_PERIODS = 2.0  # a frame on which a tick acts is no older than that and its delay
_WELL_S = 2.0
_LEFT_S = 2.0  # a supervisor leaves where its stars are once a second
_JUMP_RAD = 1.0  # what motors may coast unseen, and somewhat more
_MOST_BUSY_S = 60.0
_MOST_VIOLATIONS = 20
_MOST_ALIKE = 3
_MOST_UNREAD_S = 14.0  # interlock piezo_limit does not wait longer
_CHECKED_S = 0.5  # so often the swarm checks which star a loop follows
_ANOTHERS_PX = 6.0  # from its own star, no window of a loop shows its own
_MOST_WRONG_S = 10.0


class Violation(NamedTuple):
    """Something that must not be."""

    invariant: str
    at_s: float
    detail: str


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
        self._rig = rig
        self._clock = clock
        self._amplifiers = amplifiers
        self._lines = lines
        self._plant = plant
        self._supervisor: Supervisor | None = None
        # What every tick needs, once.
        self._stellar_loops = rig.stellar_loops
        self._most_rad_s = {
            name: loop.siderostat.velocity_limit_rad_s * _SLACK for name, loop in rig.loops.items()
        }
        self._three_periods_s = {
            name: 3 / loop.siderostat.servo.rate_hz for name, loop in rig.loops.items()
        }
        camera = rig.camera
        self._oldest_s = camera.frame_delay_s + _MOST_PERIODS * camera.period_s
        self._most_step_s = _MOST_STEP_S * (1 + len(self._stellar_loops))
        self._resting_since_s = dict.fromkeys(rig.loops, 0.0)
        self._slowly: dict[str, bool] = {}
        self._powerless_since_s: dict[str, float] = {}
        self._unneeded_since_s: dict[str, float] = {}
        self._busy_since_s = math.inf
        self._stepped_s = 0.0
        self.nothing_fails = False
        self._stopped_s: dict[str, float] = {}  # by loop: a stop that no power-up has followed
        self._power_up_s: dict[str, float] = {}
        self._stop_answered_s: dict[str, float] = {}
        self._texts: Counter[str] = Counter()  # of errors, since devices were opened
        self._piezo_read_s: dict[str, float] = {}
        self._lease = "", -math.inf
        self._opened: set[str] = set()
        self._zeros_lost_rad: dict[str, float] = {}  # by loop: nobody has read the encoders since
        self._zeros_read_rad: dict[str, float] = {}  # by loop: read, in an opening that goes on
        self._zeros_noticed_s: dict[str, float] = {}
        self._checked_s: dict[str, float] = {}  # by loop: when the swarm last checked its star
        self._wrong_since_s: dict[str, float] = {}  # by loop: since when it follows another star
        self._pointed_at: set[str] = set()  # a person said which star these loops follow

    def watch(self, supervisor: Supervisor | None) -> None:
        """Watch this one from now on; without one, what needs none."""
        self._zeros_lost_rad = self._zeros_read_rad | self._zeros_lost_rad
        self._zeros_read_rad.clear()
        for name, noticed_s in self._zeros_noticed_s.items():
            # A killed supervisor may have left the star's place from before it noticed.
            if self._clock.now_s() - noticed_s < _LEFT_S:
                self._zeros_lost_rad.setdefault(name, 0.0)
        self._supervisor = supervisor
        self._lease = "", -math.inf
        self._opened.clear()
        self._stopped_s.clear()
        self._power_up_s.clear()
        self._stop_answered_s.clear()
        self._texts.clear()
        self._piezo_read_s = dict.fromkeys(self._rig.loops, math.inf)
        self._slowly.clear()
        self._powerless_since_s.clear()
        self._unneeded_since_s.clear()
        self._wrong_since_s.clear()
        self._pointed_at.clear()
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
        for name in self._stopped_s:
            self._stopped_s[name] = max(self._stopped_s[name], self._stepped_s)
        for since_s in (self._powerless_since_s, self._unneeded_since_s):
            for name in since_s:
                since_s[name] += added_s

    def zero_lost(self, name: str) -> None:
        """A loop's encoders begin anew at zero."""
        position_rad = 0.0
        if self._supervisor is not None:
            position_rad = float(np.abs(self._supervisor.loops[name].servo.position_rad).max())
        self._zeros_lost_rad[name] = max(position_rad, self._zeros_lost_rad.get(name, 0.0))

    def encoders_read(self, name: str) -> None:
        """A loop's encoders are read for the first time since its amplifiers were opened."""
        lost_rad = self._zeros_lost_rad.pop(name, None)
        if lost_rad is not None:
            self._zeros_read_rad[name] = max(lost_rad, self._zeros_read_rad.get(name, 0.0))

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
        if may and (takes or holder == sender.name):
            self._lease = sender.name, now_s

    def posted(self, command: AnyCommand) -> None:
        """A command is on its way to the supervisor."""
        if isinstance(command, Stop):
            for name in self._named(command):
                self._stopped_s[name] = self._clock.now_s()

    def answered(self, command: AnyCommand, reply: Reply) -> None:
        """A command was obeyed or refused."""
        if not reply.accepted:
            return
        now_s = self._clock.now_s()
        for name in self._named(command):
            if isinstance(command, Stop):
                self._stop_answered_s[name] = now_s
            elif isinstance(command, Standby | Recover):
                self._power_up_s[name] = now_s
            elif isinstance(command, Look):
                self._pointed_at.add(name)

    def _named(self, command: AnyCommand) -> list[str]:
        return [name for name in self._rig.loops if command.loop in {"", name}]

    def record(self, record: AnyRecord) -> None:
        """The supervisor makes a record."""
        match record:
            case Tick(number=number):  # the most frequent first
                if number >= 0:
                    self._acted_on(record)
                    self._follows(record)
            case ModeChange():
                self._mode_changed(record)
            case Event():
                self._reported(record)
            case DevicesOpened():
                self._texts.clear()
                if not record.error:
                    self._opened_well(record)
                    self._opened.add(record.loop)
            case PiezoReading():
                self._piezo_read_s[record.loop] = record.time_s

    def _opened_well(self, opened: DevicesOpened) -> None:
        name = opened.loop
        # Encoders that lost their zero after this opening had read them are noticed by the next.
        lost_rad = self._zeros_read_rad.pop(name, None)
        if lost_rad is not None:
            self._zeros_noticed_s[name] = self._clock.now_s()
        if opened.encoders_jumped and lost_rad is None and not self._reads_zero(name):
            self.violated("encoders that count on keep the star's place", name)
        is_far = lost_rad is not None and lost_rad > _JUMP_RAD and name in self._opened
        if is_far and not opened.encoders_jumped:
            self.violated("encoders that count from elsewhere are noticed", name)

    def _reads_zero(self, name: str) -> bool:
        """Encoders near zero: motors that passed there look the same as a loss of power."""
        supervisor = self._supervisor
        return supervisor is not None and bool(
            np.abs(supervisor.loops[name].servo.position_rad).max() < _JUMP_RAD / 2
        )

    def _acted_on(self, tick: Tick) -> None:
        oldest_s = self._oldest_s
        if tick.frame_age_s > oldest_s and self._camera_well():
            self.violated(
                "a tick acts on the newest frame",
                f"{tick.loop}: one of {tick.frame_age_s:.3f} s, at most {oldest_s:.3f} s",
            )

    def _follows(self, tick: Tick) -> None:
        """Whether the star that a loop follows is its own, unless a person pointed at it."""
        name, now_s = tick.loop, tick.mid_exposure_s
        if not now_s - self._checked_s.get(name, -math.inf) >= _CHECKED_S:
            return
        self._checked_s[name] = now_s
        part = self._plant.stellar_loops[name]
        own_az_px, own_el_px = part.spots_at_px(self._plant.row(now_s))[0, 0].tolist()
        away_px = math.hypot(tick.star_az_px - own_az_px, tick.star_el_px - own_el_px)
        follows = tick.mode in _FOLLOWING and name not in self._pointed_at
        if not (follows and away_px >= _ANOTHERS_PX):  # nor without a star
            self._wrong_since_s.pop(name, None)
            return
        since_s = self._wrong_since_s.setdefault(name, now_s)
        if now_s - since_s > _MOST_WRONG_S:
            self.violated(
                "a loop follows its own star",
                f"{name}: in {tick.mode} at az {tick.star_az_px:.1f}, el {tick.star_el_px:.1f} px for "
                f"{now_s - since_s:.1f} s; its own is at az {own_az_px:.1f}, el {own_el_px:.1f} px",
            )

    def _camera_well(self) -> bool:
        """Nothing has been wrong with the camera's line for a while."""
        line = self._lines["camera"]
        return not line.faults and self._clock.now_s() - line.healed_s > _WELL_S

    def _mode_changed(self, change: ModeChange) -> None:
        name = change.loop
        if change.target == Mode.ACQUISITION.name:
            self._pointed_at.discard(name)
        if change.target == Mode.STANDBY.name and change.source in {"OFF", "SAFE"}:
            self._stopped_s.pop(name, None)
            stop_s = self._stop_answered_s.get(name, -math.inf)
            if self._power_up_s.get(name, math.inf) < stop_s:
                self.violated("a stop has the last word", f"{name}: powered up after it")
        if "following error below" in change.reason:
            self.violated("an axis that is not stuck is not called so", f"{name}: {change.reason}")
        if change.trigger == Trigger.FAULT.name and self.nothing_fails:
            self.violated("without a fault nothing fails", f"{name}: {change.reason}")

    def _reported(self, event: Event) -> None:
        if event.severity == "error" and event.source in self._rig.loops:
            if "->" not in event.message:
                self._texts[event.message] += 1
            if self._texts[event.message] > _MOST_ALIKE:
                self.violated("a cause is reported once", f"{event.source}: {event.message}")

    # ------------------------------------------------------------ what is sent

    def velocity(self, name: str, velocity_rad_s: AzEl) -> None:
        """A velocity is sent to a loop's motors."""
        fastest_rad_s = max(abs(velocity_rad_s[0]), abs(velocity_rad_s[1]))
        if not fastest_rad_s <= self._most_rad_s[name]:
            self.violated("velocity within its limit", f"{name}: {velocity_rad_s} rad/s")
        supervisor = self._supervisor
        if supervisor is None or fastest_rad_s == 0.0:
            return
        if name in self._zeros_lost_rad or name in self._zeros_read_rad:
            self.violated(
                "no stage moves by a zero that is lost", f"{name}: {velocity_rad_s} rad/s"
            )
        loop, three_periods_s = supervisor.loops[name], self._three_periods_s[name]
        since_stop_s = self._clock.now_s() - self._stopped_s.get(name, math.inf)
        if since_stop_s > three_periods_s:
            self.violated(
                "a stop is obeyed at once",
                f"{name}: {velocity_rad_s} rad/s {since_stop_s:.3f} s after it",
            )
        if loop.mode in _AT_REST:
            at_rest_s = self._clock.now_s() - loop.mode_since_s
            if at_rest_s > three_periods_s:
                self.violated(
                    "no stage moves in OFF or SAFE",
                    f"{name}: {velocity_rad_s} rad/s after {at_rest_s:.3f} s in {loop.mode.name}",
                )

    def powered_unread(self, name: str) -> None:
        """Motors are given power, and nobody has read where they are."""
        self.violated("encoders are read before motors have power", name)

    def volts(self, name: str, volts: Floats, before_v: Floats) -> None:
        """Voltages are sent to a loop's mirror, whose D/A has others until they arrive."""
        fsm = self._stellar_loops[name].fsm
        wanted_v = volts.tolist()  # floats, for arrays of three take ten times as long
        full_scale_v = fsm.dac.full_scale_v
        if not all(0.0 <= volt <= full_scale_v for volt in wanted_v):
            self.violated("voltages within their limits", f"{name}: {volts} V")
        if self._supervisor is None:
            return
        # The first write in a mode was decided in the one before.
        slowly = self._supervisor.loops[name].mode in _SLOWLY
        was_slow, self._slowly[name] = self._slowly.get(name, False), slowly
        if not (slowly and was_slow):
            return
        step_v = max(abs(v - b) for v, b in zip(wanted_v, before_v.tolist(), strict=True))
        most_v = fsm.slew_v_per_s * self._rig.camera.period_s * _SLACK + fsm.dac.step_v
        if not step_v <= most_v:
            self.violated(
                "the mirror rests no faster than its slew",
                f"{name}: {step_v:.3f} V in one write, at most {most_v:.3f} V",
            )

    # ------------------------------------------------------------ once a tick

    def tick(self) -> None:
        """What must be true after a step."""
        supervisor = self._supervisor
        if supervisor is None:
            return
        now_s = self._clock.now_s()
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
        for name, loop in supervisor.loops.items():
            self._power(name, loop.mode, busy=jobs.busy, now_s=now_s)

    def _power(self, name: str, mode: Mode, *, busy: bool, now_s: float) -> None:
        """Whether the amplifiers have power where they need it, and none where nobody does.

        Amplifiers that watch nobody keep it where their link broke, or their supervisor was killed.
        """
        amplifiers = self._amplifiers[name]
        if amplifiers.watches_nobody and (
            name not in self._opened or not amplifiers.line.connected
        ):
            self._unneeded_since_s.pop(name, None)
            return
        reachable = amplifiers.line.connected and not amplifiers.line.faults
        needs = mode not in _AT_REST
        if needs and not busy and not amplifiers.powered:
            since_s = self._powerless_since_s.setdefault(name, now_s)
            if now_s - since_s > POWER_S:
                self.violated(
                    "a loop that points has power", f"{name}: none in {mode.name} for {POWER_S:g} s"
                )
        else:
            self._powerless_since_s.pop(name, None)
        if mode in _AT_REST and not busy and amplifiers.powered and (reachable or mode is Mode.OFF):
            since_s = self._unneeded_since_s.setdefault(name, now_s)
            most_s = POWER_S + (
                self._rig.supervisor.safe_disable_after_s if mode is Mode.SAFE else 0.0
            )
            if now_s - since_s > most_s:
                self.violated(
                    "amplifiers have no power that nobody needs",
                    f"{name}: powered in {mode.name} for {most_s:g} s",
                )
        else:
            self._unneeded_since_s.pop(name, None)
