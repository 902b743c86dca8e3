"""The instrument on the virtual clock, for statements about what the supervisor does."""

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.supervisor.simulate import Simulation


@pytest.fixture
def simulate_with():
    """Make a simulation of the default rig with some values replaced."""

    def make(*overrides, seed=0, **kwargs):
        return Simulation(load_rig(default_rig_path(), overrides), seed, **kwargs)

    return make
