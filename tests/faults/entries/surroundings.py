"""What is about the instrument: its disk, its clock, its consoles, and how it is ended."""

from .entry import STAYED, Entry
from .processes import MODES, rig_for

STAYS = (STAYED,)

ENTRIES = (
    *(
        Entry("console", how, STAYS, mode=mode, rig=rig_for(mode))
        for mode in MODES
        for how in ("stopped", "slowed", "killed")
    ),
    Entry("console", "not read by its terminal", STAYS),
    Entry("console", "flooded with events", ("SAFE",), mode="SAFE", rig="fast telemetry"),
    Entry("console", "sent 100 messages a second", STAYS, rig="fast telemetry"),
    Entry("recorder", "stuck", STAYS, "recorder_backlog_fraction", within_s=8.0, rig="small disk"),
    Entry(
        "disk", "full", STAYS, "cannot be written: No space left on device; make room",
        within_s=8.0, rig="small disk",
    ),
    Entry(
        "log folder", "read-only", STAYS, "Read-only file system", within_s=12.0, rig="small disk"
    ),
    Entry(
        "supervisor", "told to end while its recorder is stopped", ("OFF",),
        "did not end within 5 s and was killed; it did not confirm the last", within_s=5.0
    ),
    Entry(
        "room on the disk", "is not told", STAYS, "has not reported its free space for 5 s",
        within_s=8.0, rig="silent disk",
    ),
    Entry("clock", "3600", STAYS, "clock_step_s 3600 is above", within_s=4.0, rig="own clock"),
    Entry("clock", "-3600", STAYS, "clock_step_s -3600 is below", within_s=4.0, rig="own clock"),
)  # fmt: skip
