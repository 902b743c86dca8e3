"""The running instrument under each entry of the catalogue."""

import pytest

from .conftest import RESULTS
from .engine import run
from .entries import testbed
from .entries.catalogue import INSTRUMENTS
from .setups import SETUPS

pytestmark = [pytest.mark.fault, pytest.mark.timeout(200)]


@pytest.mark.parametrize(
    ("rig", "entry"),
    [
        # One worker has them all, one after the other: another has another instrument meanwhile.
        pytest.param(
            instrument,
            entry,
            id=entry.name,
            marks=[
                pytest.mark.xdist_group(", ".join(instrument)),
                *([pytest.mark.testbed] if entry in testbed.ENTRIES else []),
            ],
        )
        for instrument, entries in INSTRUMENTS.items()
        for entry in entries
    ],
    indirect=["rig"],
    scope="module",  # the instrument goes on from entry to entry
)
def test_it_ends_as_the_catalogue_says(rig, entry):
    RESULTS[entry.name] = run(rig, entry, SETUPS[entry.rig].home)
