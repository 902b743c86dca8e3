"""Commands that concern some loops and nothing else of the rig: each says why it cannot be, or is done."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from fitctl.config import Rig
from fitctl.loop.search import refused_search
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import (
    Acquire,
    AnyCommand,
    Experiment,
    Jog,
    Look,
    Reset,
    SetBiasOffset,
    SetTarget,
)
from fitctl.messages.modes import WITH_WINDOW, Trigger, transition
from fitctl.stages.drives import refused_drives
from fitctl.supervisor.jogging import move_by_hand

Loops = Sequence[StellarLoop]


def set_target(rig: Rig, loops: Loops, command: SetTarget) -> str:
    """Hold the star elsewhere; empty, or why not."""
    if not rig.camera.window_fits(command.az_px, command.el_px):
        return f"target {rig.camera.window_range_text}"
    for loop in loops:
        loop.target_px = np.array([command.az_px, command.el_px])
    return ""


def look(rig: Rig, loops: Loops, command: Look) -> str:
    """Measure one loop's star elsewhere on the next frame; empty, or why not."""
    if len(loops) != 1:
        return f"one loop looks at a place; name it: {', '.join(loop.name for loop in loops)}"
    (loop,) = loops
    if loop.mode not in WITH_WINDOW:
        return f"look means nothing in {loop.mode.name}; a star is followed in COARSE and VERNIER"
    if not rig.camera.window_fits(command.az_px, command.el_px):
        return f"look {rig.camera.window_range_text}"
    loop.star_finder.look_at_px = (command.az_px, command.el_px)
    return ""


def reset_interlock(_rig: Rig, loops: Loops, command: Reset) -> str:
    """Let a tripped interlock go; empty if one loop had it, or why not."""
    why_not = [loop.reset_interlock(command.name) for loop in loops]
    return "" if "" in why_not else why_not[0]


def start_experiment(rig: Rig, loops: Loops, command: Experiment) -> str:
    """Move one loop's stages as told; empty, or why not."""
    if len(loops) != 1:
        return f"an experiment is on one loop; name it: {', '.join(loop.name for loop in loops)}"
    (loop,) = loops
    if transition(loop.mode, Trigger.EXPERIMENT) is None:
        return f"experiment means nothing in {loop.mode.name}; it needs a star in COARSE or VERNIER"
    why_not = refused_drives(rig, loop.name, command.drives)
    if why_not:
        return f"experiment: {why_not}"
    loop.start_experiment(command.name, command.drives)
    return ""


def why_no_search(rig: Rig, loops: Loops, command: Acquire) -> str:
    """Why a search cannot be as it is asked for; empty if it can."""
    refused = (refused_search(rig, loop.name, command) for loop in loops)
    return next((f"acquire: {why_not}" for why_not in refused if why_not), "")


LOOP_COMMANDS: dict[type[AnyCommand], Callable[[Rig, Loops, Any], str]] = {
    SetTarget: set_target,
    Look: look,
    Jog: move_by_hand,
    SetBiasOffset: move_by_hand,
    Reset: reset_interlock,
    Experiment: start_experiment,
}
