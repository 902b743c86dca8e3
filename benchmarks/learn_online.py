"""What a loop leaves that learns while it observes, on nights that its rig file does not know.

For each night and seed, two runs of the whole instrument in the compiled batch: with the rig's
minimum-variance design throughout, and with `learn = "on"`. Both see the same air and the same lines. True
residual in continuous time, of the worst axis, from 120 s after the beginning on. Beside them the bound of the
night, which knows everything about it. With `--random`, nights are drawn: see :func:`random_night`.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as fitctl itself has it

import argparse
import math
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from typing import NamedTuple

import numpy as np

from benchmarks.learn import AIR, FIT, LOOP, truth_of
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.learning import NO_CHANGES, Changes
from fitctl.simulation.batch.records import DONE

BEGIN_S, END_S = 120.0, 300.0
LIGHT = ("camera.electrons_per_dn=1.0",)
SMEAR = ("plant.exposure_instants=5",)
SIDEREAL = (
    f"loops.{LOOP}.star_rate_sky_arcsec_s={{az=12.0,el=-9.0}}",
    f"plant.loops.{LOOP}.star_rate_sky_arcsec_s={{az=12.0,el=-9.0}}",
    f"loops.{LOOP}.siderostat.travel_sky_arcsec=6000.0",  # as far as the star moves
    f"loops.{LOOP}.siderostat.device.position_limit_rad=0.0",
)
CONTROLLER = f"loops.{LOOP}.vernier.controller=minimum-variance"
_SUMS = ("true_sum2", "residual_steps")


def lines(*frequencies_hz: float, rms_px: float, damping: float = 0.005, drift: float = 0.0) -> str:
    """An override: lines that move both axes by `rms_px` each."""
    along = np.sqrt(2.0) * rms_px
    rows = ",".join(
        f"{{frequency_hz={hz},rms_px={along:.6f},direction_deg=45.0,damping={damping},"
        f"drift_hz_per_min={drift}}}"
        for hz in frequencies_hz
    )
    return f"plant.loops.{LOOP}.lines=[{rows}]"


def air_gains(*at_s_and_gain: tuple[float, float]) -> str:
    """An override: the air path's gain changes on the way."""
    rows = ",".join(
        f"{{at_s={at_s},loops={{{LOOP}={{air_path={{gain_px={gain},b1_s2=0.517,b2_s=2.5}}}}}}}}"
        for at_s, gain in at_s_and_gain
    )
    return f"plant.timeline=[{rows}]"


class Night(NamedTuple):
    """A night and its goal.

    Attributes
    ----------
    known, unknown : tuple of str
        What the rig file has of it and what it has not, as overrides.
    lines : tuple of Line
        Those of the bound.
    for_bound : tuple of str
        What else the bound knows.
    bounded : bool
        The night is one throughout, so that it has a bound; that of a drifting line is of where it begins.
    """

    name: str
    goal: str
    known: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    lines: tuple[Line, ...] = ()
    for_bound: tuple[str, ...] = ()
    bounded: bool = True


def shaken(*frequencies_hz: float, rms_px: float, damping: float = 0.005) -> tuple[Line, ...]:
    """Lines for the bound."""
    return tuple(Line(hz, damping, rms_px) for hz in frequencies_hz)


SIX = lines(6.0, rms_px=0.05)
THREE = lines(3.1, 8.7, 14.0, rms_px=0.02)
WRITES = f"loops.{LOOP}.fsm.dac.writes_per_frame={{}}"
NIGHTS = [
    Night("the paper's, centroid", "1.08"),
    Night("the paper's, fit", "1.05", FIT),
    Night("1 electron a DN, smear, centroid", "1.08", LIGHT, SMEAR),
    Night("1 electron a DN, smear, fit", "1.08", (*FIT, *LIGHT), SMEAR),
    Night("a star at the sidereal rate", "as the paper's, centroid", SIDEREAL),
    Night(
        "30 % hysteresis", "1.08", (), (f"plant.loops.{LOOP}.hysteresis.loop_width_fraction=0.3",)
    ),
    Night("b1_s2 0.1", "1.08", (), (f"{AIR}.b1_s2=0.1",)),
    Night("gain_px 0.9", "1.08", (), (f"{AIR}.gain_px=0.9",)),
    Night("gain_px 0.2", "1.08", (), (f"{AIR}.gain_px=0.2",)),
    Night(
        "noise 60 DN",
        "1.08",
        (),
        ("plant.timeline=[{at_s=0.5,pixel_noise_dn=60.0}]",),
        for_bound=("camera.pixel_noise_dn=60.0",),
    ),
    Night("6 Hz, 0.05 px", "1.15", (), (SIX,), shaken(6.0, rms_px=0.05)),
    Night("6 Hz, 0.05 px, fit", "1.15", FIT, (SIX,), shaken(6.0, rms_px=0.05)),
    Night(
        "3.1, 8.7, 14 Hz, 0.02 px",
        "1.15",
        (),
        (THREE,),
        shaken(3.1, 8.7, 14.0, rms_px=0.02),
    ),
    # The bound is that of one write, as in the rows above.
    Night(
        "6 Hz, 0.05 px, fit, 5 writes",
        "1.15",
        (*FIT, WRITES.format(5)),
        (SIX,),
        shaken(6.0, rms_px=0.05),
        (WRITES.format(1),),
    ),
    Night(
        "3.1, 8.7, 14 Hz, 0.02 px, 5 writes",
        "1.15",
        (WRITES.format(5),),
        (THREE,),
        shaken(3.1, 8.7, 14.0, rms_px=0.02),
        (WRITES.format(1),),
    ),
    Night(
        "48.9 Hz, 0.05 px",
        "5 % above fixed",
        (),
        (lines(48.9, rms_px=0.05, damping=0.0005),),
        shaken(48.9, rms_px=0.05, damping=0.0005),
    ),
    *(
        Night(
            f"{hz:g} Hz, {rms_px} px, {100 * width:.0f} % hysteresis",
            "5 % above fixed",
            (),
            (
                lines(hz, rms_px=rms_px, damping=0.0007),
                f"plant.loops.{LOOP}.hysteresis.loop_width_fraction={width}",
            ),
            shaken(hz, rms_px=rms_px, damping=0.0007),
        )
        for hz, rms_px in ((40.0, 0.02), (44.0, 0.05), (60.0, 0.02))
        for width in (0.19, 0.25)
    ),
    Night(
        "6 Hz, 0.05 px, drifts 0.05 Hz a minute",
        "2 % above fixed",
        (),
        (lines(6.0, rms_px=0.05, drift=0.05),),
        shaken(6.0, rms_px=0.05),
    ),
    Night(
        "air gain 0.45 to 0.9 within a minute",
        "2 % above fixed",
        (),
        (air_gains(*((150.0 + 10.0 * n, 0.45 + 0.075 * n) for n in range(1, 7))),),
        bounded=False,
    ),
]


class Outcome(NamedTuple):
    """One seed: residuals of the worst axis in px, and how often the design changed."""

    fixed_px: float
    learnt_px: float
    changes: int
    ways_back: int


def residual_px(batch: Batch, seed: int, changes: Changes) -> float:
    """Of a run with such changes."""
    runs = [batch.run(seed, end_s, changes=changes) for end_s in (BEGIN_S, END_S)]
    if any(run.ended != DONE for run in runs):
        msg = (
            f"seed {seed}: a run ended early ({[run.ended for run in runs]}), so it has no residual"
        )
        raise RuntimeError(msg)
    states = [run.loops[LOOP].state for run in runs]
    sums, steps = (np.diff([state[name] for state in states], axis=0)[0] for name in _SUMS)
    return float(np.sqrt(sums.max() / steps))


def outcome(night: Night, seed: int) -> Outcome:
    """Both runs of one seed."""
    settings = [CONTROLLER, *night.known, *night.unknown, f"loops.{LOOP}.learn=on"]
    batch = Batch(load_rig(default_rig_path(), settings))
    changes = batch.run(seed, END_S).changes
    return Outcome(
        residual_px(batch, seed, NO_CHANGES),
        residual_px(batch, seed, changes),
        len(changes.designs),
        sum(not change.design.learnt for change in changes.designs),
    )


def random_night(number: int) -> Night:
    """A night that no rig file has; the number says which.

    Drawn are the sensor, air path, hysteresis, pixel noise, up to three lines from 1 to 60 Hz, of which some
    drift, and in three of ten nights another air from some time on.
    """
    random = np.random.default_rng([18, number])

    def between(low: float, high: float) -> float:
        return float(np.exp(random.uniform(math.log(low), math.log(high))))

    known = FIT if random.random() < 0.5 else ()
    gain_px, b1_s2 = between(0.2, 0.9), between(0.1, 1.0)
    width, noise_dn = random.uniform(0.05, 0.3), between(10.0, 60.0)
    unknown = [
        f"{AIR}.gain_px={gain_px:.4f}",
        f"{AIR}.b1_s2={b1_s2:.4f}",
        f"plant.loops.{LOOP}.hysteresis.loop_width_fraction={width:.4f}",
    ]
    changes = [f"{{at_s=0.5,pixel_noise_dn={noise_dn:.2f}}}"]
    told = [f"{gain_px:.2f} px {b1_s2:.2f} s² {width:.0%} {noise_dn:.0f} DN"]
    rows, own = [], []
    drifts = False
    for _ in range(random.integers(0, 4)):
        hz, rms_px, damping = between(1.0, 60.0), between(0.005, 0.08), between(0.0005, 0.02)
        drift = random.uniform(-0.05, 0.05) if random.random() < 0.2 else 0.0
        drifts = drifts or drift != 0.0
        rows.append(
            f"{{frequency_hz={hz:.4f},rms_px={math.sqrt(2) * rms_px:.6f},direction_deg=45.0,"
            f"damping={damping:.6f},drift_hz_per_min={drift:.4f}}}"
        )
        own.append(Line(hz, damping, rms_px))
        told.append(f"{hz:.1f} Hz {rms_px:.3f} px")
    unknown.append(f"plant.loops.{LOOP}.lines=[{','.join(rows)}]")
    changing = random.random() < 0.3
    at_s, later_px = random.uniform(60.0, 250.0), between(0.2, 0.9)
    if changing:
        told.append(f"{later_px:.2f} px from {at_s:.0f} s on")
        changes.append(
            f"{{at_s={at_s:.1f},loops={{{LOOP}={{air_path={{gain_px={later_px:.4f},b1_s2={b1_s2:.4f},"
            f"b2_s=2.5}}}}}}}}"
        )
    unknown.append(f"plant.timeline=[{','.join(changes)}]")
    return Night(
        f"{number}: {'fit' if known else 'centroid'}; {'; '.join(told)}",
        "2 % above fixed",
        known,
        tuple(unknown),
        tuple(own),
        (f"camera.pixel_noise_dn={noise_dn:.2f}",),
        bounded=not (changing or drifts),
    )


def bound_px(night: Night) -> float:
    """Of one who knows the night."""
    rig = load_rig(default_rig_path(), [*night.known, *night.unknown, *night.for_bound])
    return bound(truth_of(rig, night.lines)).residual_px


def print_nights(nights: Sequence[Night], seeds: int, pool: ProcessPoolExecutor) -> None:
    """A row of a Markdown table for each night."""
    print(
        "| night | seeds | fixed px | learning px | bound px | learning over bound: median | 95 % | worst "
        "| over fixed, worst seed | goal | changes, of them back |"
    )
    print("| --- " * 11 + "|")
    for night in nights:
        found = list(pool.map(partial(outcome, night), range(seeds)))
        fixed_px, learnt_px = np.mean([one[:2] for one in found], axis=0)
        worst = max(one.learnt_px / one.fixed_px for one in found)
        least_px = bound_px(night)
        ratios = np.percentile([one.learnt_px / least_px for one in found], [50, 95, 100])
        beside = " | ".join([f"{least_px:.4f}", *(f"{one:.3f}" for one in ratios)])
        if not night.bounded:
            beside = "- | - | - | -"
        print(
            f"| {night.name} | {len(found)} | {fixed_px:.4f} | {learnt_px:.4f} | {beside} "
            f"| {worst:.3f} | {night.goal} "
            f"| {sum(one.changes for one in found)}, {sum(one.ways_back for one in found)} |",
            flush=True,
        )


def random_outcome(number: int) -> tuple[Night, Outcome, float]:
    """One random night: what came of it, and its bound, NaN for one that changes."""
    night = random_night(number)
    return night, outcome(night, number), bound_px(night) if night.bounded else math.nan


def print_random_nights(numbers: Sequence[int], pool: ProcessPoolExecutor) -> None:
    """A line for each night, then the distributions."""
    over_fixed, over_bound, fixed_over_bound = [], [], []
    for night, made, least_px in pool.map(random_outcome, numbers):
        over_fixed.append(made.learnt_px / made.fixed_px)
        if not math.isnan(least_px):
            over_bound.append(made.learnt_px / least_px)
            fixed_over_bound.append(made.fixed_px / least_px)
        print(
            f"{over_fixed[-1]:.3f} of fixed {made.fixed_px:.4f} px, bound {least_px:.4f}, "
            f"{made.changes} changes, {made.ways_back} back; {night.name}",
            flush=True,
        )
    worse = sum(ratio > 1.02 for ratio in over_fixed)
    print(f"\n{len(over_fixed)} nights; worse than the fixed design by more than 2 %: {worse}\n")
    print("| | nights | least | 5 % | median | 95 % | most |")
    print("| --- " * 7 + "|")
    for name, ratios in (
        ("learning over fixed", over_fixed),
        ("learning over bound", over_bound),
        ("fixed over bound", fixed_over_bound),
    ):
        if ratios:
            five = np.percentile(ratios, [0, 5, 50, 95, 100])
            print(f"| {name} | {len(ratios)} | {' | '.join(f'{one:.3f}' for one in five)} |")


def main() -> None:
    """Print what the nights that were asked for leave."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=5)
    parser.add_argument("--nights", default="", help="only those whose name holds this")
    parser.add_argument("--random", type=int, default=0, help="so many random nights instead")
    parser.add_argument("--seed", type=int, default=0, help="the number of the first random night")
    parser.add_argument("--processes", type=int, default=2)
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.processes) as pool:
        if arguments.random:
            first = arguments.seed
            print_random_nights(range(first, first + arguments.random), pool)
        else:
            chosen = [night for night in NIGHTS if arguments.nights in night.name]
            print_nights(chosen, arguments.seeds, pool)


if __name__ == "__main__":
    main()
