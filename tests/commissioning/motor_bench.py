"""Amplifiers of two motors on a virtual clock, wired as a test says."""

from pathlib import Path

import numpy as np

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import Site, StepError
from fitctl.commissioning.steps import motors
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import ServoReading

RIG = load_rig(default_rig_path())


class BenchAmplifiers:
    """Two motors: what they are commanded goes through `gains`, what they turned is counted through `counts`.

    `gains` and `counts` are matrices; `runs_away_rad_s` is a velocity that nobody commanded;
    `ends_rad` is how far both motors can turn.
    """

    def __init__(
        self,
        clock,
        gains=((1, 0), (0, 1)),
        counts=((1, 0), (0, 1)),
        runs_away_rad_s=0.0,
        ends_rad=(-1e9, 1e9),
    ):
        self.clock = clock
        self.gains, self.counts = np.array(gains, float), np.array(counts, float)
        self.runs_away = np.array([runs_away_rad_s, 0.0])
        self.ends_rad = ends_rad
        self.motor_rad = np.zeros(2)
        self.fastest_rad_s = 0.0
        self.furthest_rad = 0.0
        self.powered = False
        self.fault = ""
        self._velocity = np.zeros(2)
        self._at_s = clock.now_s()

    def open(self):
        pass

    def enable(self):
        self.powered = True
        self._at_s = self.clock.now_s()

    def disable(self):
        self._advance()
        self.powered = False

    def close(self):
        self.disable()

    def exchange(self, velocity_rad_s):
        self._advance()
        self._velocity = self.gains @ velocity_rad_s
        self.fastest_rad_s = max(self.fastest_rad_s, *np.abs(velocity_rad_s))
        counted = self.counts @ self.motor_rad
        return ServoReading(self._at_s, tuple(counted), self.powered, self.fault)

    def _advance(self):
        now_s = self.clock.now_s()
        if self.powered:
            self.motor_rad = self.motor_rad + (self._velocity + self.runs_away) * (
                now_s - self._at_s
            )
            self.motor_rad = np.clip(self.motor_rad, *self.ends_rad)
            self.furthest_rad = max(self.furthest_rad, *np.abs(self.motor_rad))
        self._at_s = now_s


def rig_with_limit(velocity_rad_s):
    """The rig with slower motors."""
    limit = f"loops.right.siderostat.velocity_limit_rad_s={velocity_rad_s}"
    return load_rig(default_rig_path(), [limit])


def site_of(rig=RIG, clock=None, name="right"):
    return Site(rig, name, lambda _line: None, Path("rig.toml"), (), clock=clock or VirtualClock())


def step_on_bench(monkeypatch, check):
    """Runs a step on amplifiers wired as told: gives the bench, the outcome, and why the step stopped."""

    def run(rig=RIG, **wiring):
        clock = VirtualClock()
        bench = BenchAmplifiers(clock, **wiring)
        monkeypatch.setattr(motors, "amplifiers_of", lambda _siderostat: bench)
        try:
            return bench, check(site_of(rig, clock)), ""
        except StepError as error:
            return bench, None, str(error)

    return run
