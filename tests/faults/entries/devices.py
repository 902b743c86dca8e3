"""Every fault of every device, by wire and by its own; the links are cut, delayed and corrupted here."""

from .entry import SEARCHES, STAYED, Entry

HELD = (STAYED,)
SAFE = ("SAFE",)
SIDEROSTAT, DAC, PIEZO, CAMERA = "siderostat", "D/A at", "piezo amplifier at", "camera at"
GOES_ON = "its last velocity goes on: its protocol has no watchdog"


def held(*hows, within_s=2.0, **fields):
    """The star is held all the same."""
    return [Entry("", how, HELD, within_s=within_s, **fields) for how in hows]


def made_safe(*hows, within_s=3.0, **fields):
    """The device's error is told, and the stages are made safe."""
    return [Entry("", how, SAFE, within_s=within_s, **fields) for how in hows]


def amplifier_faults(unheard_moves=""):
    """Of whatever amplifiers; `unheard_moves` is why motors go on without their link, if they do."""
    return (
        *made_safe("drop", "disconnect", "freeze", says=SIDEROSTAT, moves=unheard_moves),
        *made_safe("delay 0.1", "corrupt", "reboot", says=SIDEROSTAT),
        *made_safe("amplifier_fault", "encoder_jump", says=SIDEROSTAT),
        # Nothing is asked of a siderostat that the mirror saves from moving; a search asks much.
        *held("stuck_axis"),
        *made_safe("stuck_axis", says=SIDEROSTAT, mode="ACQUISITION"),
    )


CAMERA_FAULTS = (
    *made_safe("drop", "corrupt", "disconnect", "freeze", "reboot", says=CAMERA),
    *made_safe("frame_drop", "packet_loss", "mtu", says=CAMERA),
    *held("delay 0.1", says="frame_age"),
    *held("duplicate", "reorder", "hot_pixel"),
)
STAR_FAULTS = (
    *held("star_dim 0.7", says="flux_low", within_s=3.0),
    Entry("", "star_fading", SEARCHES, "no star on", within_s=6.0),
    Entry("", "star_fading 0.001", SEARCHES, "no star on"),
    Entry("", "star_dim 0.3", SEARCHES, "no star on"),
    *held("star_jump 2", "star_double"),
    # Farther than a star that is followed may be from where it is expected: it is lost, and found again.
    Entry("", "star_jump 12", SEARCHES, "no star on"),
    # What lies above the bias is light: a spot of far more than flux_range.high is no star.
    Entry("", "background_jump", SEARCHES, "no star on"),
    # Without its brightest pixels the spot has two thirds of its light, which is above flux_range.low.
    *held("saturation", says="flux_low", within_s=3.0),
)
# Longer away than a first search would last: the rounds go on.
STAR_AWAY = Entry(
    "camera", "star_dim 0.3", SEARCHES, "the search repeats", within_s=25.0, rig="short pauses"
)
DAC_FAULTS = (
    *made_safe("drop", "corrupt", "disconnect", "freeze", "reboot", "watchdog_trip", says=DAC),
    # An answer that could be overtaken comes 0.1 s late instead, for nothing is asked before it is there.
    *held("delay 0.1", says="dac_slow"),
    *held("duplicate"),
    *held("reorder", says="dac_slow"),
)
MDT693_FAULTS = (
    # It is asked once a second, and believed to be wrong the second time.
    *made_safe("drop", "corrupt", "duplicate", "freeze", "silent", says=PIEZO, within_s=8.0),
    *made_safe("disconnect", says=PIEZO, within_s=8.0),
    *made_safe(
        "limit_switch", says=PIEZO, within_s=8.0, moves="it gives no more than the switch allows"
    ),
    *made_safe(
        "saturated_stack", says=PIEZO, within_s=8.0, moves="the stack goes to its highest voltage"
    ),
    *held("delay 0.1", "reorder"),  # as with the D/A; but no tick waits for it
    # It is back after 2 s, before it is asked a second time.
    *held(
        "reboot",
        says="asking again",
        within_s=4.0,
        moves="without power the stacks have no voltage",
    ),
)
CIA402_FAULTS = (
    *amplifier_faults(),
    *made_safe("link_loss", "following_error", says=SIDEROSTAT),
    *held("duplicate", "reorder"),
)
ENSEMBLE_FAULTS = (
    *amplifier_faults(unheard_moves=GOES_ON),
    # Each answer belongs to the question before it.
    *made_safe("following_error", "duplicate", "reorder", says=SIDEROSTAT),
)
BAL_FAULTS = (
    *amplifier_faults(),
    *held("duplicate", "reorder", "command_offset"),
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

ENTRIES = (
    *(entry._replace(struck=device, rig=rig) for rig, device, table in STRUCK for entry in table),
    STAR_AWAY,
)
