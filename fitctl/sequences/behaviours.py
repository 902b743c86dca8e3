"""The table of all steps: from a step's name to how it works."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.sequences.acquiring import ACQUIRE
from fitctl.sequences.behaviour import Behaviour
from fitctl.sequences.dark import DARK
from fitctl.sequences.open_loop import OPEN_LOOP
from fitctl.sequences.plain import PLAIN
from fitctl.sequences.plate_scale import PLATE_SCALE
from fitctl.sequences.pointing import POINTING
from fitctl.sequences.stars import STARS
from fitctl.sequences.steps import Step

BEHAVIOURS: dict[str, Behaviour] = (
    PLAIN | ACQUIRE | POINTING | OPEN_LOOP | PLATE_SCALE | DARK | STARS
)


def problems(step: Step, rig: Rig) -> list[str]:
    """What is wrong with a step for a rig, without the instrument: one text each."""
    if not step.loop and len(rig.loops) > 1:
        return [f"loop is missing: rig {rig.name} has {', '.join(rig.loops)}"]
    if step.loop and step.loop not in rig.loops:
        return [f"loop {step.loop!r}: rig {rig.name} has {', '.join(rig.loops)}"]
    return BEHAVIOURS[step.step].check(step, rig, loop_of(step, rig))


def loop_of(step: Step, rig: Rig) -> str:
    """The name of the loop that works."""
    return step.loop or next(iter(rig.loops))
