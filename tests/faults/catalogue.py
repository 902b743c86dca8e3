"""All entries, by the tables of docs/reliability.md."""

from . import commands, devices, processes, surroundings
from .setups import SETUPS

GROUPS = {
    "devices": devices.ENTRIES,
    "commands": commands.ENTRIES,
    "processes": processes.ENTRIES,
    "surroundings": surroundings.ENTRIES,
}
# One rig after the other, for each is started once.
RUNNING = sorted(
    (entry for entries in GROUPS.values() for entry in entries),
    key=lambda entry: list(SETUPS).index(entry.rig),
)
