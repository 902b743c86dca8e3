"""The least residual of any linear controller that keeps the margins, beside that of the design with a guard.

With S = 1 + P Q, each stable linear controller is a stable Q, from the disturbance to the mirror's commands.
The residual is quadratic in the taps of Q, and |S| and |T| are limited at each frequency. This is a convex
problem, and the value of its dual proves that no other Q of as many taps leaves less. |S| <= 2 ensures 6 dB and
the gains from 0.7 to 1.4, |T| <= 1.66 ensures 35 degrees.

First table: linear, fit as sensor, on a mirror that stands still at mid-exposure and on one that is then 0.09
of its last step beyond it, as the simulated one is. Second table: the controllers for the night with a line,
on the whole simulated plant (compiled batch; true residual of the worst axis from 120 s to 300 s).
"""

from __future__ import annotations

import argparse
import dataclasses
import math
import os
import tempfile
from pathlib import Path
from typing import NamedTuple

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # as fitctl itself has it

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, hankel, svd, toeplitz
from scipy.optimize import minimize

from benchmarks.learn import FIT, LOOP
from benchmarks.learn_online import SIX, residual_px, shaken
from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import Basis, basis
from fitctl.controllers.design.files import save_design
from fitctl.controllers.design.linear_loop.bound import bound, linear_residual
from fitctl.controllers.design.linear_loop.disturbance import disturbance, hold
from fitctl.controllers.design.linear_loop.sampled import timing
from fitctl.controllers.design.margins import Required, design_with_margins, frequencies_hz
from fitctl.controllers.pair import INPUTS, Design
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.learning import NO_CHANGES

Floats = NDArray[np.float64]
TAPS = 200
ORDER = 20  # of a controller with almost the same taps
FINE_HZ = np.linspace(3.0, 25.0, 150)
OVERSHOOT = 0.09


class Least(NamedTuple):
    """The optimum: its residual, the dual's proof of it, its largest sensitivities, and Q."""

    residual_px: float
    proven_px: float
    peak_s: float
    peak_t: float
    taps: Floats


def least(truth: Basis, overshoot: float, most_s: float, most_t: float) -> Least:
    """The best Q on a mirror that is `overshoot` of its last step beyond it at mid-exposure."""
    moving, period_s = disturbance(truth), truth.period_s
    acts = hold(moving, period_s, truth.delay_s)
    mean_of_hold = acts.weight @ acts.star
    step = expm(moving.a * period_s)
    at = [
        moving.covariance @ moving.seen
    ]  # covariance of the states with the star, k frames earlier
    for _ in range(TAPS - 1):
        at.append(step @ at[-1])
    seen, wanted = (np.array(at) @ output for output in (moving.seen, mean_of_hold))
    open_px2 = seen[0]
    power = toeplitz(np.append(seen[0] + truth.noise_px**2, seen[1:]))
    hz = np.unique(np.concatenate([frequencies_hz(truth), FINE_HZ]))
    z = np.exp(-2j * np.pi * hz * period_s)
    frames = timing(period_s, truth.delay_s).frames
    plant = (1 + overshoot) * z**frames - overshoot * z ** (frames + 1)
    answers = plant[:, None] * z[:, None] ** np.arange(TAPS)
    scale = truth.noise_px**2

    def best(of_s: Floats, of_t: Floats) -> tuple[Floats, Floats, Floats, float]:
        """For given multipliers: Q, |S|², |T|², and the residual's square."""
        weighed = (of_s + of_t)[:, None] * answers
        normal = power + (answers.conj().T @ weighed).real
        taps = -np.linalg.solve(normal, wanted + answers.real.T @ of_s)
        turned = answers @ taps
        left_px2 = open_px2 + 2 * wanted @ taps + taps @ power @ taps
        return taps, np.abs(1 + turned) ** 2, np.abs(turned) ** 2, float(left_px2)

    def dual(multipliers: Floats) -> tuple[float, Floats]:
        of_s, of_t = np.split(scale * multipliers, 2)
        _, s2, t2, left_px2 = best(of_s, of_t)
        missed = np.concatenate([s2 - most_s**2, t2 - most_t**2])
        return float(-left_px2 / scale - multipliers @ missed), -missed

    begin = np.full(2 * len(hz), 1e-3)
    options = {"maxiter": 4000, "maxfun": 4000, "ftol": 1e-12, "gtol": 1e-7}
    limits = [(0.0, None)] * len(begin)
    found = minimize(dual, begin, jac=True, method="L-BFGS-B", bounds=limits, options=options)
    taps, s2, t2, left_px2 = best(*np.split(scale * found.x, 2))
    return Least(
        residual_px=math.sqrt(left_px2),
        proven_px=math.sqrt(-found.fun * scale),
        peak_s=math.sqrt(s2.max()),
        peak_t=math.sqrt(t2.max()),
        taps=taps,
    )


def as_design(taps: Floats, overshoot: float, truth: Basis, like: Design) -> Design:
    """A pair that commands Q of the disturbance, and lets the siderostat relieve the mirror as others do."""
    # Taps as a system of few states (Kung).
    left, values, right = svd(hankel(taps[1:]))
    size = np.sqrt(values[:ORDER])
    observed = left[:, :ORDER] * size
    keep = np.linalg.lstsq(observed[:-1], observed[1:], rcond=None)[0]
    drive, shown = size * right[:ORDER, 0], observed[0]
    # States: those, siderostat steps under way with the newest first, the mirror of the frame before.
    frames, walked = timing(truth.period_s, truth.delay_s)
    n = ORDER + frames + 1
    error, _, mirror, motor, _ = range(len(INPUTS))
    given, before = np.zeros(len(INPUTS)), np.zeros(n)
    given[[error, mirror, motor]] = 1.0, -1.0 - overshoot, -1.0
    before[-1] = overshoot
    motor_state = np.zeros(n)
    motor_state[ORDER : ORDER + frames] = 1.0
    motor_state[ORDER + frames - 1] = 1.0 - walked
    part = truth.settings.minimum_variance.offload_per_s * truth.period_s
    outputs = np.array([1.0, part]) / (1.0 + part / 2)
    command = np.append(shown, np.zeros(frames + 1)) + taps[0] * before - motor_state
    command_given = taps[0] * given - np.eye(len(INPUTS))[motor]
    c, d = np.outer(outputs, command), np.outer(outputs, command_given)
    a, b = np.zeros((n, n)), np.zeros((n, len(INPUTS)))
    a[:ORDER, :ORDER], b[:ORDER] = keep, np.outer(drive, given)
    a[:ORDER] += np.outer(drive, before)
    a[ORDER], b[ORDER] = c[1], d[1]
    a[ORDER + 1 : ORDER + frames, ORDER : ORDER + frames - 1] = np.eye(frames - 1)
    b[-1, mirror] = 1.0
    return dataclasses.replace(like, name="least", a=a, b=b, c=c, d=d, parameters={}, own=True)


def on_the_plant(design: Design, seeds: int, folder: Path) -> tuple[float, float]:
    """Mean residual over seeds on the night with a line, px, and its standard error."""
    file = folder / f"{design.name}.json"
    save_design(design, file)
    controller = f"loops.{LOOP}.vernier.controller={file}"
    batch = Batch(load_rig(default_rig_path(), [*FIT, SIX, controller]))
    left_px = [residual_px(batch, seed, NO_CHANGES) for seed in range(seeds)]
    return float(np.mean(left_px)), float(np.std(left_px, ddof=1) / math.sqrt(seeds))


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=40)
    seeds = parser.parse_args().seeds
    quiet = basis(load_rig(default_rig_path(), list(FIT)), LOOP)
    shaky = dataclasses.replace(quiet, lines=shaken(6.0, rms_px=0.05))
    most_s = Required().peak_sensitivity
    print(
        "| night | overshoot | \\|T\\| at most | least over bound | proven | design with a guard |"
    )
    print("| --- " * 6 + "|")
    found: dict[float, Least] = {}
    for name, truth in (("the paper's, fit", quiet), ("6 Hz, 0.05 px, fit", shaky)):
        least_px = bound(truth).residual_px
        guarded = design_with_margins(truth)
        for overshoot in (0.0, OVERSHOOT):
            for most_t in (math.inf, 1.66):
                # Without a limit, one that no controller comes near.
                found[overshoot] = least(truth, overshoot, most_s, min(most_t, 100.0))
                print(
                    f"| {name} | {overshoot} | {most_t} | {found[overshoot].residual_px / least_px:.4f} "
                    f"| {found[overshoot].proven_px / least_px:.4f} "
                    f"| {'-' if overshoot else f'{linear_residual(guarded, truth) / least_px:.4f}'} |",
                    flush=True,
                )
    controllers = {"with a guard": guarded}
    for overshoot, one in found.items():
        name = f"least, made for an overshoot of {overshoot}"
        controllers[name] = as_design(one.taps, overshoot, shaky, guarded)
    print(f"\n| controller | over bound on the plant, {seeds} seeds | standard error |")
    print("| --- " * 3 + "|")
    with tempfile.TemporaryDirectory() as folder:
        for name, design in controllers.items():
            mean_px, error_px = on_the_plant(design, seeds, Path(folder))
            print(f"| {name} | {mean_px / least_px:.4f} | {error_px / least_px:.4f} |", flush=True)


if __name__ == "__main__":
    main()
