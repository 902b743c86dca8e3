"""The running instrument under each entry of the catalogue."""

import pytest

from .catalogue import RUNNING
from .conftest import RESULTS
from .engine import run
from .setups import SETUPS

pytestmark = [pytest.mark.fault, pytest.mark.timeout(200)]


@pytest.mark.parametrize(
    ("rig", "entry"),
    [pytest.param(entry.rig, entry, id=entry.name) for entry in RUNNING],
    indirect=["rig"],
    scope="module",  # the rig of one name goes on from entry to entry
)
def test_it_ends_as_the_catalogue_says(rig, entry):
    RESULTS[entry.name] = run(rig, entry, SETUPS[entry.rig].home)
