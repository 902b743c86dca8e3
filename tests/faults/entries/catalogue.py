"""All entries, by the tables of docs/fault-catalogue.md."""

from . import commands, devices, processes, surroundings, testbed

GROUPS = {
    "devices": devices.ENTRIES,
    "testbed": testbed.ENTRIES,
    "commands": commands.ENTRIES,
    "processes": processes.ENTRIES,
    "surroundings": surroundings.ENTRIES,
}


def by_instrument():
    """What is struck on one instrument, started once: the entries of a table that have the same rig."""
    instruments = {}
    for table, entries in GROUPS.items():
        for entry in entries:
            instruments.setdefault((entry.rig, table), []).append(entry)
    return instruments


INSTRUMENTS = by_instrument()
