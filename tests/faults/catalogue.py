"""All entries."""

from . import commands, devices, processes, surroundings
from .setups import SETUPS

# One rig after the other, for each is started once.
RUNNING = sorted(
    (*devices.ENTRIES, *commands.ENTRIES, *processes.ENTRIES, *surroundings.ENTRIES),
    key=lambda entry: list(SETUPS).index(entry.rig),
)
