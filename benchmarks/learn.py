"""How near the bound a learnt design comes, on nights that its rig file does not know.

For each night and seed, the rig's own minimum-variance design holds the star for two minutes, the night is
estimated from the ticks, and the learnt design holds it. `model` nights are runs of the compiled batch:
the whole nonlinear plant, true residual in continuous time, of the worst axis. `linear` nights have lines,
on stages that do exactly as commanded; residuals are exact. Beside them: how many of the 95 % intervals
hold the truth, how many lines were found, false ones too, and how often the test of fit objects.
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.linear_loop import held
from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.controllers.design.basis import Basis, Line, basis, with_plants_air
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.spectrum import air_of
from fitctl.controllers.design.minimum_variance import design_minimum_variance
from fitctl.controllers.design.theory import loop_theory
from fitctl.controllers.pair import Design
from fitctl.error_budget import pieces_of
from fitctl.learn.advice import Advice, advise
from fitctl.learn.opened import rebuild
from fitctl.messages.modes import Mode
from fitctl.simulation.batch.batch import Batch, LoopRun
from fitctl.simulation.statistics import SETTLE_S

LOOP = "right"
FOUND_S = 15.0  # until the star is held, at most
HELD_S = 120.0
FIT = ("loops.right.sensor=fit",)
AIR = "plant.loops.right.air_path"
NEAR_HZ = 0.3  # so far from a true line, a line is that one


def lines(*frequencies_hz: float, rms_px: float) -> tuple[Line, ...]:
    """Lines of 0.5 % damping."""
    return tuple(Line(hz, 0.005, rms_px) for hz in frequencies_hz)


class Night(NamedTuple):
    """A night and its goal.

    Attributes
    ----------
    known : tuple of str
        What the rig file knows of it, as overrides.
    unknown : tuple of str
        And what it does not.
    lines : tuple of Line
        With any, the night is linear.
    """

    name: str
    goal: str
    known: tuple[str, ...] = ()
    unknown: tuple[str, ...] = ()
    lines: tuple[Line, ...] = ()


NIGHTS = [
    Night("the paper's", "1.08"),
    Night("the paper's, fit", "1.05", FIT),
    Night("30 % hysteresis", "1.08", (), ("plant.loops.right.hysteresis.loop_width_fraction=0.3",)),
    Night("b1_s2 0.1", "1.08", (), (f"{AIR}.b1_s2=0.1",)),
    Night("gain_px 0.9", "1.08", (), (f"{AIR}.gain_px=0.9",)),
    Night("gain_px 0.2", "1.08", (), (f"{AIR}.gain_px=0.2",)),
    Night("noise 60 DN", "1.08", (), ("camera.pixel_noise_dn=60.0",)),
    Night("6 Hz, 0.05 px", "1.15", lines=lines(6.0, rms_px=0.05)),
    Night("6 Hz, 0.05 px, fit", "1.15", FIT, lines=lines(6.0, rms_px=0.05)),
    Night("3.1, 8.7, 14 Hz, 0.02 px", "1.15", lines=lines(3.1, 8.7, 14.0, rms_px=0.02)),
    Night("48.9 Hz, 0.05 px", "5 % above fixed", lines=(Line(48.9, 0.0005, 0.05),)),
]


class Outcome(NamedTuple):
    """One seed of one night: residuals in px, and intervals that held the truth, of how many."""

    fixed_px: float
    learnt_px: float
    bound_px: float
    held: int
    intervals: int
    found: int
    false: int
    fits: bool


def truth_of(rig: Rig, shaken: tuple[Line, ...]) -> Basis:
    """What an omniscient designer would know."""
    return dataclasses.replace(with_plants_air(basis(rig, LOOP), rig, LOOP), lines=shaken)


def ticks_of(run: LoopRun, step_s: float) -> dict[str, np.ndarray]:
    """A batch's ticks as a log has them, as far as learning reads them."""
    kept = run.ticks
    error_px = kept["star_px"] - kept["command_px"]
    columns = {"time_s": kept["now_s"], "mid_exposure_s": kept["exposed_step"][:, 0] * step_s}
    for axis, name in enumerate(("az", "el")):
        columns[f"error_{name}_px"] = error_px[:, axis]
        columns[f"mirror_{name}_rad"] = kept["exposed_mirror_rad"][:, axis]
        columns[f"fsm_{name}_rad"] = kept["mirror_command_rad"][:, axis]
        columns[f"siderostat_{name}_rad"] = kept["motor_rad"][:, axis]
    return columns


def on_the_model(night: Night, seed: int, folder: Path) -> Outcome:
    """Both designs on the batch."""
    known = load_rig(default_rig_path(), night.known)
    fixed = design_minimum_variance(basis(known, LOOP))

    def run(design: Design, at: int) -> tuple[Rig, LoopRun, float]:
        file = folder / "design.json"
        save_design(design, file)
        controller = f"loops.{LOOP}.vernier.controller={file}"
        rig = load_rig(default_rig_path(), [*night.known, *night.unknown, controller])
        made = Batch(rig).run(at, FOUND_S + SETTLE_S + HELD_S, keep=True).loops[LOOP]
        state = made.state
        mean_px2 = state["true_sum2"] / state["residual_steps"]
        return rig, made, math.sqrt(float(mean_px2.max()))

    rig, made, fixed_px = run(fixed, seed)
    ticks = ticks_of(made, rig.mock_parts()[0].step_s)
    usable = (made.ticks["mode"] == Mode.VERNIER) & (made.ticks["star_visible"] == 1)
    usable &= made.ticks["now_s"] > made.state["held_s"] + SETTLE_S
    pieces = pieces_of(ticks["mid_exposure_s"], usable)
    series = rebuild(loop_theory(known, LOOP, fixed), ticks, pieces)
    advice = advise(series, (fixed_px, fixed_px), basis(known, LOOP), fixed)
    learnt_px = run(advice.design, seed)[2]
    return outcome(advice, truth_of(rig, ()), fixed_px, learnt_px)


def on_ideal_stages(night: Night, seed: int, _folder: Path) -> Outcome:
    """Both designs in the linear loop."""
    own = basis(load_rig(default_rig_path(), night.known), LOOP)
    truth = dataclasses.replace(own, lines=night.lines)
    fixed = design_minimum_variance(own)
    error_px, series = held(truth, fixed, HELD_S, seed)
    az_px, el_px = np.sqrt(np.mean(error_px**2, axis=0)).tolist()
    advice = advise([series], (az_px, el_px), own, fixed)
    residuals = [linear_residual(design, truth) for design in (fixed, advice.design)]
    return outcome(advice, truth, *residuals)


def outcome(advice: Advice, truth: Basis, fixed_px: float, learnt_px: float) -> Outcome:
    """What came of a night, beside the truth."""
    night, air = advice.night, air_of(truth.air_path)
    covered = [
        night.strength.covers(air.strength),
        night.fast_pole.covers(air.damping),
        night.b1_s2.covers(truth.air_path.b1_s2),
        night.noise_px.covers(truth.noise_px),
    ]
    if truth.lines:  # the plant's mirror has hysteresis, and so no gain that would be the truth
        covered += [night.mirror_gain.covers(1.0), night.overshoot.covers(0.0)]
    found = 0
    for line in night.lines:
        for true in truth.lines:
            alike = (line.frequency_hz.value, *line.aliases_hz)
            away_hz = [abs(hz - true.frequency_hz) for hz in alike]
            found += min(away_hz) < NEAR_HZ
            if away_hz[0] < NEAR_HZ:
                covered.append(line.frequency_hz.covers(true.frequency_hz))
                covered += [rms.covers(true.rms_px) for rms in line.rms_px]
    least_px = bound(truth).residual_px
    false = len(night.lines) - found
    fits = night.test.fits
    return Outcome(fixed_px, learnt_px, least_px, sum(covered), len(covered), found, false, fits)


def rows(night: Night, seeds: range, folder: Path) -> Iterator[Outcome]:
    """One seed after the other."""
    run: Callable[[Night, int, Path], Outcome] = on_ideal_stages if night.lines else on_the_model
    for seed in seeds:
        yield run(night, seed, folder)


def main() -> None:
    """Print a row of a Markdown table for each night."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--nights", default="", help="only those whose name holds this")
    arguments = parser.parse_args()
    print(
        "| night | plant | fixed px | learnt px | bound px | learnt over bound | goal | intervals that hold "
        "the truth | lines found, false | does not fit |"
    )
    print("| --- " * 10 + "|")
    with tempfile.TemporaryDirectory() as name:
        for night in NIGHTS:
            if arguments.nights not in night.name:
                continue
            outcomes = list(rows(night, range(arguments.seeds), Path(name)))
            fixed_px, learnt_px, bound_px = np.mean([one[:3] for one in outcomes], axis=0)
            intervals = sum(one.intervals for one in outcomes)
            covered = sum(one.held for one in outcomes)
            found = sum(one.found for one in outcomes)
            print(
                f"| {night.name} | {'linear' if night.lines else 'model'} | {fixed_px:.4f} "
                f"| {learnt_px:.4f} | {bound_px:.4f} | {learnt_px / bound_px:.3f} | {night.goal} "
                f"| {covered} of {intervals} "
                f"| {found} of {len(night.lines) * len(outcomes)}, {sum(one.false for one in outcomes)} "
                f"| {sum(not one.fits for one in outcomes)} of {len(outcomes)} |",
                flush=True,
            )


if __name__ == "__main__":
    main()
