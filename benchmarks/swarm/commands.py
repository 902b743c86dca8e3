"""The commands and reports of a run, each drawn."""

from __future__ import annotations

import json
from collections.abc import Callable
from random import Random

from fitctl.messages.commands import (
    Acquire,
    AnyCommand,
    Experiment,
    FrameRate,
    Jog,
    LearnerReport,
    Look,
    MoveCollector,
    Off,
    RecentEvents,
    Recover,
    Release,
    Reset,
    SequenceControl,
    SetBiasOffset,
    SetController,
    SetTarget,
    Shutdown,
    Standby,
    Status,
    Stop,
    TakeOver,
)
from fitctl.model.drives import FSM, SIDEROSTAT, STACKS, Channel, Drive

MOST_RATE_S = 30.0  # of the camera at another rate
_FAR, _FAR_ARCSEC = 0.4, 550.0  # fraction of searches elsewhere, and how far at most on each axis
_LEARNT = {
    "coarse_per_s": 0.46,
    "settings": {"minimum_variance": {"drift_px_per_sqrt_s": 0.01, "offload_per_s": 0.03}},
}
_AIR = {"gain_px": 0.45, "b1_s2": 0.517, "b2_s": 2.5}
LEARNT_DESIGNS = [
    json.dumps({"name": "minimum-variance", "parameters": _LEARNT | night})
    for night in (
        {"noise_px": 0.03, "air_path": _AIR},
        {
            "noise_px": 0.01,
            "air_path": _AIR,
            "lines": [{"frequency_hz": 6.0, "damping": 0.005, "rms_px": 0.05}],
            "guard": {"frequency_hz": 19.4, "damping": 0.9, "rms_px": 0.0094},
        },
        {"noise_px": 0.001, "air_path": _AIR | {"gain_px": 5.0}},
    )
]
"""For a noisy star and for a line at 6 Hz; the last has not the margins, and must be refused."""
_NOTHING_LEARNT, _WORTH_IT = 0.2, 0.7  # fractions of its reports
# Most amplitude of an experiment's motions. Those of stacks and siderostats may be beyond their range.
_SWINGS: tuple[tuple[tuple[Channel, ...], float], ...] = (
    (STACKS, 5.5),
    (FSM, 1.0),
    (SIDEROSTAT, 60.0),
)


def drawn_search(random: Random) -> Acquire:
    """A search near the star's expected place, or far from it, so that the siderostat slews at full speed."""
    return Acquire() if random.random() > _FAR else far_search(random)


def far_search(random: Random) -> Acquire:
    """A search far from the star's expected place."""
    az_arcsec, el_arcsec = (random.uniform(-_FAR_ARCSEC, _FAR_ARCSEC) for _ in range(2))
    return Acquire(expected_az_sky_arcsec=az_arcsec, expected_el_sky_arcsec=el_arcsec)


def drawn_target(random: Random) -> SetTarget:
    """A target anywhere but at the edge of the frame."""
    return SetTarget(az_px=random.uniform(10, 30), el_px=random.uniform(10, 30))


def drawn_experiment(random: Random) -> Experiment:
    """One to three motions of mirror or siderostat, of up to 10 s; some are beyond what a rig accepts."""
    return Experiment(
        name="swarm", drives=[_drawn_drive(random) for _ in range(random.randint(1, 3))]
    )


def _drawn_drive(random: Random) -> Drive:
    channels, most = random.choice(_SWINGS)
    return Drive(
        channel=random.choice(channels),
        shape=random.choice(("triangle", "sine", "square")),
        amplitude=random.uniform(0.0, most),
        frequency_hz=10 ** random.uniform(-1.0, 1.5),
        duration_s=10 ** random.uniform(-1.0, 1.0),
        start_s=random.choice((0.0, random.uniform(0.0, 2.0))),
        end_amplitude=random.choice((None, random.uniform(0.0, most))),
        end_frequency_hz=random.choice((None, random.uniform(0.1, 30.0))),
    )


def drawn_report(random: Random, loop: str) -> LearnerReport:
    """A learner's report on a loop, right or wrong; in some, nothing is learnt."""
    if random.random() < _NOTHING_LEARNT:
        return LearnerReport(loop=loop, design_json="", text="nothing is learnt", evaluated_s=60.0)
    present_px, measured_px = random.uniform(0.01, 0.05), random.uniform(0.01, 0.05)
    return LearnerReport(
        loop=loop,
        design_json=random.choice(LEARNT_DESIGNS),
        text="a night of the swarm",
        evaluated_s=random.uniform(60.0, 600.0),
        present_px=present_px,
        learnt_px=present_px * random.uniform(0.5, 0.99),
        bound_px=0.5 * present_px,
        learnt_camera_px=measured_px * random.uniform(0.5, 1.5),
        measured_px=measured_px,
        noise_px=random.uniform(0.003, 0.03),
        worth_it=random.random() < _WORTH_IT,
        fits=random.random() < _WORTH_IT,
        classifying_rate_hz=random.choice((0.0, 47.0, 470.0)),
    )


COMMANDS: dict[str, Callable[[Random], AnyCommand | None]] = {
    "onwards": lambda _: None,
    "stop": lambda _: Stop(),
    "off": lambda _: Off(),
    "recover": lambda _: Recover(),
    "standby": lambda _: Standby(),
    "acquire": drawn_search,
    "release": lambda _: Release(),
    "status": lambda _: Status(),
    "take-over": lambda _: TakeOver(),
    "target": drawn_target,
    "jog": lambda random: Jog(
        az_sky_arcsec=random.uniform(-60, 60), el_sky_arcsec=random.uniform(-60, 60)
    ),
    "controller": lambda random: SetController(
        name=random.choice(("eq20", "minimum-variance", "learnt"))
    ),
    "sequence-control": lambda random: SequenceControl(
        action=random.choice(("pause", "resume", "end"))
    ),
    "reset": lambda _: Reset(name="dac_watchdog"),
    "look": lambda random: Look(az_px=random.uniform(5, 35), el_px=random.uniform(5, 35)),
    "shutdown": lambda random: Shutdown() if random.random() < 0.2 else None,
    "collector": lambda random: MoveCollector(
        action=random.choice(("reference", "start", "start", "stop"))
    ),
    "bias-offset": lambda random: SetBiasOffset(
        az_urad=random.uniform(-100, 100), el_urad=random.uniform(-100, 100)
    ),
    "experiment": drawn_experiment,
    "events": lambda _: RecentEvents(),
    "frame-rate": lambda random: FrameRate(
        rate_hz=random.choice((47.0, 48.0, 470.0, 480.0)),
        duration_s=random.uniform(1.0, MOST_RATE_S),
    ),
}
"""By name. ``None`` stands for the command that brings a loop closer to its star."""
