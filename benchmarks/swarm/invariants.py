"""What must be true at every moment, whatever happens: evaluated at each tick and at each thing sent."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.swarm.devices import SwarmAmplifiers
from fitctl.clock import Clock
from fitctl.config import Rig
from fitctl.drivers.interface import AzEl
from fitctl.messages.modes import Mode
from fitctl.supervisor.supervisor import Supervisor

Floats = NDArray[np.float64]
_SLACK = 1.0 + 1e-6
POWER_S = 1.0  # a loop may have power without need, or need without power, no longer than this
_AT_REST = frozenset({Mode.OFF, Mode.SAFE})
_SLOWLY = frozenset({Mode.OFF, Mode.SAFE, Mode.STANDBY})
_MOST_STEP_S = 2.0
_MOST_BUSY_S = 60.0
_MOST_VIOLATIONS = 20


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
    """

    def __init__(self, rig: Rig, clock: Clock, amplifiers: Mapping[str, SwarmAmplifiers]) -> None:
        self.violations: list[Violation] = []
        self._rig = rig
        self._clock = clock
        self._amplifiers = amplifiers
        self._supervisor: Supervisor | None = None
        self._resting_since_s = dict.fromkeys(rig.loops, 0.0)
        self._last_v: dict[str, tuple[Floats, bool]] = {}
        self._powerless_since_s: dict[str, float] = {}
        self._unneeded_since_s: dict[str, float] = {}
        self._busy_since_s = math.inf
        self._stepped_s = 0.0

    def watch(self, supervisor: Supervisor) -> None:
        """Watch this one from now on."""
        self._supervisor = supervisor
        self._last_v.clear()
        self._powerless_since_s.clear()
        self._busy_since_s = math.inf
        self._stepped_s = self._clock.now_s()

    def violated(self, invariant: str, detail: str) -> None:
        """Note a violation; the first of each invariant says enough."""
        known = any(one.invariant == invariant for one in self.violations)
        if not known and len(self.violations) < _MOST_VIOLATIONS:
            self.violations.append(Violation(invariant, self._clock.now_s(), detail))

    # ------------------------------------------------------------ what is sent

    def velocity(self, name: str, velocity_rad_s: AzEl) -> None:
        """A velocity is sent to a loop's motors."""
        siderostat = self._rig.loops[name].siderostat
        fastest_rad_s = max(abs(velocity_rad_s[0]), abs(velocity_rad_s[1]))
        if not fastest_rad_s <= siderostat.velocity_limit_rad_s * _SLACK:
            self.violated("velocity within its limit", f"{name}: {velocity_rad_s} rad/s")
        supervisor = self._supervisor
        if supervisor is None or fastest_rad_s == 0.0:
            return
        loop = supervisor.loops[name]
        if loop.mode in _AT_REST:
            at_rest_s = self._clock.now_s() - loop.mode_since_s
            if at_rest_s > 3 / siderostat.servo.rate_hz:
                self.violated(
                    "no stage moves in OFF or SAFE",
                    f"{name}: {velocity_rad_s} rad/s after {at_rest_s:.3f} s in {loop.mode.name}",
                )

    def volts(self, name: str, volts: Floats) -> None:
        """Voltages are sent to a loop's mirror."""
        fsm = self._rig.stellar_loops[name].fsm
        if not (np.all(volts >= 0.0) and np.all(volts <= fsm.dac.full_scale_v)):
            self.violated("voltages within their limits", f"{name}: {volts} V")
        if self._supervisor is None:
            return
        slowly = self._supervisor.loops[name].mode in _SLOWLY
        before_v, was_slow = self._last_v.get(name, (volts, False))
        self._last_v[name] = (volts.copy(), slowly)
        step_v = float(np.abs(volts - before_v).max())
        most_v = fsm.slew_v_per_s * self._rig.camera.period_s * _SLACK
        if slowly and was_slow and step_v > most_v:
            self.violated(
                "the mirror rests no faster than its slew",
                f"{name}: {step_v:.2f} V in one write, at most {most_v:.2f} V",
            )

    def opened(self, name: str) -> None:
        """A loop's D/A was opened anew: the mirror starts from what is found there."""
        self._last_v.pop(name, None)

    # ------------------------------------------------------------ once a tick

    def tick(self) -> None:
        """What must be true after a step."""
        supervisor = self._supervisor
        if supervisor is None:
            return
        now_s = self._clock.now_s()
        took_s, self._stepped_s = now_s - self._stepped_s, now_s
        if took_s > _MOST_STEP_S:
            self.violated("a step ends", f"one took {took_s:.2f} s")
        jobs = supervisor._device_jobs
        self._busy_since_s = min(self._busy_since_s, now_s) if jobs.busy else math.inf
        if now_s - self._busy_since_s > _MOST_BUSY_S:
            self.violated("opening and closing end", f"busy for {_MOST_BUSY_S:g} s")
        for name, loop in supervisor.loops.items():
            self._power(name, loop.mode, busy=jobs.busy, now_s=now_s)

    def _power(self, name: str, mode: Mode, *, busy: bool, now_s: float) -> None:
        """Whether the amplifiers have power where they need it, and none where nobody does."""
        amplifiers = self._amplifiers[name]
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
