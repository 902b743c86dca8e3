"""Fixtures of an instrument on the virtual clock, which the tests of several rooms share."""

import pytest
from instruments.simulated import NEAR, SOON, until
from samples.replay_courses import hold_a_star

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.modes import Mode
from fitctl.simulation.simulation import Simulation
from tests.samples.logged_simulation import LoggedSimulation


@pytest.fixture
def simulate_with():
    """Make a simulation of the default rig with some values replaced; its `records` are all that it made."""

    def make(*overrides, seed=0, **options):
        records = []
        rig = load_rig(default_rig_path(), overrides)
        simulation = Simulation(rig, seed, record=records.append, **options)
        simulation.records = records
        return simulation

    return make


@pytest.fixture
def vernier(simulate_with):
    """An instrument that holds its star."""
    simulation = simulate_with(**NEAR)
    simulation.acquire()
    return until(simulation, Mode.VERNIER)


@pytest.fixture
def logged(tmp_path):
    """The log of what `course` does with a simulation, and the simulation."""

    def make(course, *overrides, rig=None, **options):
        rig = rig or load_rig(default_rig_path(), [SOON, *overrides])
        path = tmp_path / "run.mcap"
        simulation = LoggedSimulation(rig, path, **options)
        course(simulation)
        simulation.writer.close()
        return path, simulation

    return make


@pytest.fixture
def held_log(logged):
    """The log of a star that is held, and since when."""

    def make(**options):
        path, simulation = logged(hold_a_star, **options)
        (since_s,) = (c.time_s for c in simulation.mode_changes if c.target == "VERNIER")
        return path, since_s

    return make
