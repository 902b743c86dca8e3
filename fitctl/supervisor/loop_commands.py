"""Commands that concern only some loops: each is carried out, or returns the reason for its refusal."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.attribution import FOLLOWED_PX
from fitctl.loop.loop import Loop
from fitctl.loop.metrology import MetrologyLoop
from fitctl.loop.search.spiral import refused_area
from fitctl.loop.search.star import refused_search
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.command_table import ROWS
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
from fitctl.messages.modes import FOLLOWING, WITH_WINDOW, Trigger, transition
from fitctl.stages.drives import refused_drives
from fitctl.supervisor.jogging import jog_siderostats, offset_mirrors

Floats = NDArray[np.float64]
Loops = Sequence[Loop]
StellarLoops = Sequence[StellarLoop]
_WAY_PLACES = 200  # no farther apart than 0.3 px


def set_target(rig: Rig, loops: StellarLoops, command: SetTarget) -> str:
    """Hold one loop's star elsewhere; empty, or why not."""
    if len(loops) != 1:  # two stars on one place are lost, and searched for and lost, without end
        return f"a target is of one loop; name the loop: {_names(loops)}"
    if not rig.camera.window_fits(command.az_px, command.el_px):
        return f"target {rig.camera.no_window_text(command.az_px, command.el_px)}"
    (loop,) = loops
    target_px = np.array([command.az_px, command.el_px])
    from_px = np.array(loop.pointing.command_px) if loop.mode in FOLLOWING else target_px
    for other in loop.others:
        if _comes_near(from_px, target_px, other.target_px):
            az_px, el_px = other.target_px.tolist()
            return (
                f"target {command.az_px:g} {command.el_px:g}: there or on the straight way there the star "
                f"comes too near that of loop {other.name}, at {az_px:g} {el_px:g}; expected more than "
                f"{FOLLOWED_PX:g} px between them along one axis; go round it by several targets"
            )
    loop.target_px = target_px
    return ""


def _comes_near(from_px: Floats, to_px: Floats, place_px: Floats) -> bool:
    """Whether what goes straight, each shape (2,), comes so near to a place that the two may be exchanged.

    What begins so near may go away from it.
    """
    way_px = np.linspace(from_px, to_px, _WAY_PLACES)
    is_clear = np.abs(way_px - place_px).max(axis=1) > FOLLOWED_PX
    return not is_clear[is_clear.argmax() :].all()


def look(rig: Rig, loops: StellarLoops, command: Look) -> str:
    """Measure one loop's star elsewhere on the next frame; empty, or why not."""
    if len(loops) != 1:
        return f"one loop looks at a place; name the loop: {_names(loops)}"
    (loop,) = loops
    if loop.mode not in WITH_WINDOW:
        return f"look is not available in {loop.mode.name}; it needs COARSE or VERNIER"
    if not rig.camera.window_fits(command.az_px, command.el_px):
        return f"look {rig.camera.no_window_text(command.az_px, command.el_px)}"
    loop.star_finder.look_at_px = (command.az_px, command.el_px)
    return ""


def reset_interlock(_rig: Rig, loops: Loops, command: Reset) -> str:
    """Let a tripped interlock go; empty if one loop had it, or why not."""
    why_not = [loop.reset_interlock(command.name) for loop in loops]
    return "" if "" in why_not else why_not[0]


def start_experiment(rig: Rig, loops: StellarLoops, command: Experiment) -> str:
    """Make an experiment's motions with one loop's stages; return why not, or an empty text."""
    if len(loops) != 1:
        return f"an experiment is on one loop; name it: {_names(loops)}"
    (loop,) = loops
    if transition(loop.mode, Trigger.EXPERIMENT) is None:
        return f"experiment is not available in {loop.mode.name}; it needs COARSE or VERNIER"
    if loop.waits_for:
        return f"experiment is not available while loop {loop.name} waits for {loop.waits_for}"
    interlocks = loop.interlocks
    if interlocks.holds:
        names = ", ".join(
            trip.name for trip in interlocks.tripped if trip.action == interlocks.action
        )
        return f"experiment is not available while an interlock keeps the stages where they are: {names}"
    why_not = refused_drives(rig, loop.name, command.drives)
    if why_not:
        return f"experiment: {why_not}"
    loop.start_experiment(command.name, command.drives)
    return ""


def why_no_search(rig: Rig, loops: Loops, command: Acquire) -> str:
    """Why a search cannot be as it is asked for; empty if it can."""
    place = {command.expected_az_sky_arcsec, command.expected_el_sky_arcsec} - {None}
    if place and len(loops) > 1:
        return f"acquire: a place is of one loop; name the loop: {_names(loops)}"
    refused = (
        refused_area(loop.settings, loop.name, command)
        if isinstance(loop, MetrologyLoop)
        else refused_search(rig, loop.name, command)
        for loop in loops
    )
    return next((f"acquire: {why_not}" for why_not in refused if why_not), "")


OF_STARS: dict[type[AnyCommand], Callable[[Rig, StellarLoops, Any], str]] = {
    SetTarget: set_target,
    Look: look,
    SetBiasOffset: offset_mirrors,
    Experiment: start_experiment,
}
"""Commands that only a stellar loop obeys; without a loop's name, they are for all of these."""

OF_ANY_LOOP: dict[type[AnyCommand], Callable[[Rig, Loops, Any], str]] = {
    Jog: jog_siderostats,
    Reset: reset_interlock,
}

LOOP_COMMANDS = OF_STARS.keys() | OF_ANY_LOOP.keys()


def obey_loop_command(rig: Rig, loops: Loops, command: AnyCommand) -> str:
    """Obey one of `LOOP_COMMANDS`; empty, or why not."""
    if type(command) in OF_ANY_LOOP:
        return OF_ANY_LOOP[type(command)](rig, loops, command)
    stellar = [loop for loop in loops if isinstance(loop, StellarLoop)]
    if not stellar:
        row = ROWS[type(command)]
        return (
            f"{row.word or row.name} is for a stellar loop; {command.loop} holds a metrology beam"
        )
    return OF_STARS[type(command)](rig, stellar, command)


def _names(loops: Loops) -> str:
    return ", ".join(loop.name for loop in loops)
