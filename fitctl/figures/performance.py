"""What the system must show, measured: residuals, attenuation, steps and piston of every controller."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from fitctl.config import Rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.choose import DESIGNS
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.controllers.design.standing import Standing, standing
from fitctl.figures.attenuation import (
    Spectra,
    attenuation,
    mean_spectra,
    rebuilt,
    spectra,
)
from fitctl.figures.rigs import at_flight_rate, with_controller, with_rougher_stages
from fitctl.figures.steps import (
    AZ,
    STEP_AT_S,
    Response,
    far_step,
    jog_settling_s,
    jogs,
    star_step,
    step_response,
    target_step,
)
from fitctl.identify.record import tick_columns
from fitctl.simulation.campaign import Results, run_seeds
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import SimulationResult

ROUGH_HYSTERESIS, ROUGH_BACKLASH_TIMES = 0.30, 2.0
AT_HZ = 1.0
_FAR_S = 120.0  # after a step of 20 px


class Effort(NamedTuple):
    """How much is simulated.

    Attributes
    ----------
    seeds : int
        Runs of each controller, for each residual.
    hold_s, flight_s : float
        Virtual time of each, and at the flight rate.
    logged : int
        Runs of each controller whose ticks are kept for the attenuation, of `hold_s` each.
    """

    seeds: int
    hold_s: float
    flight_s: float
    logged: int

    def __str__(self) -> str:
        return (
            f"{self.seeds} seeds of {self.hold_s:g} s, at the flight rate of {self.flight_s:g} s; the "
            f"attenuation from {self.logged} of them"
        )


@dataclass(frozen=True)
class Steps:
    """What a controller did about steps of 20 px and jogs of 1 px."""

    star: Response
    target: Response
    jog_s: float
    jog_saturated_s: float


@dataclass(frozen=True)
class Residual:
    """What many runs left.

    Attributes
    ----------
    rms_px, seed_sd_px : float
        True RMS about the target in continuous time, from `SETTLE_S` after VERNIER on: mean over seeds
        of the worst axis, and standard deviation over seeds; nan if a seed did not hold its star.
    ratio_to_bound : float
    measured_px : float
        The same axis' RMS as its sensor measured it, noise included: the only one that a real rig has.
    piston_m : float
        RMS about its mean of Eq. 4, for the true stack displacements.
    """

    rms_px: float
    seed_sd_px: float
    ratio_to_bound: float
    measured_px: float
    piston_m: float


@dataclass(frozen=True)
class Row:
    """One controller."""

    controller: str
    nominal: Residual
    rough: Residual
    flight: Residual
    attenuation: float
    design: Standing
    steps: Steps


class Job(NamedTuple):
    """One run: of what, and how. `work` is one of this module's functions, so that it can be sent away."""

    controller: str
    what: str
    work: Callable[..., Any]
    arguments: tuple[Any, ...]


# ---------------------------------------------------------------- runs


def logged_spectra(rig: Rig, loop_name: str, seed: int, duration_s: float) -> Spectra:
    """Acquire and hold as `fitctl simulate` does, and look at the ticks as a log has them.

    Raises
    ------
    IdentifyError
        If VERNIER was not reached in time for a spectrum.
    """
    simulation = Simulation(rig, seed, history_s=1.0)
    simulation.acquire()
    simulation.run(duration_s)
    ticks = tick_columns(tick for tick in simulation.ticks if tick.loop == loop_name)
    return spectra(rebuilt(rig, loop_name, ticks), rig.camera.period_s)


def step_and_jog(rig: Rig, loop_name: str, seed: int) -> Steps:
    """A star that jumps by 20 px, a target that does, and jogs of 1 px."""
    settings = rig.stellar_loops[loop_name]
    far = far_step(rig, loop_name)
    star, target = (
        step_response(
            move(rig, loop_name, seed, far, _FAR_S), AZ, STEP_AT_S, settings.requirement_px
        )
        for move in (star_step, target_step)
    )
    motion = jogs(rig, loop_name, seed)
    at_px = (settings.target_px.az, settings.target_px.el)
    saturated_s = float(np.count_nonzero(motion.saturated)) * rig.camera.period_s
    jog_s = jog_settling_s(motion, at_px, settings.requirement_px)
    return Steps(star, target, jog_s, saturated_s)


def jobs(rig: Rig, loop_name: str, seed: int, effort: Effort) -> list[Job]:
    """All runs of the table: residuals by compiled batches, the rest by the supervisor itself."""
    seeds = list(range(seed, seed + effort.seeds))
    found = []
    for controller in DESIGNS:
        its_rig = with_controller(rig, loop_name, controller)
        rough = with_rougher_stages(its_rig, loop_name, ROUGH_HYSTERESIS, ROUGH_BACKLASH_TIMES)
        plan = (
            ("nominal", its_rig, effort.hold_s),
            ("rough", rough, effort.hold_s),
            ("flight", at_flight_rate(its_rig), effort.flight_s),
        )
        found += [
            Job(controller, what, run_seeds, (one.model_dump_json(), seeds, run_s))
            for what, one, run_s in plan
        ]
        found += [
            Job(controller, "logged", logged_spectra, (its_rig, loop_name, one, effort.hold_s))
            for one in range(seed, seed + effort.logged)
        ]
        found.append(Job(controller, "steps", step_and_jog, (its_rig, loop_name, seed)))
    return found


# ---------------------------------------------------------------- the table


def rows(rig: Rig, loop_name: str, results: Sequence[tuple[Job, Any]]) -> list[Row]:
    """One row a controller, from every job's result."""
    its_basis = basis(rig, loop_name)
    least = bound(its_basis).residual_px
    flight_least = bound(basis(at_flight_rate(rig), loop_name)).residual_px
    found = []
    for controller, design in DESIGNS.items():
        of: dict[str, list[Any]] = {}
        for job, result in results:
            if job.controller == controller:
                of.setdefault(job.what, []).append(result)
        measured = mean_spectra(of["logged"])
        found.append(
            Row(
                controller=controller,
                nominal=_residual(of["nominal"][0], loop_name, least),
                rough=_residual(of["rough"][0], loop_name, least),
                flight=_residual(of["flight"][0], loop_name, flight_least),
                attenuation=attenuation(measured, AT_HZ),
                design=standing(design(its_basis), its_basis),
                steps=of["steps"][0],
            )
        )
    return found


def _residual(results: Results, loop_name: str, least_px: float) -> Residual:
    of_loop = [result.loops[loop_name] for result in results.values()]
    runs = [run for run in of_loop if isinstance(run, SimulationResult)]
    rms_px = np.array([[run.rms_px["az"], run.rms_px["el"]] for run in runs])
    worst = int(rms_px.mean(axis=0).argmax())
    mean_px = float(rms_px[:, worst].mean())
    spread_px = float(rms_px[:, worst].std(ddof=1)) if len(runs) > 1 else math.nan
    measured_px = float(np.mean([run.measured_rms_px[("az", "el")[worst]] for run in runs]))
    piston_m = math.sqrt(np.mean([run.piston_rms_m**2 for run in runs]))
    return Residual(mean_px, spread_px, mean_px / least_px, measured_px, piston_m)
