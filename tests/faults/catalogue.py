"""All entries."""

from . import devices, processes
from .setups import SETUPS

# One rig after the other, for each is started once.
RUNNING = sorted(
    (*devices.ENTRIES, *processes.ENTRIES), key=lambda entry: list(SETUPS).index(entry.rig)
)
