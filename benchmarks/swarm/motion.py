"""Checks of what fitctl sends to the stages, and of how they move."""

from __future__ import annotations

import math
import operator
from collections.abc import Callable, Mapping

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.lines import Line
from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import AzEl, Pose
from fitctl.loop.loop import Loop
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.modes import AT_REST, POINTING, Mode
from fitctl.model.drives import SIDEROSTAT, Drive
from fitctl.model.plant import Plant
from fitctl.stages.injector import PERIOD_S
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]
_HARDLY = 0.02  # of the velocity limit: slower, a servo corrects what its encoder counts
_MOVED_S = 1.0  # beyond the time that a siderostat takes from one end of its travel to the other
# Beyond the time that it takes to slow down; and in times of the servo's own, until that has settled.
_STANDS_S, _SETTLED = 0.2, 10.0
_MIRROR_RESTS_S = 1.0  # beyond the time that a mirror takes through its whole range
WELL_S = 2.0  # after a fault, a line is taken to be well
_DECIDED_S = 0.001  # no later than this after its decision a write is sent, on a line that is well
_MOST_COUNTS = 5.0  # of the encoder: a siderostat that stands still moves no farther
_SLOWLY = AT_REST | {Mode.STANDBY}
_STILL: AzEl = (0.0, 0.0)
_SLACK = 1.0 + 1e-6
STUCK_S = 1.0  # for so long after motors were stuck, a servo may still be behind its reference


class Motion:
    """The stages of one supervisor's life.

    Parameters
    ----------
    rig : Rig
    clock : Clock
    amplifiers : mapping of str to SwarmAmplifiers
        By loop.
    lines : mapping of str to Line
        By device.
    plant : Plant
    violated : callable
        Takes an invariant and what violates it.
    zero_is_lost : callable
        Whether a loop's encoders count from elsewhere, and no opening has noticed.

    Attributes
    ----------
    supervisor : Supervisor or None
    stopped_s : dict of str to float
        By loop: a stop that no power-up has followed.
    jogged_s : dict of str to float
        By loop: the last jog.
    stall_ended_s : float
        When the last stall of the machine ended or will end.
    """

    def __init__(
        self,
        rig: Rig,
        clock: Clock,
        amplifiers: Mapping[str, SwarmAmplifiers],
        lines: Mapping[str, Line],
        plant: Plant,
        violated: Callable[[str, str], None],
        zero_is_lost: Callable[[str], bool],
    ) -> None:
        self.supervisor: Supervisor | None = None
        self.stopped_s: dict[str, float] = {}
        self.jogged_s: dict[str, float] = {}
        self.stall_ended_s = 0.0
        self._rig = rig
        self._clock = clock
        self._amplifiers = amplifiers
        self._lines = lines
        self._plant = plant
        self._violated = violated
        self._zero_is_lost = zero_is_lost
        self._mirror_moved_s: dict[str, float] = {}  # by loop: when something moved it that may
        self._sent_rad_s: dict[str, AzEl] = {}
        self._mirror_only_returns: dict[str, bool] = {}  # by loop: in its newest experiment
        self._slowly: dict[str, bool] = {}  # by loop: the last write was in a mode of rest
        self._standing_rad: dict[str, list[float]] = {}
        # What every period needs, once.
        self._stellar_loops = rig.stellar_loops
        self._most_rad_s = {
            name: loop.siderostat.velocity_limit_rad_s * _SLACK for name, loop in rig.loops.items()
        }
        self._three_periods_s = {
            name: 3 / loop.siderostat.servo.rate_hz for name, loop in rig.loops.items()
        }
        self._travel_rad, self._farthest_rad, self._moved_s, self._slowed_s = {}, {}, {}, {}
        self._held_s: dict[str, float] = {}  # by loop: since when it is held
        self._turned_rad: dict[str, list[float]] = {}  # by loop: beyond its travel, how far it was
        for name, loop in rig.loops.items():
            siderostat = loop.siderostat
            # A servo acts on readings of up to this age, and its command takes up to three periods to arrive.
            unseen_s = self._three_periods_s[name] + 1 / siderostat.servo.gain_per_s
            self._travel_rad[name] = travel_rad = siderostat.travel_rad
            self._farthest_rad[name] = travel_rad + siderostat.velocity_limit_rad_s * unseen_s
            self._turned_rad[name] = [self._farthest_rad[name]] * 2
            crossing_s = 2 * travel_rad / siderostat.velocity_limit_rad_s
            self._moved_s[name] = crossing_s + _MOVED_S
            slows_s = siderostat.velocity_limit_rad_s / siderostat.acceleration_limit_rad_s2
            self._slowed_s[name] = slows_s + _STANDS_S + _SETTLED / siderostat.servo.gain_per_s
        self._velocity_step_rad_s = {
            name: loop.siderostat.acceleration_limit_rad_s2 / loop.siderostat.servo.rate_hz * _SLACK
            for name, loop in rig.loops.items()
        }

    def watch(self, supervisor: Supervisor | None) -> None:
        """Watch the stages of this one from now on."""
        self.supervisor = supervisor
        self.stopped_s.clear()
        self.jogged_s.clear()
        self._slowly.clear()
        self._standing_rad.clear()
        self._held_s.clear()

    def velocity(self, name: str, velocity_rad_s: AzEl) -> None:
        """A velocity is sent to a loop's motors."""
        fastest_rad_s = max(abs(velocity_rad_s[0]), abs(velocity_rad_s[1]))
        if not fastest_rad_s <= self._most_rad_s[name]:
            self._violated("velocity within its limit", f"{name}: {velocity_rad_s} rad/s")
        before_rad_s, self._sent_rad_s[name] = self._sent_rad_s.get(name, _STILL), velocity_rad_s
        supervisor = self.supervisor
        if supervisor is None or fastest_rad_s == 0.0:  # a stop is not limited
            return
        step_rad_s = max(map(abs, map(operator.sub, velocity_rad_s, before_rad_s)))
        if not step_rad_s <= self._velocity_step_rad_s[name]:
            self._violated(
                "acceleration within its limit", f"{name}: {before_rad_s} to {velocity_rad_s} rad/s"
            )
        if self._zero_is_lost(name):
            self._violated(
                "no stage moves by a zero that is lost", f"{name}: {velocity_rad_s} rad/s"
            )
        else:
            self._within_travel(name, velocity_rad_s)
        loop, three_periods_s = supervisor.loops[name], self._three_periods_s[name]
        since_stop_s = self._clock.now_s() - self.stopped_s.get(name, math.inf)
        if since_stop_s > three_periods_s:
            self._violated(
                "a stop is obeyed at once",
                f"{name}: {velocity_rad_s} rad/s {since_stop_s:.3f} s after it",
            )
        if loop.mode in AT_REST:
            at_rest_s = self._clock.now_s() - loop.mode_since_s
            if at_rest_s > three_periods_s:
                self._violated(
                    "no stage moves in OFF or SAFE",
                    f"{name}: {velocity_rad_s} rad/s after {at_rest_s:.3f} s in {loop.mode.name}",
                )

    def _within_travel(self, name: str, velocity_rad_s: AzEl) -> None:
        """No motor that is beyond the travel, by the drive's count, is driven farther out.

        One that was sent back and is then held may turn round, and return no farther than it was.
        """
        if self._lines[f"{name} siderostat"].was_wrong("encoder", STUCK_S):
            return
        travel_rad = self._travel_rad[name]
        hardly_rad_s = _HARDLY * self._most_rad_s[name]
        motors_rad = self._plant.loops[name].state.motor_rad[0].tolist()
        zeros_rad = self._amplifiers[name].zero_rad
        turned_rad = self._turned_rad[name]
        for axis, rad_s in enumerate(velocity_rad_s):
            position_rad = motors_rad[axis] - zeros_rad[axis]
            away_rad, outward_rad_s = abs(position_rad), math.copysign(rad_s, position_rad * rad_s)
            if away_rad <= travel_rad:
                turned_rad[axis] = self._farthest_rad[name]
            elif outward_rad_s < -hardly_rad_s:
                turned_rad[axis] = max(turned_rad[axis], away_rad)
            elif outward_rad_s > hardly_rad_s and away_rad > turned_rad[axis]:
                self._violated(
                    "no siderostat is driven beyond its travel",
                    f"{name}: {rad_s:.2f} rad/s at {position_rad:.2f} rad, "
                    f"at most {turned_rad[axis]:.2f} rad",
                )

    def stands(self, name: str, loop: Loop, now_s: float) -> None:
        """A siderostat stays where it is in STANDBY, apart from jogs, and while its loop is held.

        In STANDBY it may go back to where it was held.
        """
        is_held = _is_held(loop)
        if not is_held:
            self._held_s.pop(name, None)
            if loop.mode is not Mode.STANDBY:
                self._standing_rad.pop(name, None)
                return
        line = self._lines[f"{name} siderostat"]
        since_s = self._held_s.setdefault(name, now_s) if is_held else self.jogged_s.get(name, 0.0)
        moves_s = max(since_s, loop.mode_since_s, line.healed_s, self.stall_ended_s)
        most_s = (self._slowed_s if is_held else self._moved_s)[name]
        # Motors that do not move are commanded on, until the servo notices.
        if now_s - moves_s <= most_s or line.is_bad or line.wrong:
            self._standing_rad.pop(name, None)
            return
        motor_rad = self._plant.loops[name].state.motor_rad[0].tolist()
        stood_rad = self._standing_rad.setdefault(name, motor_rad)
        moved_rad = max(map(abs, map(operator.sub, motor_rad, stood_rad)))
        count_rad = math.tau / self._rig.loops[name].siderostat.encoder_counts_per_rev
        if moved_rad > _MOST_COUNTS * count_rad:
            which = "whose loop is held" if is_held else "at rest"
            self._violated(
                f"a siderostat {which} stays where it is",
                f"{name}: {moved_rad:.4f} rad in {loop.mode.name}, {now_s - moves_s:.3f} s after it was moved",
            )

    def pose(self, pose: Pose, velocity_mm_s: float) -> None:
        """A pose is sent to the hexapod, and how fast it is to go there."""
        collector = self._rig.collector
        if collector is None:
            return
        hexapod = collector.hexapod
        if not velocity_mm_s <= hexapod.velocity_limit_mm_s * _SLACK:
            self._violated("the hexapod's velocity within its limit", f"{velocity_mm_s} mm/s")
        for axis, value, (low, high) in zip(Pose._fields, pose, hexapod.travel.ends, strict=True):
            if not low <= value <= high:
                self._violated("the hexapod's poses within its travel", f"{axis} {value}")

    def volts(self, name: str, volts: Floats, before_v: Floats) -> None:
        """Voltages are sent to a loop's mirror, whose D/A has others until they arrive."""
        fsm = self._stellar_loops[name].fsm
        wanted_v = volts.tolist()  # floats, for arrays of three take ten times as long
        full_scale_v = fsm.dac.full_scale_v
        if not all(0.0 <= volt <= full_scale_v for volt in wanted_v):
            self._violated("voltages within their limits", f"{name}: {volts} V")
        if self.supervisor is None:
            return
        loop = self.supervisor.loops[name]
        # A write may have been decided in the mode before.
        decided_here = (
            self._clock.now_s() - loop.mode_since_s >= _DECIDED_S and self._dacs_are_well()
        )
        slowly = loop.mode in _SLOWLY
        was_slow, self._slowly[name] = self._slowly.get(name, False), slowly
        if loop.mode is Mode.VERNIER and decided_here:
            self._within_range(name, self.supervisor)
        if loop.mode is Mode.EXPERIMENT and self._mirror_only_returns.get(name, False):
            moved_s = self._mirror_moved_s.get(name, -math.inf)
            if self._dacs_are_well() and self._clock.now_s() - moved_s > WELL_S:
                self._no_faster_than_slew(name, volts, before_v, PERIOD_S)
        if not (slowly and (was_slow or decided_here)):
            return
        step_v = self._no_faster_than_slew(name, volts, before_v, self._rig.camera.period_s)
        if step_v > fsm.dac.step_v:
            self._mirror_rests(name, loop, step_v)

    def _no_faster_than_slew(
        self, name: str, volts: Floats, before_v: Floats, period_s: float
    ) -> float:
        """A mirror on its way to where it rests is written to once a period; by how much it is now."""
        fsm = self._stellar_loops[name].fsm
        step_v = max(abs(v - b) for v, b in zip(volts.tolist(), before_v.tolist(), strict=True))
        most_v = fsm.slew_v_per_s * period_s * _SLACK + fsm.dac.step_v
        if not step_v <= most_v:
            self._violated(
                "the mirror rests no faster than its slew",
                f"{name}: {step_v:.3f} V in one write, at most {most_v:.3f} V",
            )
        return step_v

    def _dacs_are_well(self) -> bool:
        """No D/A has made a loop wait with its writes recently."""
        for name in self._stellar_loops:
            line = self._lines[f"{name} D/A"]
            if line.is_bad or line.wrong or self._clock.now_s() - line.healed_s < WELL_S:
                return False
        return True

    def _within_range(self, name: str, supervisor: Supervisor) -> None:
        """In VERNIER a loop commands the mirror's angles, within its range, the diamond of Eq. 2.

        In COARSE it goes to its bias by voltages, from where the model of its hysteresis has it.
        """
        az_rad, el_rad = supervisor.stellar_loops[name].mirror.command_rad.tolist()
        range_rad = self._stellar_loops[name].fsm.range_rad
        if not abs(az_rad) + abs(el_rad) <= range_rad * _SLACK:
            self._violated(
                "the mirror stays within its range",
                f"{name}: {az_rad * 1e6:.1f}, {el_rad * 1e6:.1f} urad of {range_rad * 1e6:.1f} urad",
            )

    def _mirror_rests(self, name: str, loop: Loop, step_v: float) -> None:
        """At rest a mirror moves to its bias, and again after its D/A has moved it or was silent."""
        fsm, line = self._stellar_loops[name].fsm, self._lines[f"{name} D/A"]
        moves_s = max(
            loop.mode_since_s,
            line.healed_s,
            self.stall_ended_s,
            self._mirror_moved_s.get(name, 0.0),
        )
        rested_s = self._clock.now_s() - moves_s
        if (
            loop.mode in _SLOWLY
            and not line.is_bad
            and not line.wrong
            and rested_s > fsm.dac.full_scale_v / fsm.slew_v_per_s + _MIRROR_RESTS_S
        ):
            self._violated(
                "a mirror at rest stays where it is",
                f"{name}: {step_v:.3f} V in one write after {rested_s:.2f} s in {loop.mode.name}",
            )

    def experiment_began(self, name: str, drives: list[Drive]) -> None:
        """An experiment was accepted; if it does not move a mirror, that returns to its bias."""
        self._mirror_only_returns[name] = all(drive.channel in SIDEROSTAT for drive in drives)

    def mirror_moved(self, name: str) -> None:
        """A loop's D/A has gone to its safe voltages by itself, or somebody commands another bias."""
        self._mirror_moved_s[name] = self._clock.now_s()


def _is_held(loop: Loop) -> bool:
    """An interlock, or a search's wait for another loop, keeps the stages of a loop where they are."""
    if loop.mode not in POINTING:
        return False
    if loop.interlocks.holds:
        return True
    if not (loop.mode is Mode.ACQUISITION and isinstance(loop, StellarLoop) and loop._waits):
        return False
    link = loop.star_motion.link
    return link is None or not link.holds
