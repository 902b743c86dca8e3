"""The whole testbed: what each fault does to the loop that it concerns, and what the other loops do."""

from .devices import CAMERA, DAC, PIEZO, SIDEROSTAT
from .entry import HOLDS, SEARCHES, STAYED, WAITS, Entry

RIG, ONE_BUS_RIG = "fit-testbed", "one bus"
LABJACK, HEXAPOD = "LabJack T7 at", "hexapod at"
HELD, SAFE = (STAYED,), ("SAFE",)
LINK_LOST = "waits for the link of metrology"
# What the other loops do when a loop is struck; the right one goes on whatever becomes of the link.
LINK_HELD = (("right", HOLDS), ("left", HOLDS))
LINK_FREED = (("right", HOLDS), ("left", STAYED))  # an axis that comes free jumps to its set-point
LINK_AWAY = (("right", HOLDS), ("left", WAITS))
LEFT_AWAY = (("right", HOLDS), ("metrology", STAYED))
RIGHT_AWAY = (("left", HOLDS), ("metrology", STAYED))


def metrology(struck, *hows, ends=SAFE, says="", others=LINK_AWAY, within_s=3.0, mode="LOCKED"):
    """The link is struck."""
    return tuple(
        Entry(struck, how, ends, says, mode, within_s, "", RIG, "metrology", others) for how in hows
    )


def left(struck, *hows, ends=SAFE, says="", others=LEFT_AWAY, within_s=3.0, moves=""):
    """The left star, its mirror or its siderostat is struck."""
    return tuple(
        Entry(struck, how, ends, says, "VERNIER", within_s, moves, RIG, "left", others)
        for how in hows
    )


def right(struck, *hows, ends=SAFE, says="", others=RIGHT_AWAY, within_s=3.0):
    """The right star or its stages are struck."""
    return tuple(
        Entry(struck, how, ends, says, "VERNIER", within_s, "", RIG, "right", others)
        for how in hows
    )


def hexapod(*hows, says=HEXAPOD, within_s=4.0):
    """The hexapod is struck while it moves the collector: the course ends, and all loops go on."""
    return metrology("hexapod", *hows, ends=HELD, says=says, others=LINK_HELD, within_s=within_s)


LABJACK_FAULTS = (
    *metrology(
        "metrology.labjack",
        "drop", "corrupt", "disconnect", "freeze", "reboot", "exception", "not_a_number AIN0",
        "wrong_value AIN2", "range_changed",
        says=LABJACK,
    ),
    *metrology(
        "metrology.labjack", "delay 0.1", "duplicate", "reorder",
        ends=HELD, others=LINK_HELD, within_s=2.0,
    ),
    *metrology("metrology.labjack", "laser_dim 0.3", ends=HELD, says="beam_light_fraction", others=LINK_HELD),
    *metrology("metrology.labjack", "laser_dim 0 for 5 s", ends=SEARCHES, says=LINK_LOST),
    *metrology("metrology.labjack", "unplugged AIN1", ends=("COARSE",), says=LINK_LOST),
    *metrology(
        "metrology.labjack", "swapped az",
        ends=("COARSE", "ACQUISITION", "SAFE"), says=LINK_LOST, within_s=6.0,
    ),
    *metrology("metrology.labjack", "offset_drift AIN0", "noise AIN0", ends=HELD, others=LINK_HELD),
)  # fmt: skip
HEXAPOD_FAULTS = hexapod(
    "drop", "corrupt", "disconnect", "freeze", "silent", "reboot", "moves_stopped", "servo_off",
    "motion_error", "stuck", "wrong_axis", "position_offset", "false_error", "reference_lost",
    "emergency_stop",
) + metrology("hexapod", "delay 0.1", "duplicate", "reorder", ends=HELD, others=LINK_HELD)  # fmt: skip
COLLECTOR = metrology(
    "hexapod", "all loops are stopped", says="the collector was stopped where it is",
    others=(("right", "SAFE"), ("left", "SAFE")),
)  # fmt: skip
LINK_DRIVE = metrology(
    "metrology.drive",
    "drop", "disconnect", "freeze", "reboot", "amplifier_fault", "encoder_jump", "link_loss", "following_error",
    says=SIDEROSTAT,
) + metrology("metrology.drive", "stuck_axis", ends=HELD, others=LINK_FREED)  # fmt: skip
LEFT_STAGES = (
    *left(
        "left.drive",
        "drop", "disconnect", "freeze", "reboot", "amplifier_fault", "encoder_jump", "link_loss",
        "following_error",
        says=SIDEROSTAT,
    ),
    *left("left.drive", "stuck_axis", ends=HELD),
    *left("left.dac", "drop", "disconnect", "freeze", "reboot", "watchdog_trip", says=DAC),
    *left("left.mdt693", "silent", "disconnect", says=PIEZO, within_s=8.0),
    *left(
        "left.mdt693", "limit_switch", says=PIEZO, within_s=8.0,
        moves="it gives no more than the switch allows",
    ),
)  # fmt: skip
STARS = (
    *left(
        "camera",
        "dark_half left",
        ends=SEARCHES,
        says="no star on",
        within_s=2.0,
        others=LEFT_AWAY,
    ),
    *right(
        "camera",
        "dark_half right",
        ends=SEARCHES,
        says="no star on",
        within_s=2.0,
    ),
    *right("camera", "drop", says=CAMERA, others=(("left", "SAFE"), ("metrology", STAYED))),
    *right("right.drive", "amplifier_fault", says=SIDEROSTAT),
)
# All three drives are on one CAN adapter: what strikes one of them concerns its own loop, the adapter all.
ONE_BUS = tuple(
    entry._replace(rig=ONE_BUS_RIG)
    for entry in (
        *left("left.drive", "reboot", "link_loss", "amplifier_fault", says=SIDEROSTAT),
        *right(
            "right.adapter", "disconnect",
            says=SIDEROSTAT, others=(("left", "SAFE"), ("metrology", "SAFE")),
        ),
    )
)  # fmt: skip
OPERATOR = (
    *left("loop left", "turned off by the operator", ends=("OFF",)),
    *metrology("loop metrology", "turned off by the operator", ends=("OFF",), says=LINK_LOST),
    *right("loop right", "turned off by the operator", ends=("OFF",)),
)
ENTRIES = (
    LABJACK_FAULTS
    + HEXAPOD_FAULTS
    + COLLECTOR
    + LINK_DRIVE
    + LEFT_STAGES
    + STARS
    + OPERATOR
    + ONE_BUS
)
