"""The table of all steps: from a step's name to how it works."""

from __future__ import annotations

from fitctl.config import Rig
from fitctl.config.conflict import written
from fitctl.sequences.behaviours.acquiring import ACQUIRE
from fitctl.sequences.behaviours.behaviour import Behaviour
from fitctl.sequences.behaviours.dark import DARK
from fitctl.sequences.behaviours.open_loop import OPEN_LOOP
from fitctl.sequences.behaviours.overlap import OVERLAP
from fitctl.sequences.behaviours.plain import PLAIN
from fitctl.sequences.behaviours.plate_scale import PLATE_SCALE
from fitctl.sequences.behaviours.pointing import POINTING
from fitctl.sequences.behaviours.scans import SCANS
from fitctl.sequences.behaviours.stars import STARS
from fitctl.sequences.behaviours.testbed import TESTBED
from fitctl.sequences.steps import Step

BEHAVIOURS: dict[str, Behaviour] = (
    PLAIN | ACQUIRE | POINTING | OPEN_LOOP | PLATE_SCALE | DARK | STARS | TESTBED | SCANS | OVERLAP
)

LONGEST_STEP_S = 7 * 86_400.0
"""More is a mistake in one of its keys."""


def problems(step: Step, rig: Rig) -> list[str]:
    """What is wrong with a step for a rig, without the instrument: one text each."""
    behaviour = BEHAVIOURS[step.step]
    if step.loop and step.loop not in rig.loops:
        return [f"loop {written(step.loop)}: rig {rig.name} has {', '.join(rig.loops)}"]
    if not step.loop and len(rig.loops) > 1 and behaviour.loops == "one":
        return [f"loop is missing: rig {rig.name} has {', '.join(rig.loops)}"]
    if step.loop in rig.metrology_loops and not behaviour.of_beams:
        return [f"{step.step} is for a stellar loop; {step.loop} holds a metrology beam"]
    names = loops_of(step, rig)
    found = [problem for name in names for problem in behaviour.check(step, rig, name)]
    if found:
        return list(dict.fromkeys(found))
    own_s = max(behaviour.own_s(step, rig, name) for name in names)
    if own_s > LONGEST_STEP_S:
        return [f"would take {own_s:.4g} s; a step takes at most {LONGEST_STEP_S:g} s"]
    return []


def loops_of(step: Step, rig: Rig) -> list[str]:
    """The names of the loops that work, in the order in which they do."""
    if step.loop:
        return [step.loop]
    match BEHAVIOURS[step.step].loops:
        case "links first":
            return sorted(rig.loops, key=lambda name: name not in rig.metrology_loops)
        case "links last":
            return sorted(rig.loops, key=lambda name: name in rig.metrology_loops)
        case _:
            return [next(iter(rig.loops))]
