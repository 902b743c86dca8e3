"""Many runs of one rig, on every core or on a Dask cluster, and their statistics.

A run of a campaign with seed s is the run that `fitctl simulate --seed s` makes.
"""

from __future__ import annotations

import functools
import math
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Executor, Future, ProcessPoolExecutor, as_completed
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

import numpy as np

from fitctl.config import ConfigError, Rig
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.simulation import simulate_rig
from fitctl.simulation.statistics import MetrologyResult, RigResult, SimulationResult

PERCENTILES = (5, 50, 95, 99)
_WORST_SEEDS = 5
_TASKS_PER_CORE = 8  # enough that no core waits long for the last
_MOST_RUNS_PER_TASK = 50
_RETRIES = 10  # of a task whose worker was lost
_CONNECT_TIMEOUT_S = 10.0

Results = dict[int, RigResult]


class CampaignError(Exception):
    """A campaign cannot be run, or not to its end; what is wrong and the next step."""


@dataclass(frozen=True)
class Statistics:
    """Of one figure over all runs that were judged."""

    mean: float
    percentiles: dict[str, float]
    worst: float


@dataclass(frozen=True)
class SeedRms:
    """One run's true residual RMS, of its worst axis."""

    seed: int
    rms_px: float


@dataclass(frozen=True)
class SeedBeamRms:
    """One run's true RMS of a metrology beam, of its worst axis."""

    seed: int
    rms_arcsec: float


@dataclass(frozen=True)
class LoopSummary:
    """Statistics of one stellar loop over all runs.

    Attributes
    ----------
    runs, held, judged : int
        How many there were, how many came to hold their star, and how many for long enough to be judged.
    rms_px : dict
        True residual RMS: ``az``, ``el``, and ``worst_axis``, the larger of each run.
    measured_rms_px : dict
        As the camera saw it: ``az`` and ``el``.
    acquired_s, vernier_s, piston_rms_m : Statistics
    worst_seeds : list of SeedRms
        Runs that could not be judged come first, with nan.
    """

    runs: int
    held: int
    judged: int
    rms_px: dict[str, Statistics]
    measured_rms_px: dict[str, Statistics]
    acquired_s: Statistics
    vernier_s: Statistics
    piston_rms_m: Statistics
    worst_seeds: list[SeedRms]


@dataclass(frozen=True)
class BeamSummary:
    """Statistics of one metrology loop over all runs.

    Attributes
    ----------
    runs, held, judged : int
        How many there were, how many came to hold their beam, and how many for long enough to be judged.
    rms_arcsec : dict
        True RMS of the beam from the centre of the photodiodes: ``az``, ``el``, and ``worst_axis``.
    acquired_s, locked_s : Statistics
    worst_seeds : list of SeedBeamRms
        Runs that could not be judged come first, with nan.
    """

    runs: int
    held: int
    judged: int
    rms_arcsec: dict[str, Statistics]
    acquired_s: Statistics
    locked_s: Statistics
    worst_seeds: list[SeedBeamRms]


@dataclass(frozen=True)
class CampaignSummary:
    """Statistics of all runs: each loop's, and the mean visibility of each run, nan without fringes."""

    loops: dict[str, LoopSummary | BeamSummary]
    visibility: Statistics


class _Runner(NamedTuple):
    """The quickest way to a rig's runs, and why that is not the batch."""

    run: Callable[[int, float], RigResult]
    refusal: str


def run_seeds(rig_json: str, seeds: Sequence[int], duration_s: float) -> Results:
    """Some runs one after the other; what a worker does."""
    run = _runner(rig_json).run
    return {seed: run(seed, duration_s) for seed in seeds}


def batch_refusal(rig_json: str) -> str:
    """Why this process simulates the rig without the batch, a hundred times slower; empty if it does not."""
    return _runner(rig_json).refusal


@functools.lru_cache(maxsize=4)
def _runner(rig_json: str) -> _Runner:
    """A rig's designs and tables take longer to make than a run."""
    rig = Rig.model_validate_json(rig_json)
    try:
        batch = Batch(rig)
    except BatchRefusalError as refusal:
        return _Runner(partial(simulate_rig, rig), str(refusal))
    return _Runner(batch.result, "")


def run_campaign(
    rig: Rig,
    seeds: Sequence[int],
    duration_s: float,
    executor: Executor,
    workers: int,
    on_progress: Callable[[int], None] = lambda _: None,
    on_refusal: Callable[[str], None] = lambda _: None,
) -> Results:
    """All runs on an executor's workers; by seed, in the order of `seeds`.

    `on_progress` is called with the number of runs done, as they come. `on_refusal` is called once, with
    the reason, if the workers cannot use the batch.

    Raises
    ------
    CampaignError
        If a worker fails in a way that trying again does not mend.
    """
    per_task = max(1, min(_MOST_RUNS_PER_TASK, math.ceil(len(seeds) / (workers * _TASKS_PER_CORE))))
    tasks = [seeds[first : first + per_task] for first in range(0, len(seeds), per_task)]
    rig_json = rig.model_dump_json()
    refusal: Future[str] = executor.submit(batch_refusal, rig_json)
    futures = [executor.submit(run_seeds, rig_json, task, duration_s) for task in tasks]
    done: Results = {}
    try:
        if reason := refusal.result():
            on_refusal(reason)
        for future in as_completed(futures):
            done |= future.result()
            on_progress(len(done))
    except ConfigError:
        raise
    except Exception as error:
        msg = f"after {len(done)} of {len(seeds)} runs: {error!r}; look at the workers, and start again"
        raise CampaignError(msg) from error
    finally:
        for future in futures:
            future.cancel()
    return {seed: done[seed] for seed in seeds}


@contextmanager
def local_executor() -> Iterator[tuple[Executor, int]]:
    """A process on every core that is ours, and their number."""
    workers = len(os.sched_getaffinity(0))
    # A server forks the workers before any thread is there that a fork would leave behind.
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    executor = ProcessPoolExecutor(workers, mp_context=context, initializer=_as_a_worker)
    try:
        yield executor, workers
    except BaseException:
        # Nobody waits any more for what they do, which without numba may take minutes.
        for worker in multiprocessing.active_children():
            worker.terminate()
        raise
    finally:
        executor.shutdown(wait=True, cancel_futures=True)


def _as_a_worker() -> None:
    """Ctrl-C is for the parent, who then ends its workers; should it be killed, they end by themselves."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, name="parent-watch", daemon=True).start()


def _end_with_parent() -> None:
    """The server that forked us lives as long as we do; it is the parent who started it that counts."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os.kill(os.getpid(), signal.SIGTERM)


@contextmanager
def dask_executor(address: str, workers: int = 1) -> Iterator[tuple[Executor, int]]:
    """The workers of a Dask scheduler, once so many are there, and how many threads they have together.

    A run whose worker is lost goes to another.

    Raises
    ------
    CampaignError
        If distributed is not installed, nothing answers at `address`, or no worker comes.
    """
    try:
        from distributed import Client
        from distributed.comm.addressing import get_address_host_port
    except ImportError:
        msg = "--scheduler needs Dask: pip install 'fitctl[cluster]'"
        raise CampaignError(msg) from None
    try:
        get_address_host_port(address)  # or the client would try to close what it never opened
        client = Client(address, timeout=_CONNECT_TIMEOUT_S, set_as_default=False)
    except (OSError, ValueError) as error:
        msg = f"scheduler {address}: {error}; start one with: dask scheduler"
        raise CampaignError(msg) from None
    with client:
        try:
            client.wait_for_workers(workers, timeout=_CONNECT_TIMEOUT_S)
        except TimeoutError:
            msg = f"scheduler {address} has no worker; start one with: dask worker {address}"
            raise CampaignError(msg) from None
        threads = sum(client.nthreads().values())
        with client.get_executor(retries=_RETRIES, pure=False) as executor:
            yield executor, threads


def summarize(results: Results) -> CampaignSummary:
    """Statistics of each loop over all runs."""
    loops: dict[str, LoopSummary | BeamSummary] = {}
    for name, first in next(iter(results.values())).loops.items():
        runs = {seed: run.loops[name] for seed, run in results.items()}
        if isinstance(first, MetrologyResult):
            beams = {s: one for s, one in runs.items() if isinstance(one, MetrologyResult)}
            loops[name] = _summarize_beam(beams)
        else:
            stars = {s: one for s, one in runs.items() if isinstance(one, SimulationResult)}
            loops[name] = _summarize(stars)
    return CampaignSummary(loops, _statistics([run.visibility for run in results.values()]))


def _summarize(runs: dict[int, SimulationResult]) -> LoopSummary:
    all_runs = list(runs.values())
    rms_px = {seed: run.rms_px for seed, run in runs.items()}
    worst_axis, worst = _worst(rms_px)
    return LoopSummary(
        runs=len(all_runs),
        held=sum(not math.isnan(run.vernier_s) for run in all_runs),
        judged=sum(not math.isnan(value) for value in worst_axis.values()),
        rms_px=_by_axis(list(rms_px.values()))
        | {"worst_axis": _statistics(list(worst_axis.values()))},
        measured_rms_px=_by_axis([run.measured_rms_px for run in all_runs]),
        acquired_s=_statistics([run.acquired_s for run in all_runs]),
        vernier_s=_statistics([run.vernier_s for run in all_runs]),
        piston_rms_m=_statistics([run.piston_rms_m for run in all_runs]),
        worst_seeds=[SeedRms(seed, worst_axis[seed]) for seed in worst],
    )


def _summarize_beam(runs: dict[int, MetrologyResult]) -> BeamSummary:
    all_runs = list(runs.values())
    rms_arcsec = {seed: run.rms_arcsec for seed, run in runs.items()}
    worst_axis, worst = _worst(rms_arcsec)
    return BeamSummary(
        runs=len(all_runs),
        held=sum(not math.isnan(run.locked_s) for run in all_runs),
        judged=sum(not math.isnan(value) for value in worst_axis.values()),
        rms_arcsec=_by_axis(list(rms_arcsec.values()))
        | {"worst_axis": _statistics(list(worst_axis.values()))},
        acquired_s=_statistics([run.acquired_s for run in all_runs]),
        locked_s=_statistics([run.locked_s for run in all_runs]),
        worst_seeds=[SeedBeamRms(seed, worst_axis[seed]) for seed in worst],
    )


def _worst(rms: dict[int, dict[str, float]]) -> tuple[dict[int, float], list[int]]:
    """The worst axis of each seed, and the worst seeds; seeds without a result come first."""
    worst_axis = {seed: max(axes.values()) for seed, axes in rms.items()}
    ranked = sorted(worst_axis, key=lambda seed: -np.nan_to_num(worst_axis[seed], nan=np.inf))
    return worst_axis, ranked[:_WORST_SEEDS]


def _by_axis(rms: list[dict[str, float]]) -> dict[str, Statistics]:
    return {axis: _statistics([one[axis] for one in rms]) for axis in ("az", "el")}


def _statistics(values: Sequence[float]) -> Statistics:
    """Of the values that are there; all nan where none is."""
    there = np.array([value for value in values if not math.isnan(value)])
    if there.size == 0:
        return Statistics(math.nan, dict.fromkeys(map(str, PERCENTILES), math.nan), math.nan)
    percentiles = np.percentile(there, PERCENTILES)
    return Statistics(
        mean=float(there.mean()),
        percentiles={str(p): float(v) for p, v in zip(PERCENTILES, percentiles, strict=True)},
        worst=float(there.max()),
    )
