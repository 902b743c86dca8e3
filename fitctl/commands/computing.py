"""Command lines of what computes: simulation, replay, identification, design, the paper's figures."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from fitctl.commands.choosing import insist_on_loop, insist_on_plant, rig_of, with_controller
from fitctl.commands.options import (
    ControllerOption,
    JsonOption,
    LoopOption,
    RigOption,
    SeedOption,
    SetOption,
)
from fitctl.config import ConfigError, default_rig_path


def simulate(
    rig: RigOption = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    seed: SeedOption = 0,
    duration: Annotated[
        float, typer.Option(min=1.0, max=1e6, help="Seconds of virtual time.")
    ] = 120.0,
    runs: Annotated[
        int, typer.Option(min=1, help="How many, with seeds from --seed on, on every core.")
    ] = 1,
    scheduler: Annotated[
        str, typer.Option(metavar="ADDRESS", help="Run on a Dask cluster: tcp://host:port.")
    ] = "",
    as_json: JsonOption = False,
) -> None:
    """Acquire and hold on the virtual clock: same supervisor and plant, no wires, much faster.

    With --runs, means, percentiles and the worst seeds of many runs; each is the run that its seed
    gives alone.
    """
    from fitctl.commands.simulate import run_many, run_simulation

    settings = rig_of(rig, with_controller(rig, overrides, controller))
    insist_on_plant(settings)
    if runs == 1 and not scheduler:
        raise typer.Exit(run_simulation(settings, seed, duration, as_json=as_json))
    seeds = range(seed, seed + runs)
    raise typer.Exit(run_many(settings, seeds, duration, scheduler, as_json=as_json))


def replay(
    logs: Annotated[
        list[Path],
        typer.Argument(metavar="LOG...", help="All files of one run, from its first on."),
    ],
    rig: Annotated[
        Path | None,
        typer.Option("--rig", metavar="FILE", help="Rig file; without it, the one in the log."),
    ] = None,
    overrides: SetOption = None,
    controller: ControllerOption = None,
    as_json: JsonOption = False,
) -> None:
    """Feed a log's frames through today's code, and tell where it decides otherwise.

    Exit status 0 if every mode and every command is the same to the last bit, 1 if not, 2 if the log
    cannot be replayed. A changed command changes no frames.
    """
    from fitctl.commands.replay import run_replay

    raise typer.Exit(run_replay(logs, rig, overrides or [], controller, as_json=as_json))


def identify(
    what: Annotated[str, typer.Argument(help="hysteresis, backlash, response, airpath or delay.")],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    log: Annotated[
        Path | None, typer.Option(help="Learn from this log (or bench file) of an earlier run.")
    ] = None,
    simulated: Annotated[
        bool, typer.Option("--simulate", help="Experiment on the virtual clock, in seconds.")
    ] = False,
    mock: Annotated[
        bool, typer.Option("--mock", help="Start the rig's mock devices and experiment on them.")
    ] = False,
    seed: SeedOption = 0,
    out: Annotated[
        Path | None, typer.Option(help="The rig fragment; by default RIG-LOOP-WHAT.toml.")
    ] = None,
    plot: Annotated[
        Path | None, typer.Option(help="The plot; by default beside the fragment, as PNG.")
    ] = None,
) -> None:
    """Measure what a rig truly is, and write it as a fragment that its rig file includes.

    Without --log, --simulate or --mock the rig's running supervisor does the experiment: the loop must
    hold a star in VERNIER. The stages move open loop meanwhile; a stop ends it at once.
    """
    from fitctl.commands.identify import Output, Source, run_identify
    from fitctl.identify.experiments import EXPERIMENTS

    if what not in EXPERIMENTS:
        msg = f"identify: {what} cannot be identified; there are {', '.join(EXPERIMENTS)}"
        raise ConfigError(msg)
    if (log is not None) + simulated + mock > 1:
        msg = "identify: --log, --simulate and --mock exclude each other; give one, or none for the rig"
        raise ConfigError(msg)
    settings = rig_of(rig, overrides)
    insist_on_loop("identify", settings, loop)
    path = rig or default_rig_path()
    source, output = Source(log, simulated, mock, seed), Output(out, plot)
    raise typer.Exit(run_identify(settings, path, overrides or [], what, loop, source, output))


def design(
    what: Annotated[
        str,
        typer.Argument(
            help="vernier, coarse, bound, compare, or a pair: eq20, lqg-ltr, minimum-variance, fslq, "
            "or a saved file."
        ),
    ],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    as_json: JsonOption = False,
    plot: Annotated[
        Path | None, typer.Option(metavar="FILE", help="Draw Fig. 9 (vernier), PNG or SVG.")
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Save the pair (*.json), for loops.NAME.vernier.controller."
        ),
    ] = None,
) -> None:
    """Design the loop's controllers from the rig file: margins, residual, and the bound for any.

    vernier is LQG/LTR as the paper does it; compare sets all pairs side by side.
    """
    from fitctl.commands.design import Output, run_design

    settings = rig_of(rig, overrides)
    insist_on_loop("design", settings, loop)
    run_design(settings, what, loop, Output(as_json, plot, out))


def figures(
    out: Annotated[
        Path, typer.Option(metavar="DIR", help="Folder for everything; made if missing.")
    ],
    rig: RigOption = None,
    overrides: SetOption = None,
    loop: LoopOption = "right",
    seed: SeedOption = 0,
    quick: Annotated[
        bool, typer.Option("--quick", help="Few and short runs: to see how it looks.")
    ] = False,
) -> None:
    """Make the paper's figures from this system, and measure what every controller shows.

    Figs. 3, 5, 6, 7, 9, 11 and 12 as PNG and SVG, with captions and beside the paper's numbers in
    figures.md; residuals, attenuation, steps and piston in performance.md; both as JSON too.
    """
    from fitctl.commands.figures import run_figures

    settings = rig_of(rig, overrides)
    insist_on_plant(settings)
    insist_on_loop("figures", settings, loop)
    raise typer.Exit(run_figures(settings, loop, seed, out, quick=quick))
