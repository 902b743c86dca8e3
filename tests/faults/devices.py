"""Every fault of every device, by wire and by its own; the links are cut, delayed and corrupted here."""

from .entry import STAYED, Entry

SAFE = ("SAFE",)
HELD = (STAYED,)
LOST = ("ACQUISITION", "COARSE", "SAFE")
EITHER = (STAYED, "COARSE", "ACQUISITION", "SAFE")  # it depends on when it strikes
SIDEROSTAT, DAC, PIEZO, CAMERA = "siderostat", "D/A at", "piezo amplifier at", "camera at"
OWN = "the stacks lose their voltage with their amplifier"

# How, what becomes of it, what is said, and within how many seconds.
CAMERA_FAULTS = (
    ("drop", SAFE, CAMERA, 3.0),
    ("delay 0.1", HELD, "frame_age", 2.0),
    ("corrupt", SAFE, CAMERA, 3.0),
    ("duplicate", HELD, "", 2.0),
    ("reorder", HELD, "", 2.0),
    ("disconnect", SAFE, CAMERA, 3.0),
    ("freeze", SAFE, CAMERA, 3.0),
    ("reboot", SAFE, CAMERA, 3.0),
    ("frame_drop", SAFE, CAMERA, 3.0),
    ("packet_loss", SAFE, CAMERA, 3.0),
    ("mtu", SAFE, CAMERA, 3.0),
    ("hot_pixel", HELD, "", 2.0),
)
STAR_FAULTS = (
    ("star_dim 0.7", HELD, "flux_low", 3.0),
    ("star_fading", LOST, "no star on", 6.0),
    ("star_fading 0.001", LOST, "no star on", 2.0),
    ("star_jump 2", HELD, "", 2.0),
    ("star_jump 12", LOST, "of the mirror's range", 2.0),
    ("star_double", HELD, "", 2.0),
    ("background_jump", EITHER, "", 2.0),
    ("saturation", EITHER, "", 2.0),
)
CIA402_FAULTS = (
    ("drop", SAFE, SIDEROSTAT, 3.0),
    ("delay 0.1", SAFE, SIDEROSTAT, 3.0),
    ("corrupt", SAFE, SIDEROSTAT, 3.0),
    ("duplicate", HELD, "", 2.0),
    ("reorder", HELD, "", 2.0),
    ("disconnect", SAFE, SIDEROSTAT, 3.0),
    ("freeze", SAFE, SIDEROSTAT, 3.0),
    ("reboot", SAFE, SIDEROSTAT, 3.0),
    ("link_loss", SAFE, SIDEROSTAT, 3.0),
    ("amplifier_fault", SAFE, SIDEROSTAT, 3.0),
    ("following_error", SAFE, SIDEROSTAT, 3.0),
    ("encoder_jump", SAFE, SIDEROSTAT, 3.0),
    ("stuck_axis", EITHER, "", 2.0),
)
DAC_FAULTS = (
    ("drop", SAFE, DAC, 3.0),
    ("delay 0.1", EITHER, "", 2.0),
    ("corrupt", SAFE, DAC, 3.0),
    ("duplicate", HELD, "", 2.0),
    ("reorder", EITHER, "", 2.0),
    ("disconnect", SAFE, DAC, 3.0),
    ("freeze", SAFE, DAC, 3.0),
    ("reboot", SAFE, DAC, 3.0),
    ("watchdog_trip", SAFE, DAC, 3.0),
)
MDT693_FAULTS = (
    ("drop", SAFE, PIEZO, 8.0),
    ("delay 0.1", HELD, "", 2.0),
    ("corrupt", EITHER, "", 2.0),
    ("duplicate", EITHER, "", 2.0),
    ("reorder", EITHER, "", 2.0),
    ("disconnect", SAFE, PIEZO, 8.0),
    ("freeze", SAFE, PIEZO, 8.0),
    ("reboot", EITHER, "", 2.0),
    ("silent", SAFE, PIEZO, 8.0),
    ("limit_switch", SAFE, PIEZO, 8.0),
    ("saturated_stack", SAFE, PIEZO, 8.0),
)
ENSEMBLE_FAULTS = (
    *((how, SAFE, SIDEROSTAT, 3.0) for how in ("drop", "delay 0.1", "corrupt", "duplicate")),
    *((how, SAFE, SIDEROSTAT, 3.0) for how in ("reorder", "disconnect", "freeze", "reboot")),
    ("amplifier_fault", SAFE, SIDEROSTAT, 3.0),
    ("following_error", SAFE, SIDEROSTAT, 3.0),
    ("encoder_jump", SAFE, SIDEROSTAT, 3.0),
    ("stuck_axis", EITHER, "", 2.0),
)
BAL_FAULTS = (
    *((how, SAFE, SIDEROSTAT, 3.0) for how in ("drop", "delay 0.1", "corrupt")),
    ("duplicate", HELD, "", 2.0),
    ("reorder", HELD, "", 2.0),
    *((how, SAFE, SIDEROSTAT, 3.0) for how in ("disconnect", "freeze", "reboot")),
    ("amplifier_fault", SAFE, SIDEROSTAT, 3.0),
    ("encoder_jump", SAFE, SIDEROSTAT, 3.0),
    ("stuck_axis", EITHER, "", 2.0),
    ("command_offset", HELD, "", 2.0),
)
# Rig, device of the mocks, its table.
STRUCK = (
    ("fit-mock", "camera", CAMERA_FAULTS + STAR_FAULTS),
    ("fit-mock", "right.drive", CIA402_FAULTS),
    ("fit-mock", "right.dac", DAC_FAULTS),
    ("fit-mock", "right.mdt693", MDT693_FAULTS),
    ("ensemble", "right.drive", ENSEMBLE_FAULTS),
    ("fit-bal-analog", "right.drive", BAL_FAULTS),
)
# What moves although nobody asks it to.
BY_ITSELF = {
    ("fit-mock", "right.mdt693", "reboot"): OWN,
    ("fit-mock", "right.mdt693", "saturated_stack"): "the stack goes to its highest voltage",
    (
        "fit-mock",
        "right.mdt693",
        "limit_switch",
    ): "the amplifier gives no more than the switch allows",
} | {
    ("ensemble", "right.drive", how): "its last velocity goes on: its protocol has no watchdog"
    for how in ("drop", "disconnect", "freeze")
}

ENTRIES = tuple(
    Entry(device, how, ends, says, within_s=within_s, rig=rig,
          moves=BY_ITSELF.get((rig, device, how), ""))
    for rig, device, table in STRUCK
    for how, ends, says, within_s in table
)  # fmt: skip
