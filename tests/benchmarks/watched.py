"""Invariants of the swarm over stand-ins of a supervisor and its devices."""

from random import Random
from types import SimpleNamespace

import numpy as np

from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.invariants import Invariants
from benchmarks.swarm.lines import Line
from benchmarks.swarm.rigs import devices_of
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import load_rig
from fitctl.messages.modes import Mode
from fitctl.model.plant import Plant

TESTBED = "fit-testbed.toml"
TICK_S = 0.1


def named(device):
    """As a device's errors name it."""
    kind = device.rpartition(" ")[2]
    return "piezo amplifier" if kind == "piezo" else kind


class Rig:
    """Invariants over stand-ins of a supervisor, of amplifiers and of lines that are all connected."""

    def __init__(self, rig="fit-mock.toml", mode=Mode.VERNIER):
        self.rig = load_rig(FOLDER / rig)
        self.time = VirtualTime()
        self.lines = {
            name: Line(named(name), "", self.time, Random(1), 0.001, 0.1)
            for name in devices_of(rig)
        }
        for line in self.lines.values():
            line.connected = True
        self.amplifiers = {
            name: SimpleNamespace(
                zero_rad=(0.0, 0.0),
                powered=mode not in {Mode.OFF, Mode.SAFE},
                watches_nobody=False,
                fault="",
                velocity_rad_s=(0.0, 0.0),
                master_timeout_s=0.5,
                line=self.lines[f"{name} siderostat"],
            )
            for name in self.rig.loops
        }
        self.plant = Plant(self.rig, [1], history_s=20.0)
        self.jobs = SimpleNamespace(busy=False)
        self.servo = SimpleNamespace(_wanted_rad=(0.0, 0.0), position_rad=(0.0, 0.0))
        self.loops = {
            name: SimpleNamespace(
                mode=mode,
                mode_since_s=0.0,
                servo=self.servo,
                mirror=SimpleNamespace(command_rad=np.zeros(2)),
                interlocks=SimpleNamespace(holds=False),
            )
            for name in self.rig.loops
        }
        self.invariants = Invariants(self.rig, self.time, self.amplifiers, self.lines, self.plant)
        self.supervisor = SimpleNamespace(
            loops=self.loops,
            stellar_loops=self.loops,
            _device_jobs=self.jobs,
            piezos={},
            sequences=SimpleNamespace(),
        )
        self.invariants.watch(self.supervisor)

    def go_on(self, seconds):
        """Tick for a while; return what was violated until now."""
        for _ in range(round(seconds / TICK_S)):
            self.time.run_until(self.time.now_s() + TICK_S)
            self.invariants._ticks.update(list(self.loops))  # each has recorded one
            self.invariants.tick()
        return [one.invariant for one in self.invariants.violations]
