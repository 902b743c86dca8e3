"""The modes of a stellar loop, and the one table of what leads from each to which.

The table is data: the machine, the console's diagram, the documentation and the exhaustive test all
read it.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple


class Mode(IntEnum):
    """What a loop is doing; the number is what logs carry."""

    OFF = 0
    STANDBY = 1
    ACQUISITION = 2
    COARSE = 3
    VERNIER = 4
    SAFE = 5
    EXPERIMENT = 6


MEANING = {
    Mode.OFF: "devices let go, nothing powered",
    Mode.STANDBY: "devices ready, siderostat held where it is, mirror at its bias",
    Mode.ACQUISITION: "the siderostat searches for the star along a spiral",
    Mode.COARSE: "star found; the siderostat pulls it in",
    Mode.VERNIER: "the fast steering mirror holds the star, the siderostat takes what lasts",
    Mode.SAFE: "mirror to its bias, siderostat stopped, amplifiers disabled after a time",
    Mode.EXPERIMENT: "open loop: the stages move as an identification asks, the camera watches",
}

FOLLOWING = frozenset({Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT})
"""The star is known, and looked for where it should be."""

WITH_WINDOW = FOLLOWING - {Mode.EXPERIMENT}
"""The window may be put on another star: both stages follow what is in it."""

TRACKING = FOLLOWING | {Mode.ACQUISITION}


class Trigger(IntEnum):
    """What can lead from one mode to another: commands of people, then findings of the loop."""

    STANDBY = 0
    ACQUIRE = 1
    HOLD = 2
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


# Those that need no more than their name; an experiment needs its motions.
COMMANDS = frozenset(
    {
        Trigger.STANDBY,
        Trigger.ACQUIRE,
        Trigger.HOLD,
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

TRANSITIONS: tuple[Transition, ...] = (
    *_from((Mode.OFF,), Trigger.STANDBY, Mode.STANDBY, "all devices open, checked and enabled"),
    *_from((Mode.STANDBY,), Trigger.ACQUIRE, Mode.ACQUISITION, "asked for"),
    *_from(
        (Mode.ACQUISITION,), Trigger.ACQUIRE, Mode.ACQUISITION, "asked for; the search begins anew"
    ),
    *_from(
        (Mode.ACQUISITION,), Trigger.STAR_FOUND, Mode.COARSE, "star on found_frames frames in a row"
    ),
    *_from(
        (Mode.ACQUISITION,),
        Trigger.SEARCH_EXHAUSTED,
        Mode.STANDBY,
        "whole search radius seen; for a star that was lost, search_again_s over",
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
        "no star for lost_frames",
    ),
    *_from(
        (Mode.VERNIER,),
        Trigger.OUT_OF_REACH,
        Mode.COARSE,
        "error beyond its range for reach_frames",
    ),
    *_from((Mode.COARSE, Mode.VERNIER), Trigger.EXPERIMENT, Mode.EXPERIMENT, "asked for"),
    *_from((Mode.EXPERIMENT,), Trigger.EXPERIMENT_DONE, Mode.COARSE, "all motions done"),
    *_from(
        (Mode.ACQUISITION, Mode.COARSE, Mode.VERNIER, Mode.EXPERIMENT),
        Trigger.HOLD,
        Mode.STANDBY,
        "asked for",
    ),
    *_from(tuple(Mode), Trigger.STOP, Mode.SAFE, "asked for, at once"),
    *_from(_POWERED, Trigger.FAULT, Mode.SAFE, "any device fault"),
    *_from(
        (Mode.SAFE,), Trigger.RECOVER, Mode.STANDBY, "all devices reopened, checked and enabled"
    ),
    *_from(
        (Mode.STANDBY, Mode.SAFE),
        Trigger.OFF,
        Mode.OFF,
        "asked for; amplifiers disabled, devices closed",
    ),
)

_TABLE = {(row.source, row.trigger): row for row in TRANSITIONS}


def transition(mode: Mode, trigger: Trigger) -> Transition | None:
    """The row for a trigger in a mode, or None where it means nothing."""
    return _TABLE.get((mode, trigger))


def usable_commands(mode: Mode) -> list[Trigger]:
    """The commands that mean something in a mode, in the order of the table."""
    return [row.trigger for row in TRANSITIONS if row.source is mode and row.trigger in COMMANDS]


def mermaid() -> str:
    """The table as a Mermaid state diagram, for the documentation."""
    lines = ["stateDiagram-v2", "    [*] --> OFF"]
    lines += [
        f"    {row.source.name} --> {row.target.name}: {row.trigger.name.lower().replace('_', ' ')}"
        for row in TRANSITIONS
    ]
    return "\n".join(lines)
