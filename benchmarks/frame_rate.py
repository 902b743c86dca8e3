"""What a short change of the frame rate shows of lines, and what a loop leaves that makes it by itself.

Nights of one to three lines are drawn, each line slow or the alias of a slow one, and held by the linear loop
at 50 Hz and then at the rate that a learner asks for. Printed: how many lines are classified rightly, wrongly,
or not at all. Then the whole instrument holds its star on the virtual clock, on those nights of
:mod:`benchmarks.learn_online` whose lines are slow. True residual in continuous time, of the worst axis.
"""

from __future__ import annotations

import os

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as fitctl itself has it

import argparse
import dataclasses
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from random import Random

import numpy as np

from benchmarks.learn import LOOP
from benchmarks.learn_online import BEGIN_S, CONTROLLER, END_S, NIGHTS, Night, bound_px
from benchmarks.linear_loop import held
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Line, basis
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.learn.frame_rates import SAME_LINE_HZ, AtOtherRate, classify, classifying_rate
from fitctl.learn.night import estimate
from fitctl.learn.opened import periodograms
from fitctl.logging.records import CAMERA, AnyRecord, Event
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import true_residual_rms
from fitctl.supervisor.frame_rate import FOR_LEARNER_S

_SLOW = ("6 Hz, 0.05 px", "6 Hz, 0.05 px, fit", "3.1, 8.7, 14 Hz, 0.02 px")
SLOW_NIGHTS = [night for night in NIGHTS if night.name in _SLOW]
_LEAST_HZ, _MOST_HZ = 1.5, 20.0
_MARGIN_S = 1.0  # of the other rate, at its ends


def classified(number: int, seed: int) -> Counter[str]:
    """How many lines of a drawn night are classified rightly, wrongly, or not."""
    random = Random(f"{seed}-{number}")  # noqa: S311 - a repeatable draw
    paper = basis(load_rig(default_rig_path()), LOOP)
    lines, is_alias = [], {}
    for _ in range(random.choice((1, 2, 3))):
        seen_hz, alias = random.uniform(_LEAST_HZ, _MOST_HZ), random.random() < 0.5
        rate_hz = 1 / paper.period_s
        hz = random.choice((rate_hz - seen_hz, rate_hz + seen_hz)) if alias else seen_hz
        damping = random.choice((0.0005, 0.002, 0.005)) * seen_hz / hz
        lines.append(Line(hz, damping, random.uniform(0.008, 0.06)))
        is_alias[seen_hz] = alias
    truth = dataclasses.replace(paper, lines=tuple(lines))
    gain, overshoot = random.choice((1.0, 0.85, 0.7)), random.choice((0.0, 0.08))
    other_overshoot = overshoot + random.uniform(-0.1, 0.1)
    fixed = design_minimum_variance(paper)
    usual_s = random.choice((60.0, 120.0))
    _, usual = held(truth, fixed, usual_s, 2 * number, mirror_gain=gain, overshoot=overshoot)
    opened = periodograms([usual], paper.period_s)
    if opened is None:
        return Counter()
    night = estimate(opened, paper.air_path, paper.noise_px)
    found_hz = [line.frequency_hz.value for line in night.lines]
    if not found_hz:
        return Counter()
    slower = dataclasses.replace(truth, period_s=1 / classifying_rate(found_hz, 1 / paper.period_s))
    other_s = FOR_LEARNER_S - _MARGIN_S
    _, other = held(
        slower, fixed, other_s, 2 * number + 1, mirror_gain=gain, overshoot=other_overshoot
    )
    shown = AtOtherRate(slower.period_s, [other])
    answers = {
        one.frequency_hz: one.is_alias for one in classify(opened, night, night.lines, [], [shown])
    }
    counted: Counter[str] = Counter()
    for hz in found_hz:
        may_be = {alias for seen, alias in is_alias.items() if abs(seen - hz) <= SAME_LINE_HZ}
        if hz not in answers:
            counted["not"] += 1
        elif may_be:
            counted["rightly" if answers[hz] in may_be else "wrongly"] += 1
        else:
            counted["of a line that is none"] += 1
    return counted


def left(night: Night, seed: int) -> tuple[float, int]:
    """What a loop leaves of a night, px, and how often the camera ran at another rate."""
    rig = load_rig(
        default_rig_path(), [CONTROLLER, *night.known, *night.unknown, f"loops.{LOOP}.learn=on"]
    )
    events: list[Event] = []

    def keep(record: AnyRecord) -> None:
        if isinstance(record, Event) and record.source == CAMERA:
            events.append(record)

    simulation = Simulation(rig, seed, record=keep, history_s=END_S)
    simulation.acquire()
    simulation.run(END_S - simulation.clock.now_s())
    target = rig.stellar_loops[LOOP].target_px
    target_px = np.array([target.az, target.el])
    left_px = true_residual_rms(simulation.plants[LOOP], target_px, BEGIN_S, END_S)
    return float(left_px.max()), len(events) // 2


def main() -> None:
    """Print both."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--drawn", type=int, default=320)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0, help="of the drawn nights")
    parser.add_argument("--processes", type=int, default=os.cpu_count())
    arguments = parser.parse_args()
    with ProcessPoolExecutor(arguments.processes) as pool:
        counted: Counter[str] = Counter()
        for one in pool.map(partial(classified, seed=arguments.seed), range(arguments.drawn)):
            counted += one
        print(f"{arguments.drawn} drawn nights, lines classified: {dict(counted)}", flush=True)
        print("night | px | bound px | over bound: median, worst | other rates")
        for night in SLOW_NIGHTS:
            ends = list(pool.map(partial(left, night), range(arguments.seeds)))
            if not ends:
                continue
            px, least_px = np.array([px for px, _ in ends]), bound_px(night)
            print(
                f"{night.name} | {px.mean():.4f} | {least_px:.4f} | {np.median(px) / least_px:.3f}, "
                f"{px.max() / least_px:.3f} | {sum(times for _, times in ends)}",
                flush=True,
            )


if __name__ == "__main__":
    main()
