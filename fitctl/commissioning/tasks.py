"""The steps of a commissioning in their order: one table."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from fitctl.commissioning.outcome import Outcome, Site
from fitctl.commissioning.steps import (
    acceptance,
    amplifiers,
    beam,
    camera,
    closed,
    devices,
    identified,
    link,
    mirror,
    plate,
    stacks,
    travel,
)
from fitctl.config import Rig

_NOTHING = "nothing"
_OVER_A_LINK = {"star": "photodiodes", "gentle": "link", "coupling": "collector"}
"""What a step needs of the loop that holds the link over which its star comes."""


class Step(NamedTuple):
    """A step.

    Attributes
    ----------
    title : str
        What it does, for people.
    of : str
        ``rig``: done once. ``siderostat``: once for each loop. ``star``: once for each stellar loop.
        ``beam``: once for each metrology loop; ``collector``: likewise, if the rig has a collector.
        ``feedforward``: once for each stellar loop with a feedforward, if the rig has a collector.
    moves : callable
        What it moves and by how much.
    needs : tuple of str
        Steps that must be done before.
    takes_s : float
        About how long.
    run : callable
    supervised : bool
        It runs a supervisor, which has the devices then.
    """

    title: str
    of: Literal["rig", "siderostat", "star", "beam", "collector", "feedforward"]
    moves: Callable[[Site], str]
    needs: tuple[str, ...]
    takes_s: float
    run: Callable[[Site], Outcome]
    supervised: bool = False


def _nothing(_site: Site) -> str:
    return _NOTHING


STEPS: dict[str, Step] = {
    "devices": Step(
        "Every device answers and is what the rig file says",
        "rig",
        _nothing,
        (),
        5.0,
        devices.check_devices,
    ),
    "camera": Step(
        "The camera's dark, noise, frame rate and delay are what the rig file says",
        "rig",
        _nothing,
        ("devices",),
        8.0,
        camera.check_camera,
    ),
    "stacks": Step(
        "Each D/A channel moves its stack, seen in the piezo amplifier's readback",
        "star",
        stacks.moves,
        ("devices",),
        12.0,
        stacks.check_stacks,
    ),
    "amplifiers": Step(
        "Each motor stands, turns on command, and its encoder counts it",
        "siderostat",
        amplifiers.moves,
        ("devices",),
        5.0,
        amplifiers.check_amplifiers,
    ),
    "photodiodes": Step(
        "Which photodiode is where, as the beam moves over them",
        "beam",
        beam.photodiodes_moves,
        ("amplifiers",),
        40.0,
        beam.check_photodiodes,
    ),
    "collector": Step(
        "Which way the hexapod moves the photodiodes under the beam",
        "collector",
        beam.collector_moves,
        ("photodiodes",),
        60.0,
        beam.check_collector,
    ),
    "star": Step(
        "The star is on the camera, alone, and as bright as the rig file says",
        "star",
        plate.star_moves,
        ("camera", "amplifiers"),
        60.0,
        plate.check_star,
    ),
    "siderostat": Step(
        "How the star moves with each motor: scale, rotation, mirror image",
        "star",
        plate.siderostat_moves,
        ("star", "amplifiers"),
        40.0,
        plate.check_siderostat,
    ),
    "mirror": Step(
        "How the star moves with each stack: order, scale, rotation",
        "star",
        mirror.moves,
        ("star", "stacks"),
        20.0,
        mirror.check_mirror,
    ),
    "travel": Step(
        "Each motor turns to both ends of its travel",
        "siderostat",
        travel.moves,
        ("amplifiers",),
        65.0,
        travel.check_travel,
    ),
    "link": Step(
        "The link: the loop of its beam holds it on the photodiodes",
        "beam",
        link.moves,
        ("photodiodes", "travel"),
        60.0,
        link.check_link,
        supervised=True,
    ),
    "gentle": Step(
        "The first closed loop: the siderostat at a tenth of its gain",
        "star",
        closed.gentle_moves,
        ("siderostat", "mirror", "travel"),
        70.0,
        closed.check_gentle,
        supervised=True,
    ),
    "loop": Step(
        "The whole loop holds the star",
        "star",
        closed.whole_moves,
        ("gentle",),
        50.0,
        closed.check_whole,
        supervised=True,
    ),
    **{
        name: Step(
            title,
            "star",
            identified.identification_moves(name),
            ("loop",),
            takes_s,
            identified.identification(name),
            supervised=True,
        )
        for name, title, takes_s in (
            ("airpath", "The air path, as the camera shows it", 95.0),
            ("hysteresis", "Hysteresis and stroke of each stack", 130.0),
            ("backlash", "The play between the siderostat's motors and the beam", 85.0),
            ("delay", "The time from mid-exposure to the command, as the star shows it", 60.0),
        )
    },
    "coupling": Step(
        "How far the link's siderostat turns the star, without the feedforward",
        "feedforward",
        link.coupling_moves,
        ("airpath", "hysteresis", "backlash"),
        85.0,
        link.check_coupling,
        supervised=True,
    ),
    "feedforward": Step(
        "The feedforward keeps the star on its target while the collector moves",
        "feedforward",
        link.feedforward_moves,
        ("coupling",),
        125.0,
        link.check_feedforward,
        supervised=True,
    ),
    "design": Step(
        "The design of the loop, and its margins on what was identified",
        "star",
        _nothing,
        ("airpath", "hysteresis", "backlash", "delay"),
        5.0,
        identified.check_design,
    ),
    "acceptance": Step(
        "Acceptance: acquisitions, a long hold, steps, STOP from each mode",
        "star",
        acceptance.accept_moves,
        ("design",),
        620.0,
        acceptance.check_acceptance,
        supervised=True,
    ),
    "cables": Step(
        "Each cable, disconnected while the star is held, leads to SAFE",
        "star",
        acceptance.cables_moves,
        ("acceptance",),
        65.0,
        acceptance.check_cables,
        supervised=True,
    ),
}


class Task(NamedTuple):
    """A step of one loop, or of the rig.

    Attributes
    ----------
    name : str
        ``devices``, or with its loop ``right.amplifiers``.
    loop : str
        Empty for a step of the rig.
    step : Step
    also : tuple of str
        Tasks that must be done before, beside those of its own loop that its step needs.
    """

    name: str
    loop: str
    step: Step
    also: tuple[str, ...] = ()

    def needs(self) -> Iterator[str]:
        """Names of the tasks that must be done before."""
        yield from self.also
        for name in self.step.needs:
            of_rig = STEPS[name].of == "rig"
            yield name if of_rig or not self.loop else f"{self.loop}.{name}"


def tasks_of(rig: Rig) -> list[Task]:
    """All tasks of a rig, in their order."""
    beams = list(rig.metrology_loops)
    loops = {
        "rig": [""],
        "siderostat": list(rig.loops),
        "star": list(rig.stellar_loops),
        "beam": beams,
        "collector": beams if rig.collector else [],
        "feedforward": [
            name for name, one in rig.stellar_loops.items() if one.feedforward and rig.collector
        ],
    }

    def also(name: str, loop: str) -> Iterator[str]:
        stellar = rig.stellar_loops.get(loop)
        if stellar and stellar.link and name in _OVER_A_LINK:  # no star comes before its beam does
            yield f"{stellar.link}.{_OVER_A_LINK[name]}"
        if name == "acceptance" and loop in loops["feedforward"]:
            yield f"{loop}.feedforward"

    return [
        Task(f"{loop}.{name}" if loop else name, loop, step, tuple(also(name, loop)))
        for name, step in STEPS.items()
        for loop in loops[step.of]
    ]
