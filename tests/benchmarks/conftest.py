"""The swarm's clock, and invariants over one star."""

from random import Random

import pytest

from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.invariants import Invariants
from benchmarks.swarm.lines import Line
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import load_rig
from fitctl.model.plant import Plant


@pytest.fixture
def time():
    time = VirtualTime()
    yield time
    time.end()


@pytest.fixture
def plant():
    return Plant(load_rig(FOLDER / "fit-mock.toml"), [1], history_s=20.0)


@pytest.fixture
def invariants(time, plant):
    lines = {"camera": Line("camera", "", time, Random(1), 0.001, 0.1)}
    return Invariants(load_rig(FOLDER / "fit-mock.toml"), time, {}, lines, plant)
