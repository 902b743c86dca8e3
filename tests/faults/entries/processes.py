"""Each process killed, stopped and slowed, in each mode, and started or woken again."""

from .entry import STAYED, Entry

STAYS = (STAYED,)
MODES = ("OFF", "STANDBY", "ACQUISITION", "COARSE", "VERNIER", "EXPERIMENT", "SAFE")
POWERED = MODES[1:6]


def rig_for(mode):
    """COARSE lasts only where nothing is ever in reach."""
    return "never in reach" if mode == "COARSE" else "fit-mock"


def in_each_mode(struck, how, within_s, ends, says, ends_at_rest=STAYS, says_at_rest=""):
    """One entry for each mode; in OFF and SAFE there is less to be noticed."""
    for mode in MODES:
        powered = mode in POWERED
        yield Entry(
            struck,
            how,
            ends if powered else ends_at_rest,
            says if powered else says_at_rest,
            mode,
            within_s,
            rig=rig_for(mode),
        )


# It stays, unless the machine has so much else to do that of half its time too little is left: then the servo
# has no young reading for its 0.25 s, or is too late for the siderostat of a search.
SLOW = (STAYED, "SAFE")
ENTRIES = (
    *in_each_mode("mocks", "killed", 2.0, ("SAFE",), "expected"),
    *in_each_mode("mocks", "stopped", 3.0, ("SAFE",), "expected"),
    *in_each_mode("mocks", "slowed", 2.0, SLOW, ""),
    *in_each_mode("supervisor", "killed", 5.0, ("OFF",), "", ("OFF",)),
    *in_each_mode("supervisor", "stopped", 5.0, ("SAFE",), "expected"),
    # In EXPERIMENT both stages move when it is struck; the siderostat alone, and far, when it jogs.
    Entry("supervisor", "killed while it jogs", ("OFF",), mode="STANDBY", within_s=5.0, rig="slow siderostat"),
    Entry("supervisor", "stopped while it jogs", ("SAFE",), "expected", mode="STANDBY", within_s=5.0,
          rig="slow siderostat"),
    *in_each_mode("supervisor", "slowed", 2.0, SLOW, ""),
    *in_each_mode("recorder", "killed", 5.0, STAYS, "the recorder was killed by signal 9",
                  STAYS, "the recorder was killed by signal 9"),
    *in_each_mode("recorder", "stopped", 2.0, STAYS, ""),
    *in_each_mode("recorder", "slowed", 2.0, STAYS, ""),
    # Mode by mode: what is killed must have lived for a while, or it is not started again at once.
    *(
        Entry(beside, how, STAYS, says.format(beside), mode, within_s,
              rig="by TCP, never in reach" if mode == "COARSE" else "by TCP")
        for mode in MODES
        for how, says, within_s in (
            ("killed", "the {} was killed by signal 9", 3.0), ("stopped", "", 1.0), ("slowed", "", 1.0))
        for beside in ("gateway", "metrics server", "learner")
    ),
)  # fmt: skip
