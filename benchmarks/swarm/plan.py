"""What happens in one run, drawn from a seed before the run begins, so that parts of it can be left out."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from random import Random

import msgspec

from benchmarks.swarm.lines import FAULTS, WRONG, drawn_slowness
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

RIGS: dict[str, tuple[str, ...]] = {
    "fit-mock.toml": ("right",),
    "fit-testbed.toml": ("right", "metrology", "left"),
    "two-stars.toml": ("right", "left"),
    "ensemble.toml": ("right",),
    "fit-bal-analog.toml": ("right",),
}
"""Files in ``rigs/``, each with its loops."""
_RIG_WEIGHTS = (8, 3, 2, 3, 3)
_SETTINGS = (
    "service.lease_s=10.0",
    "logging.queue_records=200",
    "supervisor.telemetry_hz=20.0",
    "loops.right.acquisition.search_again_s=10.0",
    'interlocks.flux_low.action="freeze"',
    'interlocks.flux_low.action="flatten"',
)
"""Settings that some runs change."""
_SETTING = 0.15  # fraction of runs that change each of them
_SLOW_SERVO = {
    "servo.rate_hz": (100.0, 50.0),
    "servo.gain_per_s": (40.0, 15.0),
    "servo.following_error_limit_rad": (4.0, 10.0),
}
"""Settings of a siderostat whose servo runs at 100 or at 50 Hz instead of 500."""
_SLOW = {"fit-mock.toml": 0.15, "two-stars.toml": 0.5, "fit-testbed.toml": 0.6}
"""Fraction of runs with slow servos. These runs also take less time."""
_FAST_FRAMES = (
    "camera.frame_rate_hz=500.0",
    "camera.exposure_s=0.001",
    "camera.frame_delay_s=0.0035",
)
_FAST = {"fit-mock.toml": 0.1}
"""Fraction of runs with ten times as many frames; they last a third as long."""
DURATION_S, FAST_DURATION_S = 120.0, 40.0
MOST_RATE_S = 30.0  # of the camera at another rate
OPERATORS = ("ada", "ben", "cleo", "dora")
_OF_ONE_LOOP = 0.3  # fraction of commands that name a loop
_WITHOUT_FAULTS = 0.15  # fraction of runs without device faults
_CONSOLE_SLOW = 0.2  # fraction of runs whose console misses messages
_SEVERAL_WRITES = 0.15  # fraction of runs whose mirrors are written between frames
_REMOTE = 0.1  # fraction of runs with remote consoles: decoding takes a fifth of their time
_STEPS = ("standby", "acquire", "acquire", "hold", "wait", "dither", "offset", "off")
_FAR, _FAR_ARCSEC = 0.4, 550.0  # fraction of searches elsewhere, and how far at most on each axis
# Fraction of commands that are repeated, drawn for each run, and the mean delay: a key held down.
_REPEATED, _REPEATED_S = (0.0, 0.1, 0.6), 0.02
_PLACES, _FEW_PLACES = 3, 0.5  # fraction of runs whose targets are only so many places
_SLOW_SLEW = 0.4  # fraction of interrupted slews on a slow line
_SLEW_S = 1.5  # a slew is interrupted within this time of its beginning,
_MEETS_S = 0.1  # and a stall follows within this
_WRONG = 0.25  # fraction of strikes with wrong values, on devices that can have some
# Fraction of runs with each change of the sky, and of those that the rig file knows.
_SKY, _TOLD = 0.15, 0.5
PHOTON_NOISE = "camera.electrons_per_dn=1.0"
_LEARNT = {
    "coarse_per_s": 0.46,
    "settings": {"minimum_variance": {"drift_px_per_sqrt_s": 0.01, "offload_per_s": 0.03}},
}
_AIR = {"gain_px": 0.45, "b1_s2": 0.517, "b2_s": 2.5}
_LEARNT_DESIGNS = [
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
_AT_ONCE_S = 0.004  # mean delay between hurried commands
_LONG_STALL, _SILENT = 0.3, 0.5  # fractions of disturbed rests
_LEARNER, _LEARNS = 0.4, 0.5  # fraction of runs with a learner, and of these, with `learn = "on"`
_REPORTS_S = 5.0  # mean time between a learner's reports
_NOTHING_LEARNT, _WORTH_IT = 0.2, 0.7  # fractions of its reports
# Most amplitude of an experiment's motions. Those of stacks and siderostats may be beyond their range.
_SWINGS: tuple[tuple[tuple[Channel, ...], float], ...] = (
    (STACKS, 5.5),
    (FSM, 1.0),
    (SIDEROSTAT, 60.0),
)
_EXPERIMENTS = 0.4  # fraction of runs with faults in which experiments are met by something
_COLLECTOR = 0.4  # fraction of the testbed's runs in which its collector is moved on purpose
_REFERENCED_S = 7.0  # until a reference move has ended
_BURST, _BURST_S = 0.4, 0.05  # fraction of happenings that follow another at once, and mean delay


AT_ONCE = frozenset({"reset", "power cut", "trip"})
"""Faults without a duration. A drive that has tripped stays so until it is opened again."""


def kind_of(device: str) -> str:
    """A device's name without its loop."""
    return device.rpartition(" ")[2]


class _Happening(msgspec.Struct, frozen=True, kw_only=True):
    at_s: float

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return str(self.__struct_config__.tag)


class Order(_Happening, frozen=True, kw_only=True, tag="order"):
    """An operator sends a command; ``None`` is whichever one brings the first loop closer to its star."""

    who: str
    command: AnyCommand | None = None

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return "onwards" if self.command is None else type(self.command).__name__


class Strike(_Happening, frozen=True, kw_only=True, tag="strike"):
    """A fault of one device, and how long it lasts; what happens at once has no duration."""

    device: str
    fault: str
    lasts_s: float = 0.0
    size: float = 0.0

    @property
    def kind(self) -> str:
        """The name used in the statistics."""
        return f"{kind_of(self.device)} {self.fault}"


class Stall(_Happening, frozen=True, kw_only=True, tag="stall"):
    """The whole machine stalls for a time."""

    lasts_s: float


class Kill(_Happening, frozen=True, kw_only=True, tag="kill"):
    """The supervisor's process is killed, and a new one starts ``back_after_s`` later."""

    back_after_s: float


class Cloud(_Happening, frozen=True, kw_only=True, tag="cloud"):
    """All stars dim to ``part`` of their light for a time."""

    lasts_s: float
    part: float


class RecorderDeath(_Happening, frozen=True, kw_only=True, tag="recorder death"):
    """The recorder is killed; the supervisor starts a new one."""


class FullDisk(_Happening, frozen=True, kw_only=True, tag="full disk"):
    """The log's disk is full for a time."""

    lasts_s: float


class ClockStep(_Happening, frozen=True, kw_only=True, tag="clock step"):
    """The computer's wall clock is set forward or back."""

    by_s: float


class Sequence(_Happening, frozen=True, kw_only=True, tag="sequence"):
    """An operator starts a sequence of steps from `benchmarks.swarm.clients.STEPS`."""

    who: str
    steps: list[str]


Happening = Order | Strike | Stall | Kill | Cloud | RecorderDeath | FullDisk | ClockStep | Sequence


class Plan(msgspec.Struct, frozen=True, kw_only=True):
    """One run.

    Attributes
    ----------
    seed : int
        Seed of everything else that is random, such as the plant's noise and each delay.
    rig : str
        A file in ``rigs/``.
    settings : list of str
        ``key.path=value`` texts that replace values of the rig file.
    duration_s : float
        Until all faults end and the healing begins.
    happenings : list
        In order of time.
    console_loss : float
        Fraction of the messages that the console misses.
    remote_consoles : int
        Consoles that receive encoded telemetry by the real client, each over a link with little room.
    """

    seed: int
    rig: str
    settings: list[str]
    duration_s: float
    happenings: list[Happening]
    console_loss: float = 0.0
    remote_consoles: int = 0


def drawn_search(random: Random) -> Acquire:
    """A search near the star's expected place, or far from it, so that the siderostat slews at full speed."""
    return Acquire() if random.random() > _FAR else _far_search(random)


def _far_search(random: Random) -> Acquire:
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
        design_json=random.choice(_LEARNT_DESIGNS),
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


_MEETS_EXPERIMENT = (
    "stop",
    "off",
    "release",
    "acquire",
    "target",
    "look",
    "controller",
    "frame-rate",
    "experiment",
    "shutdown",
)
"""Commands that come while an experiment is under way; see `_COMMANDS`."""

_COMMANDS: dict[str, Callable[[Random], AnyCommand | None]] = {
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


def slow_servos(rig: str, which: int) -> list[str]:
    """Settings that slow the servos of a rig's siderostats to 100 or 50 Hz."""
    return [
        f"loops.{loop}.siderostat.{key}={values[which]}"
        for loop in RIGS[rig]
        for key, values in _SLOW_SERVO.items()
    ] + [f"interlocks.following_error.high={(3.0, 8.0)[which]}"]


def stars_of(rig: str) -> list[str]:
    """The loops of a rig that point a star."""
    return [loop for loop in RIGS[rig] if loop != "metrology"]


def several_writes(rig: str) -> list[str]:
    """Settings with which a rig's mirrors are written several times a frame."""
    return [
        f"loops.{loop}.{key}"
        for loop in stars_of(rig)
        for key in ("fsm.dac.writes_per_frame=5", "vernier.controller=minimum-variance")
    ]


def learning(rig: str) -> list[str]:
    """Settings with which a rig's loops use learnt designs by themselves."""
    return [f'loops.{loop}.learn="on"' for loop in stars_of(rig)]


def vibrating(rig: str, frequency_hz: float, rms_px: float, direction_deg: float) -> list[str]:
    """Settings with a vibration in the motion of a rig's stars."""
    line = (
        f"{{frequency_hz={frequency_hz:.2f}, rms_px={rms_px:.3f}, direction_deg={direction_deg:.1f}, "
        "damping=0.01, drift_hz_per_min=0.0}"
    )
    return [f"plant.loops.{loop}.lines=[{line}]" for loop in stars_of(rig)]


def moving(rig: str, az_arcsec_s: float, el_arcsec_s: float, *, told: bool) -> list[str]:
    """Settings with stars that move by themselves, as the rig file knows if it is `told`.

    They begin nearer to the start, so that a search about the start finds them however long the run is.
    """
    rate = f"star_rate_sky_arcsec_s={{az={az_arcsec_s:.3f}, el={el_arcsec_s:.3f}}}"
    return [
        setting
        for loop in stars_of(rig)
        for setting in (
            f"plant.loops.{loop}.{rate}",
            f"plant.loops.{loop}.star_offset_sky_arcsec_max=150.0",
            *([f"loops.{loop}.{rate}"] if told else []),
        )
    ]


def with_another_spot(rig: str, *, told: bool) -> list[str]:
    """Settings with one more spot in the field of the only star of a rig, too dim for a star.

    On a rig with two stars it would interfere with the spots of the other one.
    """
    if len(stars_of(rig)) > 1:
        return []
    loop, fringe = stars_of(rig)[0], 'name="fringe", offset_px={az=-12.0, el=0.0}, flux_dn=11000.0'
    other = 'name="other", offset_px={az=10.0, el=9.0}, flux_dn=6000.0'
    star = 'name="pointing", offset_px={az=0.0, el=0.0}, flux_dn=28000.0'
    true = ", ".join(f"{{{spot}, diameter_px=3.0}}" for spot in (star, fringe, other))
    known = f"loops.{loop}.other_spots=[{{{fringe}}}, {{{other}}}]"
    return [f"plant.loops.{loop}.spots=[{true}]", *([known] if told else [])]


def drawn_sky(random: Random, rig: str) -> list[str]:
    """Settings of the light and of the stars, most often none."""
    settings = [PHOTON_NOISE] if random.random() < _SKY else []
    if random.random() < _SKY:
        settings += vibrating(
            rig, random.uniform(1.0, 20.0), random.uniform(0.02, 0.3), random.uniform(0.0, 180.0)
        )
    if random.random() < _SKY:
        told = random.random() < _TOLD
        # Without being told, Eq. 20 has the mirror at its limit from 0.3 arcsec/s on.
        most_arcsec_s = 0.3 if told else 0.15
        az_arcsec_s, el_arcsec_s = (random.uniform(-most_arcsec_s, most_arcsec_s) for _ in range(2))
        settings += moving(rig, az_arcsec_s, el_arcsec_s, told=told)
    if random.random() < _SKY:
        settings += with_another_spot(rig, told=random.random() < _TOLD)
    return settings


def devices_of(rig: str) -> list[str]:
    """The devices of a rig."""
    devices = ["camera"]
    for loop in RIGS[rig]:
        sensors = ("photodiodes",) if loop == "metrology" else ("D/A", "piezo")
        devices += [f"{loop} {what}" for what in ("siderostat", *sensors)]
    return [*devices, "hexapod"] if "metrology" in RIGS[rig] else devices


def plan_of(seed: int) -> Plan:
    """The plan that a seed gives."""
    random = Random(seed)  # noqa: S311 - a repeatable draw
    rig = random.choices(list(RIGS), _RIG_WEIGHTS)[0]
    return drawn_plan(random, seed, rig)


def drawn_plan(random: Random, seed: int, rig: str) -> Plan:
    """A plan for a rig.

    Each run draws a few kinds of faults and commands, leaves out the others, and has its own pace. A defect
    that many faults at once would hide shows in a run that has few of them.
    """
    loops = RIGS[rig]
    fast = random.random() < _FAST.get(rig, 0.0)
    duration_s = FAST_DURATION_S if fast else DURATION_S
    words = random.sample(list(_COMMANDS), random.randint(1, len(_COMMANDS)))
    strikes = _drawn_strikes(random, rig)
    every_s, fault_part = 10 ** random.uniform(-0.3, 1.0), random.uniform(0.05, 0.6)
    # The service refuses commands from operators without the lease.
    people = OPERATORS[: random.randint(1, len(OPERATORS))]
    attend_s = 10 ** random.uniform(0.0, 1.3)
    happenings: list[Happening] = []
    at_s = 0.1
    while at_s < duration_s:  # the first operator keeps trying to hold the star
        happenings.append(Order(at_s=at_s, who=OPERATORS[0]))
        at_s += random.expovariate(1 / attend_s)
    repeated = random.choice(_REPEATED)
    few = random.random() < _FEW_PLACES  # so that two loops are sent to one
    places = [drawn_target(random) for _ in range(_PLACES * few)]
    at_s = 0.2
    while True:
        burst = random.random() < _BURST
        at_s += random.expovariate(1 / (_BURST_S if burst else every_s))
        if at_s >= duration_s:
            break
        if strikes and random.random() < fault_part:
            happenings += random.choice(strikes)(random, at_s)
        else:
            command = _drawn_command(random, random.choice(words), places, loops)
            who, again_s = random.choice(people), at_s
            happenings.append(Order(at_s=at_s, who=who, command=command))
            while command is not None and random.random() < repeated:
                again_s += random.expovariate(1 / _REPEATED_S)
                happenings.append(Order(at_s=again_s, who=who, command=command))
    settings = _drawn_settings(random, rig, fast=fast)
    if random.random() < _LEARNER:
        happenings += _learner(random, duration_s, stars_of(rig))
        settings += learning(rig) if random.random() < _LEARNS else []
    happenings.sort(key=lambda happening: happening.at_s)
    console_loss = random.random() ** 2 if random.random() < _CONSOLE_SLOW else 0.0
    remote_consoles = random.randint(1, 3) if random.random() < _REMOTE else 0
    return Plan(
        seed=seed,
        rig=rig,
        settings=settings,
        duration_s=duration_s,
        happenings=happenings,
        console_loss=console_loss,
        remote_consoles=remote_consoles,
    )


def _drawn_strikes(random: Random, rig: str) -> list[Callable[[Random, float], list[Happening]]]:
    """What happens in a run besides single commands.

    Each makes the happenings that begin at a time. One that is there twice comes twice as often.
    """
    loops, devices = RIGS[rig], devices_of(rig)
    kinds = ("reset", "power cut", *FAULTS)
    faults = random.sample(kinds, random.randint(1, len(kinds)))
    struck = random.sample(devices, random.randint(1, len(devices)))
    strikes: list[Callable[[Random, float], list[Happening]]] = []
    for make, part in (
        (_stall, 0.4),
        (_kill, 0.3),
        (_cloud, 0.3),
        (_recorder_death, 0.2),
        (_full_disk, 0.2),
        (_clock_step, 0.2),
        (_sequence, 0.3),
    ):
        strikes += [make] * (random.random() < part)
    if random.random() >= _WITHOUT_FAULTS:
        strikes += [partial(_strike, devices=struck, faults=faults)] * random.randint(1, 6)
        strikes += [partial(_interrupted_slew, loops=loops)] * random.randint(0, 4)
        strikes += [partial(_disturbed_rest, loops=loops)] * random.randint(0, 2)
        if random.random() < _EXPERIMENTS:
            met = partial(_met_experiment, loops=stars_of(rig), devices=struck, faults=faults)
            strikes += [met] * random.randint(1, 3)
    if "metrology" in loops and random.random() < _COLLECTOR:
        strikes += [partial(_moved_collector, loops=loops)] * random.randint(1, 2)
    return strikes


def _learner(random: Random, duration_s: float, loops: list[str]) -> list[Happening]:
    """The learner's reports. It runs as its operator, on this machine."""
    reports: list[Happening] = []
    at_s = random.expovariate(1 / _REPORTS_S)
    while at_s < duration_s:
        report = drawn_report(random, random.choice(loops))
        reports.append(Order(at_s=at_s, who=OPERATORS[0], command=report))
        at_s += random.expovariate(1 / _REPORTS_S)
    return reports


def _drawn_settings(random: Random, rig: str, *, fast: bool) -> list[str]:
    # At the rig's own rate, telemetry takes a tenth of the run's time.
    settings = ["supervisor.telemetry_hz=5.0"]
    settings += [text for text in _SETTINGS if random.random() < _SETTING]
    if fast:
        settings += _FAST_FRAMES
    elif random.random() < _SLOW.get(rig, 0.0):
        settings += slow_servos(rig, random.randrange(2))
    if not fast and random.random() < _SEVERAL_WRITES:
        settings += several_writes(rig)
    return settings + drawn_sky(random, rig)


def _drawn_command(
    random: Random, word: str, places: list[SetTarget], loops: tuple[str, ...]
) -> AnyCommand | None:
    command = _COMMANDS[word](random)
    if places and isinstance(command, SetTarget):
        command = random.choice(places)
    if command is not None and random.random() < _OF_ONE_LOOP:
        command = msgspec.structs.replace(command, loop=random.choice(loops))
    return command


def _strike(random: Random, at_s: float, devices: list[str], faults: list[str]) -> list[Happening]:
    device, fault = random.choice(devices), random.choice(faults)
    wrong = WRONG.get(kind_of(device), ())
    if wrong and random.random() < _WRONG:
        fault = random.choice(wrong)
    if fault == "power cut" and not device.endswith("siderostat"):
        fault = "reset"  # only encoders forget anything
    size = drawn_slowness(random) if fault == "slow" else 0.0
    if kind_of(device) == "piezo" and fault == "stuck":
        size = float(random.randrange(3))
    return [
        Strike(
            at_s=at_s,
            device=device,
            fault=fault,
            lasts_s=0.0 if fault in AT_ONCE else 10 ** random.uniform(-2.0, 1.0),
            size=size,
        )
    ]


def _interrupted_slew(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """A loop lets its star go and searches far away; its amplifiers fail, or the computer stalls, meanwhile."""
    loop, who = random.choice(loops), OPERATORS[0]
    far = msgspec.structs.replace(_far_search(random), loop=loop)
    fault = "slow" if random.random() < _SLOW_SLEW else random.choice(FAULTS)
    struck_s = at_s + 0.1 + random.uniform(0.0, _SLEW_S)
    failing = _strike(random, struck_s, [f"{loop} siderostat"], [fault])
    stall = _stall(random, struck_s + random.uniform(0.0, _MEETS_S))
    return [
        Order(at_s=at_s, who=who, command=Release(loop=loop)),
        Order(at_s=at_s + 0.1, who=who, command=far),
        *failing,
        *random.choice(([], stall)),
    ]


def _disturbed_rest(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """A loop without its star is moved, and at once `off` comes several times, or the machine stalls long.

    Its piezo amplifier may be silent meanwhile.
    """
    loop, who = random.choice(loops), OPERATORS[0]
    moves = (_COMMANDS["jog"](random), _COMMANDS["bias-offset"](random))
    moved_s = at_s + random.uniform(0.2, 2.0)
    meets_s = moved_s + random.uniform(0.0, _MEETS_S)
    given = [(at_s, Release()), (moved_s, random.choice(moves))]
    others: list[Happening] = []
    if random.random() < _LONG_STALL:
        others.append(Stall(at_s=meets_s + random.uniform(0.0, 1.0), lasts_s=random.uniform(1, 3)))
    else:
        for _ in range(random.randint(1, 5)):
            given.append((meets_s, Off()))
            meets_s += random.expovariate(1 / _AT_ONCE_S)
    if loop != "metrology" and random.random() < _SILENT:
        lasts_s = random.uniform(1, 8)
        others.append(Strike(at_s=at_s, device=f"{loop} piezo", fault="mute", lasts_s=lasts_s))
    orders = [
        Order(at_s=given_s, who=who, command=msgspec.structs.replace(command, loop=loop))
        for given_s, command in given
        if command is not None
    ]
    return [*orders, *others]


def _met_experiment(
    random: Random, at_s: float, loops: list[str], devices: list[str], faults: list[str]
) -> list[Happening]:
    """An experiment with one loop, and what comes meanwhile: a command, a fault or a stall."""
    loop, who = random.choice(loops), OPERATORS[0]
    experiment = msgspec.structs.replace(drawn_experiment(random), loop=loop)
    meets_s = at_s + 10 ** random.uniform(-2.0, 1.0)
    what = random.choice((*_MEETS_EXPERIMENT, "fault", "stall"))
    if what == "fault":
        meets = _strike(random, meets_s, devices, faults)
    elif what == "stall":
        meets = _stall(random, meets_s)
    else:
        command = _drawn_command(random, what, [], (loop,))
        meets = [Order(at_s=meets_s, who=who, command=command)]
    return [
        Order(at_s=at_s - 0.1, who=who, command=TakeOver()),
        Order(at_s=at_s, who=who, command=experiment),
        *meets,
    ]


def _moved_collector(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """The collector is referenced and started, and stopped soon after, or at once."""
    who, begins_s = OPERATORS[0], at_s + _REFERENCED_S
    delay_s = random.expovariate(1 / _BURST_S) if random.random() < _BURST else random.uniform(0, 5)
    stops = (MoveCollector(action="stop"), Stop(), Stop(loop=random.choice(loops)))
    return [
        Order(at_s=at_s, who=who, command=MoveCollector(action="reference")),
        *([Order(at_s=at_s, who=who, command=Stop())] if random.random() < _BURST else []),
        Order(at_s=begins_s, who=who, command=MoveCollector(action="start")),
        Order(at_s=begins_s + delay_s, who=who, command=random.choice(stops)),
    ]


def _stall(random: Random, at_s: float) -> list[Happening]:
    return [Stall(at_s=at_s, lasts_s=10 ** random.uniform(-2.5, 0.5))]


def _kill(random: Random, at_s: float) -> list[Happening]:
    return [Kill(at_s=at_s, back_after_s=10 ** random.uniform(-1.0, 0.7))]


def _cloud(random: Random, at_s: float) -> list[Happening]:
    return [Cloud(at_s=at_s, lasts_s=10 ** random.uniform(-1.0, 1.8), part=random.random() ** 2)]


def _recorder_death(random: Random, at_s: float) -> list[Happening]:
    return [RecorderDeath(at_s=at_s)]


def _full_disk(random: Random, at_s: float) -> list[Happening]:
    return [FullDisk(at_s=at_s, lasts_s=10 ** random.uniform(0.0, 1.3))]


def _clock_step(random: Random, at_s: float) -> list[Happening]:
    return [ClockStep(at_s=at_s, by_s=random.uniform(-2.0, 2.0))]


def _sequence(random: Random, at_s: float) -> list[Happening]:
    steps = [random.choice(_STEPS) for _ in range(random.randint(1, 4))]
    return [Sequence(at_s=at_s, who=random.choice(OPERATORS), steps=steps)]
