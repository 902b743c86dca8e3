"""What happens in one run, drawn from a seed before the run begins, so that parts of it can be left out."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from random import Random

import msgspec

from benchmarks.swarm.commands import (
    COMMANDS,
    drawn_experiment,
    drawn_report,
    drawn_target,
    far_search,
)
from benchmarks.swarm.happenings import (
    AT_ONCE,
    RESTARTS,
    ClockStep,
    Cloud,
    FullDisk,
    Happening,
    Kill,
    Order,
    Plan,
    RecorderDeath,
    RecorderStuck,
    Sequence,
    Stall,
    Strike,
    kind_of,
)
from benchmarks.swarm.lines import FAULTS, OF_SOME_CALLS, WRONG, drawn_slowness
from benchmarks.swarm.rigs import FAST, RIGS, devices_of, drawn_settings, learning, stars_of
from fitctl.messages.commands import (
    AnyCommand,
    Jog,
    MoveCollector,
    Off,
    Release,
    SequenceControl,
    SetTarget,
    Stop,
    TakeOver,
)

DURATION_S, FAST_DURATION_S = 120.0, 40.0
_RIG_WEIGHTS = (8, 3, 2, 3, 3)
OPERATORS = ("ada", "ben", "cleo", "dora")
_OF_ONE_LOOP = 0.3  # fraction of commands that name a loop
_WITHOUT_FAULTS = 0.15  # fraction of runs without device faults
# Fraction of calm runs, whose loops hold their stars between happenings: with several loops, few others do so.
# How often something happens then, and which fraction of it are faults and the like.
_CALM, _CALM_OF_SEVERAL, _CALM_EVERY_S, _CALM_FAULTS = 0.2, 0.6, (8.0, 25.0), 0.8
_CONSOLE_SLOW = 0.2  # fraction of runs whose console misses messages
_REMOTE = 0.1  # fraction of runs with remote consoles: decoding takes a fifth of their time
# Of sequences. Each of them begins at a star that is held, or is refused.
_STEPS = (
    "standby",
    "acquire",
    "hold",
    "stars",
    "wait",
    "dither",
    "raster",
    "offset",
    "controller",
    "off",
)
# Fractions of sequences: for one loop; of a viewer, too, who is refused.
_OF_A_LOOP, _OF_ANYBODY = 0.9, 0.1
_MET_SEQUENCES = 0.2  # fraction of runs with sequences that are met by something while they wait,
_MET_AFTER_S = 3.0, 12.0  # and how long after it began
_CALIBRATING = ("experiment", "chirp", "plate_scale", "standby dark")
_OF_TESTBED = (
    "reference collector",
    "reference collector_scan",
    "beam_scan",
    "beam_standby ambient",
    "visibility",
    "overlap",
)
# Fraction of commands that are repeated, drawn for each run, and the mean delay: a key held down.
_REPEATED, _REPEATED_S = (0.0, 0.1, 0.6), 0.02
_PLACES, _FEW_PLACES = 3, 0.5  # fraction of runs whose targets are only so many places
_LATE_FRAMES = 0.2  # fraction of interrupted slews that late frames meet
_SLOW_SLEW = 0.4  # of the others, fraction on a slow line,
_BRIEFLY = 0.5  # and of these, fraction of lines that are slow for a moment
_KILLED_SEARCHES = 0.1  # fraction of runs with searches in which the supervisor is killed
_HELD_S, _HIDDEN_S = (10.0, 40.0), (30.0, 80.0)  # when clouds come then, and how long they last
_SLEW_S = 1.5  # a slew is interrupted within this time of its beginning,
_MEETS_S = 0.1  # and a stall follows within this
_WRONG = 0.25  # fraction of strikes with wrong values, on devices that can have some
_AT_TIMES, _LASTS_LONGER = 0.3, 5.0  # fraction of faults that meet only some calls, and last longer
_BOOTS = 0.5  # fraction of restarts that take time,
_BOOT_S = -1.0, 1.0  # powers of ten of how long
_ONCE, _LAST_CALL = 0.3, 40  # fraction of these that meet a single call, one of the next so many
_WRONG_RAD = -1.5, 0.7  # powers of ten of what an encoder is wrong by
_PARTS = {("piezo", "stuck"): 3, ("photodiodes", "loose"): 4}  # one of so many fails
_AT_ONCE_S = 0.004  # mean delay between hurried commands
_ALONE = 0.3  # fraction of stalls in which the other processes go on
_LONG_STALL, _SILENT = 0.3, 0.5  # fractions of disturbed rests
_LEARNER, _LEARNS = 0.4, 0.5  # fraction of runs with a learner, and of these, with `learn = "on"`
_REPORTS_S = 5.0  # mean time between a learner's reports
_EXPERIMENTS = 0.4  # fraction of runs with faults in which experiments are met by something
_OFF_BIAS = 0.5  # fraction of these that begin soon after another target
_TO_THE_END = 0.1  # fraction of runs in which a siderostat is jogged to the end of its travel
_JOG_ARCSEC, _JOGS = 100.0, 14  # each, and so many
_COLLECTOR = 0.4  # fraction of the testbed's runs in which its collector is moved on purpose
_LOOP_FAILS = 0.3  # fraction of these in which a loop fails, in place of a stop
_LOOSE = 0.4  # fraction of the testbed's runs in which photodiodes come loose,
_LOOSE_S = 0.2, 3.0  # and for how long
_REFERENCED_S = 7.0  # until a reference move has ended
# Fraction of the testbed's runs in which something meets the loop that waits for its link; which loop that is,
# and how long the link is away.
_AWAY, _WAITS, _AWAY_S = 0.5, "left", (0.5, 8.0)
_BURST, _BURST_S = 0.4, 0.05  # fraction of happenings that follow another at once, and mean delay
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
"""Commands that come while an experiment is under way; see `COMMANDS`."""
_MEETS_WAITING = (*_MEETS_EXPERIMENT, "jog", "bias-offset", "standby", "recover", "stall", "kill")


def plan_of(seed: int) -> Plan:
    """The plan that a seed gives."""
    random = Random(seed)  # noqa: S311 - a repeatable draw
    rig = random.choices(list(RIGS), _RIG_WEIGHTS)[0]
    return drawn_plan(random, seed, rig)


def drawn_plan(random: Random, seed: int, rig: str) -> Plan:
    """A plan for a rig.

    Each run draws a few kinds of faults and commands, leaves out the others, and has its own pace. A defect
    that many faults at once would hide shows in a run that has few of them. In calm runs, happenings and the
    faults that last meet loops that hold their stars.
    """
    loops = RIGS[rig]
    fast = random.random() < FAST.get(rig, 0.0)
    duration_s = FAST_DURATION_S if fast else DURATION_S
    words = random.sample(list(COMMANDS), random.randint(1, len(COMMANDS)))
    strikes = _drawn_strikes(random, rig)
    every_s, fault_part = 10 ** random.uniform(-0.3, 1.0), random.uniform(0.05, 0.6)
    attend_s = 10 ** random.uniform(0.0, 1.3)
    if random.random() < (_CALM_OF_SEVERAL if len(loops) > 1 else _CALM):
        every_s, fault_part, attend_s = random.uniform(*_CALM_EVERY_S), _CALM_FAULTS, 1.0
    # The service refuses commands from operators without the lease.
    people = OPERATORS[: random.randint(1, len(OPERATORS))]
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
    settings = drawn_settings(random, rig, duration_s, fast=fast)
    if random.random() < _LEARNER:
        happenings += _learner(random, duration_s, stars_of(rig))
        settings += learning(rig) if random.random() < _LEARNS else []
    if random.random() < _KILLED_SEARCHES:
        happenings += _killed_search(random, random.uniform(*_HELD_S))
    if "metrology" in loops and random.random() < _LOOSE:
        happenings += _loose_photodiode(random, duration_s)
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
    kinds = (*RESTARTS, *FAULTS)
    faults = random.sample(kinds, random.randint(1, len(kinds)))
    struck = random.sample(devices, random.randint(1, len(devices)))
    strikes: list[Callable[[Random, float], list[Happening]]] = []
    for make, part in (
        (_stall, 0.4),
        (_kill, 0.3),
        (_cloud, 0.3),
        (_recorder_death, 0.2),
        (_recorder_stuck, 0.2),
        (_full_disk, 0.2),
        (_clock_step, 0.2),
        (partial(_sequence, loops=loops), 0.3),
    ):
        strikes += [make] * (random.random() < part)
    if random.random() >= _WITHOUT_FAULTS:
        strikes += [partial(_strike, devices=struck, faults=faults)] * random.randint(1, 6)
        strikes += [partial(_interrupted_slew, loops=loops)] * random.randint(0, 4)
        strikes += [partial(_disturbed_rest, loops=loops)] * random.randint(0, 2)
        if random.random() < _EXPERIMENTS:
            met = partial(_met_experiment, loops=stars_of(rig), devices=struck, faults=faults)
            strikes += [met] * random.randint(1, 3)
    if random.random() < _MET_SEQUENCES:
        strikes.append(partial(_met_sequence, loops=loops))
    if random.random() < _TO_THE_END:
        strikes.append(partial(_jogged_to_the_end, loops=loops))
    if "metrology" in loops and random.random() < _COLLECTOR:
        strikes += [partial(_moved_collector, loops=loops)] * random.randint(1, 2)
    if "metrology" in loops and random.random() < _AWAY:
        strikes += [_met_waiting] * random.randint(1, 3)
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


def _drawn_command(
    random: Random, word: str, places: list[SetTarget], loops: tuple[str, ...]
) -> AnyCommand | None:
    command = COMMANDS[word](random)
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
    size = _drawn_size(random, device, fault)
    at_times = fault in OF_SOME_CALLS and random.random() < _AT_TIMES
    once = at_times and random.random() < _ONCE
    lasts_s = 10 ** random.uniform(-2.0, 1.0)
    struck: list[Happening] = [
        Strike(
            at_s=at_s,
            device=device,
            fault=fault,
            lasts_s=0.0 if fault in AT_ONCE else lasts_s * (_LASTS_LONGER if at_times else 1.0),
            size=size,
            part=10 ** random.uniform(-2.5, -0.1) if at_times and not once else 1.0,
            number=random.randint(1, _LAST_CALL) if once else 0,
        )
    ]
    if fault in RESTARTS and random.random() < _BOOTS:
        boot = Strike(
            at_s=at_s,
            device=device,
            fault=random.choice(("unplugged", "deaf")),
            lasts_s=10 ** random.uniform(*_BOOT_S),
        )
        struck.append(boot)
    return struck


def _drawn_size(random: Random, device: str, fault: str) -> float:
    """How slow, which stack or photodiode, or by how much an encoder is wrong."""
    if fault == "slow":
        return drawn_slowness(random)
    if fault == "encoder":
        return random.choice((-1, 1)) * 10 ** random.uniform(*_WRONG_RAD)
    parts = _PARTS.get((kind_of(device), fault))
    return 0.0 if parts is None else float(random.randrange(parts))


def _interrupted_slew(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """A loop lets its star go and searches far away.

    Meanwhile its amplifiers fail, the computer stalls, or frames come late, which may hold the stages.
    """
    loop, who = random.choice(loops), OPERATORS[0]
    far = msgspec.structs.replace(far_search(random), loop=loop)
    sent = [
        Order(at_s=at_s, who=who, command=Release(loop=loop)),
        Order(at_s=at_s + 0.1, who=who, command=far),
    ]
    if random.random() < _LATE_FRAMES:
        size, lasts_s = random.uniform(20.0, 60.0), random.uniform(0.5, 4.0)
        late = Strike(at_s=at_s, device="camera", fault="slow", size=size, lasts_s=lasts_s)
        return [*sent, late]
    fault = "slow" if random.random() < _SLOW_SLEW else random.choice(FAULTS)
    struck_s = at_s + 0.1 + random.uniform(0.0, _SLEW_S)
    failing = _strike(random, struck_s, [f"{loop} siderostat"], [fault])
    stall = _stall(random, struck_s + random.uniform(0.0, _MEETS_S))
    if fault == "slow" and random.random() < _BRIEFLY:  # readings come late while motors turn on
        failing = [msgspec.structs.replace(failing[0], lasts_s=random.uniform(0.05, 0.5))]
        stall = [Stall(at_s=struck_s, lasts_s=random.uniform(0.02, 0.2))]
    return [*sent, *failing, *random.choice(([], stall))]


def _killed_search(random: Random, at_s: float) -> list[Happening]:
    """Clouds hide the stars for long, and in the search for them the supervisor is killed, up to four times."""
    who, lasts_s = OPERATORS[0], random.uniform(*_HIDDEN_S)
    happenings: list[Happening] = [Cloud(at_s=at_s, lasts_s=lasts_s, part=0.0)]
    for _ in range(random.randint(1, 4)):
        killed_s = at_s + lasts_s * random.uniform(0.3, 1.0)
        happenings.append(Kill(at_s=killed_s, back_after_s=0.1))
        happenings += [Order(at_s=killed_s + later_s, who=who) for later_s in (0.5, 2.0, 3.0)]
    return happenings


def _disturbed_rest(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """A loop without its star is moved, and at once `off` comes several times, or the machine stalls long.

    Its piezo amplifier may be silent meanwhile.
    """
    loop, who = random.choice(loops), OPERATORS[0]
    moves = (COMMANDS["jog"](random), COMMANDS["bias-offset"](random))
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


def _jogged_to_the_end(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """A loop lets its star go, and its siderostat is jogged in one direction to the end of its travel."""
    loop, who = random.choice(loops), OPERATORS[0]
    az_arcsec, el_arcsec = (random.choice((-1, 0, 1)) * _JOG_ARCSEC for _ in range(2))
    jog = Jog(loop=loop, az_sky_arcsec=az_arcsec, el_sky_arcsec=el_arcsec)
    return [
        Order(at_s=at_s, who=who, command=Release(loop=loop)),
        *[Order(at_s=at_s + 0.2 * (1 + number), who=who, command=jog) for number in range(_JOGS)],
    ]


def _met_experiment(
    random: Random, at_s: float, loops: list[str], devices: list[str], faults: list[str]
) -> list[Happening]:
    """An experiment with one loop, and what comes meanwhile: a command, a fault or a stall.

    Some begin while the mirror takes the star to another target.
    """
    loop, who = random.choice(loops), OPERATORS[0]
    target = msgspec.structs.replace(drawn_target(random), loop=loop)
    moved_s = at_s - random.uniform(0.1, 1.0)
    moves = [Order(at_s=moved_s, who=who, command=target)] * (random.random() < _OFF_BIAS)
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
        Order(at_s=moved_s - 0.1, who=who, command=TakeOver()),
        *moves,
        Order(at_s=at_s, who=who, command=experiment),
        *meets,
    ]


def _met_waiting(random: Random, at_s: float) -> list[Happening]:
    """The link is away for a while, and something meets the loop that waits for it.

    That is up to three commands, most of them experiments, a stall, or a kill of the supervisor.
    """
    who, lasts_s = OPERATORS[0], random.uniform(*_AWAY_S)
    device = random.choice(("metrology photodiodes", "metrology siderostat"))
    gone = (
        Strike(at_s=at_s, device=device, fault=random.choice(FAULTS[1:]), lasts_s=lasts_s),
        Order(at_s=at_s, who=who, command=Release(loop="metrology")),
    )
    happenings: list[Happening] = [
        Order(at_s=at_s, who=who, command=TakeOver()),
        random.choice(gone),
    ]
    for _ in range(random.randint(1, 3)):
        meets_s = at_s + random.uniform(0.0, lasts_s)
        what = random.choice(("experiment", random.choice(_MEETS_WAITING)))
        if what == "stall":
            happenings += _stall(random, meets_s)
        elif what == "kill":
            happenings += _kill(random, meets_s)
        else:
            command = COMMANDS[what](random)
            if command is not None:
                command = msgspec.structs.replace(command, loop=_WAITS)
            happenings.append(Order(at_s=meets_s, who=who, command=command))
    return happenings


def _moved_collector(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """The collector is referenced and started, and stopped soon after or at once, or a loop fails meanwhile."""
    who, begins_s = OPERATORS[0], at_s + _REFERENCED_S
    delay_s = random.expovariate(1 / _BURST_S) if random.random() < _BURST else random.uniform(0, 5)
    stops = (MoveCollector(action="stop"), Stop(), Stop(loop=random.choice(loops)))
    ends: Happening = Order(at_s=begins_s + delay_s, who=who, command=random.choice(stops))
    if random.random() < _LOOP_FAILS:
        failing = f"{random.choice(loops)} siderostat"
        ends = Strike(at_s=begins_s + delay_s, device=failing, fault="trip")
    return [
        Order(at_s=at_s, who=who, command=MoveCollector(action="reference")),
        *([Order(at_s=at_s, who=who, command=Stop())] if random.random() < _BURST else []),
        Order(at_s=begins_s, who=who, command=MoveCollector(action="start")),
        ends,
    ]


def _loose_photodiode(random: Random, duration_s: float) -> list[Happening]:
    """A photodiode comes loose up to four times, each for so long that the beam is pulled in again."""
    return [
        Strike(
            at_s=random.uniform(_HELD_S[0], duration_s),
            device="metrology photodiodes",
            fault="loose",
            lasts_s=random.uniform(*_LOOSE_S),
            size=_drawn_size(random, "metrology photodiodes", "loose"),
        )
        for _ in range(random.randint(1, 4))
    ]


def _stall(random: Random, at_s: float) -> list[Happening]:
    lasts_s, alone = 10 ** random.uniform(-2.5, 0.5), random.random() < _ALONE
    return [Stall(at_s=at_s, lasts_s=lasts_s, alone=alone)]


def _kill(random: Random, at_s: float) -> list[Happening]:
    return [Kill(at_s=at_s, back_after_s=10 ** random.uniform(-1.0, 0.7))]


def _cloud(random: Random, at_s: float) -> list[Happening]:
    return [Cloud(at_s=at_s, lasts_s=10 ** random.uniform(-1.0, 1.8), part=random.random() ** 2)]


def _recorder_death(random: Random, at_s: float) -> list[Happening]:
    return [RecorderDeath(at_s=at_s)]


def _recorder_stuck(random: Random, at_s: float) -> list[Happening]:
    return [RecorderStuck(at_s=at_s, lasts_s=10 ** random.uniform(-1.0, 1.3))]


def _full_disk(random: Random, at_s: float) -> list[Happening]:
    return [FullDisk(at_s=at_s, lasts_s=10 ** random.uniform(0.0, 1.3))]


def _clock_step(random: Random, at_s: float) -> list[Happening]:
    return [ClockStep(at_s=at_s, by_s=random.uniform(-2.0, 2.0))]


def _sequence(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """Of steps of all kinds; half of the sequences acquire first."""
    kinds = (_STEPS, _CALIBRATING, *((_OF_TESTBED,) if "metrology" in loops else ()))
    words = [random.choice(random.choice(kinds)) for _ in range(random.randint(1, 4))]
    steps = " ".join(random.choice(([], ["acquire"])) + words).split()
    # On a rig with several loops, most steps are for one of them.
    stars = [loop for loop in loops if loop != "metrology"]
    loop = random.choice(stars) if random.random() < _OF_A_LOOP else ""
    who = random.choice(OPERATORS if random.random() < _OF_ANYBODY else OPERATORS[:-1])
    return [Sequence(at_s=at_s, who=who, steps=steps, loop=loop)]


def _met_sequence(random: Random, at_s: float, loops: tuple[str, ...]) -> list[Happening]:
    """While a sequence waits, it is ordered to end, or one of the loops is stopped."""
    loop, who = random.choice(("", *loops)), random.choice(OPERATORS[:-1])
    ends = SequenceControl(action="end"), Stop(loop=random.choice(loops))
    return [
        Sequence(at_s=at_s, who=who, steps=["standby", "wait"], loop=loop),
        Order(at_s=at_s + random.uniform(*_MET_AFTER_S), who=who, command=random.choice(ends)),
    ]
