"""The modes of a loop, and for each kind of loop the one table of what leads from each to which.

A table is data: the machine, the console's diagram, the documentation and the exhaustive test all
read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

OPERATOR = "operator"
"""The reason of a change of mode or design that a command asked for."""


class Mode(IntEnum):
    """What a loop is doing; the number is what logs carry."""

    OFF = 0
    STANDBY = 1
    ACQUISITION = 2
    COARSE = 3
    VERNIER = 4
    SAFE = 5
    EXPERIMENT = 6
    LOCKED = 7


MEANING = {
    Mode.OFF: "devices closed, nothing powered",
    Mode.STANDBY: "devices ready, siderostat stands where it is, mirror at its bias",
    Mode.ACQUISITION: "the siderostat searches for the star along a spiral",
    Mode.COARSE: "star found; the siderostat pulls it in",
    Mode.VERNIER: "the fast steering mirror holds the star; the siderostat takes over lasting offsets",
    Mode.SAFE: "mirror to its bias, siderostat stopped, amplifiers disabled after a time",
    Mode.EXPERIMENT: "open loop: the stages make the motions of an identification, the camera records",
    Mode.LOCKED: "a metrology loop's siderostat holds its beam on the centre of the photodiodes",
}

STELLAR_MODES = tuple(mode for mode in Mode if mode is not Mode.LOCKED)
METROLOGY_MODES = (
    Mode.OFF,
    Mode.STANDBY,
    Mode.ACQUISITION,
    Mode.COARSE,
    Mode.LOCKED,
    Mode.SAFE,
)

KIND_MODES = {
    "stellar": {mode.name for mode in STELLAR_MODES},
    "metrology": {mode.name for mode in METROLOGY_MODES},
}
"""Modes by kind of loop, as the rig file names both."""

AT_REST = frozenset({Mode.OFF, Mode.SAFE})
"""The loop points at nothing, and its motors stand still."""

FOLLOWING = frozenset({Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT})
"""The star is known, and looked for where it should be."""

WITH_WINDOW = FOLLOWING - {Mode.EXPERIMENT}
"""The window may be put on another star: both stages follow what is in it."""

TRACKING = FOLLOWING | {Mode.ACQUISITION}

BEAM_FOLLOWING = frozenset({Mode.COARSE, Mode.LOCKED})
"""The metrology beam is on the photodiodes."""

HOLDING = frozenset({Mode.VERNIER, Mode.LOCKED})
"""A loop of any kind holds its star or its beam."""

POINTING = TRACKING | BEAM_FOLLOWING
"""A loop of any kind points at something or searches for it."""


class Trigger(IntEnum):
    """What can lead from one mode to another: commands of people, then findings of the loop."""

    STANDBY = 0
    ACQUIRE = 1
    RELEASE = 2
    STOP = 3
    RECOVER = 4
    OFF = 5
    STAR_FOUND = 6
    IN_REACH = 7
    OUT_OF_REACH = 8
    STAR_LOST = 9
    SEARCH_EXHAUSTED = 10
    FAULT = 11
    EXPERIMENT = 12
    EXPERIMENT_DONE = 13
    BEAM_FOUND = 14
    BEAM_LOST = 15


# Those that need no more than their name; an experiment needs its motions.
COMMANDS = frozenset(
    {
        Trigger.STANDBY,
        Trigger.ACQUIRE,
        Trigger.RELEASE,
        Trigger.STOP,
        Trigger.RECOVER,
        Trigger.OFF,
    }
)


class Finding(NamedTuple):
    """What a frame means for the mode; without a trigger it goes on."""

    trigger: Trigger | None
    reason: str


@dataclass(frozen=True, slots=True)
class Transition:
    """One row of the table."""

    source: Mode
    trigger: Trigger
    target: Mode
    condition: str


def _from(
    sources: tuple[Mode, ...], trigger: Trigger, target: Mode, condition: str
) -> list[Transition]:
    return [Transition(source, trigger, target, condition) for source in sources]


_POWERED = (Mode.STANDBY, Mode.ACQUISITION, Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT)

_BEGIN = (
    *_from((Mode.OFF,), Trigger.STANDBY, Mode.STANDBY, "all devices open, checked and enabled"),
    *_from((Mode.STANDBY,), Trigger.ACQUIRE, Mode.ACQUISITION, "on command"),
    *_from(
        (Mode.ACQUISITION,),
        Trigger.ACQUIRE,
        Mode.ACQUISITION,
        "on command; the search starts again",
    ),
)
_RECOVER_OFF = (
    *_from(
        (Mode.SAFE,), Trigger.RECOVER, Mode.STANDBY, "all devices reopened, checked and enabled"
    ),
    *_from(
        (Mode.STANDBY, Mode.SAFE),
        Trigger.OFF,
        Mode.OFF,
        "on command; amplifiers disabled, devices closed",
    ),
)

TRANSITIONS: tuple[Transition, ...] = (
    *_BEGIN,
    *_from(
        (Mode.ACQUISITION,), Trigger.STAR_FOUND, Mode.COARSE, "star on found_frames frames in a row"
    ),
    *_from(
        (Mode.ACQUISITION,),
        Trigger.SEARCH_EXHAUSTED,
        Mode.STANDBY,
        "search radius covered; for a lost star, after search_again_s",
    ),
    *_from(
        (Mode.COARSE,),
        Trigger.IN_REACH,
        Mode.VERNIER,
        "error in the mirror's reach for reach_frames",
    ),
    *_from(
        (Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT),
        Trigger.STAR_LOST,
        Mode.ACQUISITION,
        "no star for lost_frames, or a spot that the stages do not move",
    ),
    *_from(
        (Mode.VERNIER,),
        Trigger.OUT_OF_REACH,
        Mode.COARSE,
        "error beyond its range for reach_frames",
    ),
    *_from((Mode.COARSE, Mode.VERNIER), Trigger.EXPERIMENT, Mode.EXPERIMENT, "on command"),
    *_from((Mode.EXPERIMENT,), Trigger.EXPERIMENT_DONE, Mode.COARSE, "all motions done"),
    *_from(
        (Mode.ACQUISITION, Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT),
        Trigger.RELEASE,
        Mode.STANDBY,
        "on command",
    ),
    *_from(STELLAR_MODES, Trigger.STOP, Mode.SAFE, "on command, at once"),
    *_from(_POWERED, Trigger.FAULT, Mode.SAFE, "any device fault"),
    *_RECOVER_OFF,
)
"""Of a stellar loop."""

METROLOGY_TRANSITIONS: tuple[Transition, ...] = (
    *_BEGIN,
    *_from(
        (Mode.ACQUISITION,),
        Trigger.BEAM_FOUND,
        Mode.COARSE,
        "beam on found_frames samples in a row",
    ),
    *_from(
        (Mode.ACQUISITION,),
        Trigger.SEARCH_EXHAUSTED,
        Mode.STANDBY,
        "search radius covered; for a lost beam, after search_again_s",
    ),
    *_from(
        (Mode.COARSE,),
        Trigger.IN_REACH,
        Mode.LOCKED,
        "beam near the centre for found_frames",
    ),
    *_from(
        (Mode.LOCKED,),
        Trigger.OUT_OF_REACH,
        Mode.COARSE,
        "beam not measured by all four photodiodes, or far from the centre, for lost_frames",
    ),
    *_from(
        (Mode.COARSE, Mode.LOCKED), Trigger.BEAM_LOST, Mode.ACQUISITION, "no beam for lost_frames"
    ),
    *_from(
        (Mode.ACQUISITION, Mode.COARSE, Mode.LOCKED), Trigger.RELEASE, Mode.STANDBY, "on command"
    ),
    *_from(METROLOGY_MODES, Trigger.STOP, Mode.SAFE, "on command, at once"),
    *_from(
        (Mode.STANDBY, Mode.ACQUISITION, Mode.COARSE, Mode.LOCKED),
        Trigger.FAULT,
        Mode.SAFE,
        "any device fault",
    ),
    *_RECOVER_OFF,
)
"""Of a metrology loop."""


def transition(
    mode: Mode, trigger: Trigger, table: tuple[Transition, ...] = TRANSITIONS
) -> Transition | None:
    """The row for a trigger in a mode, or None where it means nothing."""
    return next((row for row in table if row.source is mode and row.trigger is trigger), None)


def usable_commands(mode: Mode, table: tuple[Transition, ...] = TRANSITIONS) -> list[Trigger]:
    """The commands that mean something in a mode, in the order of the table."""
    return [row.trigger for row in table if row.source is mode and row.trigger in COMMANDS]


def mermaid(table: tuple[Transition, ...] = TRANSITIONS) -> str:
    """The table as a Mermaid state diagram, for the documentation."""
    lines = ["stateDiagram-v2", "    [*] --> OFF"]
    lines += [
        f"    {row.source.name} --> {row.target.name}: {row.trigger.name.lower().replace('_', ' ')}"
        for row in table
    ]
    return "\n".join(lines)
