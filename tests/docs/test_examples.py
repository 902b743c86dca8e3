"""Examples of docstrings, run as they stand, on a log of the simulation."""

import doctest
import importlib

import pytest

from fitctl.config import default_rig_path, load_rig
from tests.samples.logged_simulation import LoggedSimulation

# Each has at least so many examples.
MODULES = {
    "fitctl.sequences.instrument": 4,
    "fitctl.simulation.simulation": 1,
    "fitctl.controllers.pair": 1,
    "fitctl.drivers.interface": 1,
    "fitctl.logging.reading": 2,
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A folder with the log that examples name."""
    folder = tmp_path_factory.mktemp("examples")
    simulation = LoggedSimulation(load_rig(default_rig_path()), folder / "night.mcap")
    simulation.acquire()
    simulation.run(25.0)
    simulation.writer.close()
    return folder


@pytest.mark.long
@pytest.mark.parametrize("name", MODULES)
def test_the_examples_of_a_module_do_what_they_show(name, folder, monkeypatch):
    monkeypatch.chdir(folder)

    failed, tried = doctest.testmod(importlib.import_module(name))

    assert failed == 0
    assert tried >= MODULES[name]
