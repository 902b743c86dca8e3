"""All figures and measurements at once: independent jobs, on as many processes as there are cores."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import as_completed
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

from fitctl.config import Rig
from fitctl.figures import performance
from fitctl.figures.air import figure_7
from fitctl.figures.loops import figure_9
from fitctl.figures.mirror import figures_5_and_6
from fitctl.figures.plate import Plate
from fitctl.figures.report import write_figures, write_performance
from fitctl.figures.stacks import figure_3
from fitctl.figures.steps import figure_11, figure_12
from fitctl.simulation.campaign import local_executor


class Amount(NamedTuple):
    """How much is simulated.

    Attributes
    ----------
    runs : Effort
        For the table of performance.
    step_s : float
        After the step of Fig. 11.
    minutes : int
        Of frames that check the intervals of Fig. 7.
    """

    runs: performance.Effort
    step_s: float
    minutes: int


FULL = Amount(
    performance.Effort(seeds=10, hold_s=120.0, flight_s=60.0, logged=4), step_s=150.0, minutes=20
)
QUICK = Amount(
    performance.Effort(seeds=2, hold_s=40.0, flight_s=30.0, logged=1), step_s=30.0, minutes=2
)


def make(
    rig: Rig,
    loop_name: str,
    seed: int,
    folder: Path,
    amount: Amount,
    on_progress: Callable[[float], None],
) -> tuple[list[Plate], list[performance.Row]]:
    """Make everything in a folder that exists; `on_progress` hears the part done.

    Raises
    ------
    IdentifyError, RuntimeError
        If an experiment fails: the star is not found or is lost, or a worker dies.
    """
    figures: list[Callable[..., list[Plate]]] = [
        figures_5_and_6,
        partial(figure_7, minutes=amount.minutes),
        partial(figure_11, after_s=amount.step_s),
        figure_12,
        figure_3,
        figure_9,
    ]
    measured = performance.jobs(rig, loop_name, seed, amount.runs)
    plates: list[Plate] = []
    results: dict[int, Any] = {}
    # Matrices here are small, and cores shared: fitctl/cli.py gives each process one BLAS thread.
    with local_executor() as (workers, _):
        drawing = [workers.submit(draw, rig, loop_name, seed, folder) for draw in figures]
        running = {
            workers.submit(job.work, *job.arguments): number for number, job in enumerate(measured)
        }
        futures = [*drawing, *running]
        for done, future in enumerate(as_completed(futures), start=1):
            if future in running:
                results[running[future]] = future.result()
            else:
                plates += future.result()
            on_progress(done / len(futures))
    plates.sort(key=lambda plate: plate.name)
    in_order = [(job, results[number]) for number, job in enumerate(measured)]
    rows = performance.rows(rig, loop_name, in_order)
    write_figures(rig, seed, plates, folder)
    write_performance(rig, loop_name, rows, f"{amount.runs}; first seed {seed}.", folder)
    return plates, rows
