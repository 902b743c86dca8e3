"""`fitctl simulate`: the instrument without wires, once or many times."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from typing import Annotated

import typer

from fitctl.commands.shared.exits import FAILED
from fitctl.commands.shared.options import (
    ControllerOption,
    JsonOption,
    SeedOption,
    SetOption,
    ShippedRigOption,
)
from fitctl.commands.shared.plant import require_plant
from fitctl.commands.shared.printing import progress_line, say, say_lines, to_json
from fitctl.commands.shared.rig import rig_of, with_controller
from fitctl.config import ConfigError, Rig
from fitctl.drivers.interface import DeviceError
from fitctl.messages.modes import Mode
from fitctl.processes import ended_by_signals, interrupt
from fitctl.simulation.campaign import (
    PERCENTILES,
    BeamSummary,
    CampaignError,
    LoopSummary,
    Statistics,
    dask_executor,
    local_executor,
    run_campaign,
    summarize,
)
from fitctl.simulation.simulation import simulate_rig
from fitctl.simulation.statistics import MetrologyResult, SimulationResult


def simulate(
    rig: ShippedRigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, max=1e6, metavar="SECONDS", help="Virtual time.")
    ] = 120.0,
    runs: Annotated[
        int, typer.Option(min=1, max=1_000_000, help="Number of runs, with seeds from --seed on.")
    ] = 1,
    scheduler: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Run on a Dask cluster: tcp://host:port.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Acquire and hold a star on a virtual clock: the same supervisor and plant, much faster.

    With --runs, prints means, percentiles and the worst seeds of many runs. Each seed gives the same run alone
    and among others. Exit status 1 if a loop did not reach its star or beam.
    """
    settings = rig_of(rig, with_controller(rig, overrides, controller))
    require_plant(settings)
    if runs == 1 and not scheduler:
        status = _simulate_once(settings, seed, duration, as_json=as_json)
    else:
        seeds = range(seed, seed + runs)
        status = _simulate_many(settings, seeds, duration, scheduler, as_json=as_json)
    raise typer.Exit(status)


def _simulate_once(rig: Rig, seed: int, duration_s: float, *, as_json: bool) -> int:
    """Simulate and print the result; returns the exit status."""
    try:
        with progress_line("simulating") as progress:
            result = simulate_rig(rig, seed, duration_s, on_progress=progress)
            progress(1.0)
    except DeviceError as error:  # which ended the collector's motion
        say(f"simulate: {error}", err=True)
        return FAILED
    except MemoryError:
        msg = f"simulate: --duration {duration_s:g} needs more memory than there is; choose a shorter one"
        raise ConfigError(msg) from None
    loops = {name: loop._asdict() for name, loop in result.loops.items()}
    if as_json:
        several = result._asdict() | {"loops": loops}
        say(to_json(next(iter(loops.values())) if len(loops) == 1 else several))
    else:
        for name, loop in result.loops.items():
            say_lines(_result_text(name, loop, duration_s))
        if not math.isnan(result.visibility):
            say(f"mean visibility of the fringes {result.visibility:.4f}")
    return 0 if all(_holds(loop) for loop in result.loops.values()) else FAILED


def _holds(result: SimulationResult | MetrologyResult) -> bool:
    """Whether a loop came to hold its star or its beam."""
    held_s = result.locked_s if isinstance(result, MetrologyResult) else result.vernier_s
    return not math.isnan(held_s)


def _result_text(name: str, result: SimulationResult | MetrologyResult, duration_s: float) -> str:
    of_beam = isinstance(result, MetrologyResult)
    held, mode = ("beam", Mode.LOCKED) if of_beam else ("star", Mode.VERNIER)
    too_short = f"within {duration_s:g} s; use a longer --duration"
    if math.isnan(result.acquired_s):
        return f"loop {name}: {held} not found {too_short}"
    if not _holds(result):
        found = f"{held} found after {result.acquired_s:.1f} s"
        return f"loop {name}: {found}, {mode.name} not reached {too_short}"
    if not result.judged_s:
        return f"loop {name}: {mode.name} reached, but no RMS measured {too_short}"
    if isinstance(result, MetrologyResult):
        beam = result.rms_arcsec
        return (
            f"loop {name}: beam found after {result.acquired_s:.1f} s, locked after "
            f"{result.locked_s:.1f} s\n"
            f"  true beam RMS      az {beam['az']:.3f} arcsec, el {beam['el']:.3f} arcsec"
            f" over {result.judged_s:.0f} s"
        )
    rms, measured = result.rms_px, result.measured_rms_px
    return (
        f"loop {name}: star found after {result.acquired_s:.1f} s, vernier after "
        f"{result.vernier_s:.1f} s\n"
        f"  true residual RMS  az {rms['az']:.4f} px, el {rms['el']:.4f} px"
        f" over {result.judged_s:.0f} s\n"
        f"  measured RMS       az {measured['az']:.4f} px, el {measured['el']:.4f} px\n"
        f"  piston RMS         {result.piston_rms_m * 1e9:.1f} nm\n"
        f"  speed              {result.speed_x:.0f}x real time"
    )


def _simulate_many(
    rig: Rig, seeds: Sequence[int], duration_s: float, scheduler: str, *, as_json: bool
) -> int:
    """Simulate every seed, here or on a Dask cluster, and print what they say together."""
    started = time.perf_counter()
    refusal: str | None = None

    def on_refusal(reason: str) -> None:
        nonlocal refusal
        refusal = reason
        say_lines(
            f"The batch simulator cannot run this rig: {reason}.\n"
            "Each run is simulated tick by tick, about a hundred times slower.",
            err=True,
        )

    try:
        with (
            ended_by_signals(interrupt),  # its workers would outlive it
            dask_executor(scheduler) if scheduler else local_executor() as (executor, workers),
            progress_line(f"{len(seeds)} runs", len(seeds)) as progress,
        ):
            results = run_campaign(rig, seeds, duration_s, executor, workers, progress, on_refusal)
    except CampaignError as error:
        say(str(error), err=True)
        return FAILED
    wall_s = time.perf_counter() - started
    summary = summarize(results)
    speed_x = len(seeds) * duration_s / wall_s
    if as_json:
        head = {
            "duration_s": duration_s,
            "workers": workers,
            "wall_s": wall_s,
            "speed_x": speed_x,
            "batch_refusal": refusal,
        }
        fringes = {} if rig.fringes is None else {"visibility": summary.visibility}
        say(to_json(head | {"loops": summary.loops} | fringes))
    else:
        for name, loop in summary.loops.items():
            say_lines(_summary_text(name, loop))
        if rig.fringes is not None:
            say(_row("visibility", summary.visibility, 4, 1.0))
        say(f"{speed_x:.0f}x real time on {workers} workers, {wall_s:.1f} s in all")
    return 0 if all(loop.held == loop.runs for loop in summary.loops.values()) else FAILED


def _summary_text(name: str, summary: LoopSummary | BeamSummary) -> str:
    if isinstance(summary, BeamSummary):
        return _beam_summary_text(name, summary)
    return _star_summary_text(name, summary)


def _beam_summary_text(name: str, summary: BeamSummary) -> str:
    rows = [
        ('true RMS az, "', summary.rms_arcsec["az"], 3, 1.0),
        ('true RMS el, "', summary.rms_arcsec["el"], 3, 1.0),
        ('worst axis, "', summary.rms_arcsec["worst_axis"], 3, 1.0),
        ("beam found, s", summary.acquired_s, 1, 1.0),
        ("locked, s", summary.locked_s, 1, 1.0),
    ]
    worst = {run.seed: f"{run.rms_arcsec:.3f} arcsec" for run in summary.worst_seeds}
    return _table(name, "beam", summary, rows, worst)


def _star_summary_text(name: str, summary: LoopSummary) -> str:
    rows = [
        ("true RMS az, px", summary.rms_px["az"], 4, 1.0),
        ("true RMS el, px", summary.rms_px["el"], 4, 1.0),
        ("worst axis, px", summary.rms_px["worst_axis"], 4, 1.0),
        ("measured az, px", summary.measured_rms_px["az"], 4, 1.0),
        ("measured el, px", summary.measured_rms_px["el"], 4, 1.0),
        ("piston RMS, nm", summary.piston_rms_m, 1, 1e9),
        ("star found, s", summary.acquired_s, 1, 1.0),
        ("vernier, s", summary.vernier_s, 1, 1.0),
    ]
    worst = {run.seed: f"{run.rms_px:.4f} px" for run in summary.worst_seeds}
    return _table(name, "star", summary, rows, worst)


def _table(
    name: str,
    held: str,
    summary: LoopSummary | BeamSummary,
    rows: Sequence[tuple[str, Statistics, int, float]],
    worst_seeds: dict[int, str],
) -> str:
    head = "".join(f"{f'{p}%':>10}" for p in PERCENTILES)
    worst = ", ".join(
        f"{seed} ({'not judged' if text.startswith('nan') else text})"
        for seed, text in worst_seeds.items()
    )
    return "\n".join(
        [
            f"loop {name}: {summary.held} of {summary.runs} runs held their {held}, "
            f"{summary.judged} for long enough to be judged"
            + ("" if summary.judged or not summary.held else "; use a longer --duration"),
            f"  {'':18}{'mean':>10}{head}{'worst':>10}",
            *(_row(title, figure, digits, scale) for title, figure, digits, scale in rows),
            f"  worst seeds       {worst}",
        ]
    )


def _row(title: str, figure: Statistics, digits: int, scale: float) -> str:
    values = [figure.mean, *figure.percentiles.values(), figure.worst]
    return f"  {title:18}" + "".join(
        f"{'-':>10}" if math.isnan(value) else f"{value * scale:10.{digits}f}" for value in values
    )
