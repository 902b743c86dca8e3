"""docs/fault-catalogue.md lists exactly what is in the catalogue."""

import re

import pytest
from documents import between

from fitctl.commands.shared.fault_kinds import kinds

from .entries import devices, testbed
from .entries.catalogue import GROUPS
from .entries.configuration import WRONG
from .report import MEASURED, promised, wrong_table

# Which device each table of kinds is for.
DEVICES = {
    "camera": ("fit-mock", "camera"),
    "drive": ("fit-mock", "right.drive"),
    "drive (ensemble)": ("ensemble", "right.drive"),
    "drive (bal_analog)": ("fit-bal-analog", "right.drive"),
    "dac": ("fit-mock", "right.dac"),
    "mdt693": ("fit-mock", "right.mdt693"),
    "labjack": ("fit-testbed", "metrology.labjack"),
    "hexapod": ("fit-testbed", "hexapod"),
}


@pytest.mark.parametrize("name", GROUPS)
def test_the_committed_table_has_every_entry_and_what_a_run_has_found(name):
    lines = between("fault-catalogue.md", name).splitlines()[2:]
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]

    assert [row[:-MEASURED] for row in cells] == [promised(entry) for entry in GROUPS[name]]
    assert all(
        re.fullmatch(r"no result|(stayed|SAFE|\d+\.\d\d s)(, try \d)?", row[-MEASURED])
        for row in cells
    )


def test_the_committed_table_has_every_wrong_configuration():
    assert between("fault-catalogue.md", "wrong-configuration") == wrong_table()
    assert len(WRONG) >= 30


def test_no_two_entries_have_the_same_name():
    names = [entry.name for entries in GROUPS.values() for entry in entries]
    assert len(set(names)) == len(names) >= 60


# What goes unnoticed while the beam is held, and so is no row: a reading that stays.
NO_ROW = {("labjack", "stuck_input")}


def test_every_fault_of_every_mock_is_in_the_catalogue():
    struck = {
        (entry.rig, entry.struck, entry.how.split()[0])
        for entry in devices.ENTRIES + testbed.ENTRIES
    }
    faults = {
        (*DEVICES[name], kind)
        for name, table in kinds().items()
        for kind in table
        if (name, kind) not in NO_ROW and kind != "dark_half"
    }
    assert faults <= struck
    assert ("fit-testbed", "camera", "dark_half") in struck
