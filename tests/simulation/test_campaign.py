"""Campaigns: on the cores of this machine, and on a Dask cluster that loses a worker."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack

import psutil
import pytest

from fitctl.cli import main
from fitctl.config import default_rig_path
from fitctl.simulation import campaign
from fitctl.simulation.batch.settings import BatchRefusalError
from fitctl.simulation.campaign import (
    CampaignError,
    SeedRms,
    dask_executor,
    local_executor,
    run_campaign,
    summarize,
)
from fitctl.simulation.simulation import simulate
from fitctl.simulation.statistics import RigResult, SimulationResult

pytestmark = pytest.mark.long

RUN_S = 26.0  # of which more than a second counts


def result(az_px, el_px, vernier_s=8.0):
    return SimulationResult(
        acquired_s=2.0,
        vernier_s=vernier_s,
        rms_px={"az": az_px, "el": el_px},
        measured_rms_px={"az": az_px, "el": el_px},
        judged_s=100.0,
        piston_rms_m=4e-8,
        mode_times={},
        frames=6000,
        speed_x=math.nan,
    )


def rig_result(right):
    return RigResult({"right": right}, math.nan, math.nan)


# ---------------------------------------------------------------- what runs say together


def test_a_summary_has_means_percentiles_and_the_worst_axis_of_each_run():
    runs = {seed: rig_result(result(0.01 * seed, 0.02)) for seed in (1, 2, 3)}
    summary = summarize(runs).loops["right"]

    assert (summary.runs, summary.held, summary.judged) == (3, 3, 3)
    assert summary.rms_px["az"].mean == pytest.approx(0.02)
    assert summary.rms_px["az"].percentiles["50"] == pytest.approx(0.02)
    assert summary.rms_px["worst_axis"].mean == pytest.approx((0.02 + 0.02 + 0.03) / 3)
    assert summary.rms_px["worst_axis"].worst == pytest.approx(0.03)
    assert summary.worst_seeds[0] == SeedRms(3, pytest.approx(0.03))


def test_a_run_that_never_held_its_star_is_the_worst_and_is_counted_apart():
    runs = {
        1: rig_result(result(0.02, 0.02)),
        2: rig_result(result(math.nan, math.nan, math.nan)),
    }

    summary = summarize(runs).loops["right"]

    assert (summary.runs, summary.held, summary.judged) == (2, 1, 1)
    assert summary.worst_seeds[0].seed == 2
    assert summary.rms_px["worst_axis"].mean == pytest.approx(0.02)


def test_nothing_held_is_nan_and_no_error():
    runs = {1: rig_result(result(math.nan, math.nan, math.nan))}
    summary = summarize(runs).loops["right"]

    assert math.isnan(summary.rms_px["az"].mean)


# ---------------------------------------------------------------- on this machine


def test_every_seed_of_a_campaign_is_the_run_that_it_is_alone(rig):
    progress = []
    with local_executor() as (executor, workers):
        results = run_campaign(rig, range(4, 8), RUN_S, executor, workers, progress.append)

    assert list(results) == [4, 5, 6, 7]
    assert progress[-1] == 4
    alone = simulate(rig, 6, RUN_S)["right"]
    assert results[6].loops["right"].vernier_s == pytest.approx(alone.vernier_s)
    assert results[6].loops["right"].rms_px == pytest.approx(alone.rms_px, rel=1e-9)


def test_without_the_batch_the_same_runs_are_simulated(rig, monkeypatch):
    def no_batch(_rig):
        raise BatchRefusalError("numba is not installed")

    quick = campaign.run_seeds(rig.model_dump_json(), [3], 12.0)
    campaign._runner.cache_clear()
    monkeypatch.setattr(campaign, "Batch", no_batch)
    slow = campaign.run_seeds(rig.model_dump_json(), [3], 12.0)
    reason = campaign.batch_refusal(rig.model_dump_json())
    campaign._runner.cache_clear()

    assert reason == "numba is not installed"
    one, other = slow[3].loops["right"], quick[3].loops["right"]
    assert one.acquired_s == other.acquired_s
    assert one.mode_times == pytest.approx(other.mode_times)


def test_a_worker_that_fails_ends_the_campaign_with_what_was_done(rig, monkeypatch):
    def broken(_json, seeds, _duration):
        if 1 in seeds:
            raise OSError("disk full")
        return {seed: rig_result(result(0.02, 0.02)) for seed in seeds}

    monkeypatch.setattr(campaign, "run_seeds", broken)
    with ThreadPoolExecutor(1) as executor, pytest.raises(CampaignError, match="disk full"):
        run_campaign(rig, range(3), RUN_S, executor, 1)


def test_simulate_runs_prints_one_json_object(capsys):
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "--runs", "3", "--duration", "20", "--controller", "eq20", "--json"])

    output = capsys.readouterr()
    printed = json.loads(output.out)
    summary = printed["loops"]["right"]
    assert ended.value.code == 0
    assert printed["batch_refusal"] is None
    assert "batch" not in output.err
    assert summary["runs"] == summary["held"] == 3
    assert set(summary["rms_px"]) == {"az", "el", "worst_axis"}
    assert {run["seed"] for run in summary["worst_seeds"]} == {0, 1, 2}


def test_runs_of_the_whole_testbed_print_each_loop_and_the_visibility(capsys):
    testbed = str(default_rig_path().parent / "fit-testbed.toml")
    with pytest.raises(SystemExit) as ended:
        main(["simulate", "--rig", testbed, "--runs", "2", "--duration", "70", "--json"])

    output = capsys.readouterr()
    printed = json.loads(output.out)
    assert ended.value.code == 0
    assert printed["batch_refusal"] is None
    assert list(printed["loops"]) == ["right", "metrology", "left"]
    beam = printed["loops"]["metrology"]
    assert beam["runs"] == beam["held"] == 2
    assert set(beam["rms_arcsec"]) == {"az", "el", "worst_axis"}
    assert 0.0 < printed["visibility"]["mean"] <= 1.0


def test_a_rig_that_the_batch_refuses_is_simulated_slowly_and_says_why_once(capsys):
    with pytest.raises(SystemExit):
        main(
            [
                "simulate", "--runs", "3", "--duration", "1", "--json",
                "--set", "interlocks.fsm_edge.action=flatten",
            ]
        )  # fmt: skip

    printed = capsys.readouterr()
    reason = "interlock fsm_edge may act, and the batch has no interlocks"
    assert json.loads(printed.out)["batch_refusal"] == reason
    assert printed.err.count(f"The batch simulator cannot run this rig: {reason}.") == 1
    assert "a hundred times slower" in printed.err


# ---------------------------------------------------------------- on a cluster


class Cluster:
    """A Dask scheduler and workers, each a process of its own, on 127.0.0.1."""

    def __init__(self, folder, workers):
        self.environment = os.environ | {"DASK_TEMPORARY_DIRECTORY": str(folder)}
        self.scheduler_file = folder / "scheduler.json"
        self.processes = [
            self._start(
                "scheduler", "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
                "--scheduler-file", str(self.scheduler_file),
            )
        ]  # fmt: skip
        while not self.scheduler_file.exists() or not self.scheduler_file.read_text():
            assert self.processes[0].poll() is None
            time.sleep(0.05)
        self.address = json.loads(self.scheduler_file.read_text())["address"]
        for _ in range(workers):
            self.processes.append(
                self._start(
                    "worker", self.address, "--host", "127.0.0.1", "--nthreads", "1",
                    "--no-dashboard", "--no-nanny", "--local-directory", str(folder),
                )
            )  # fmt: skip

    def _start(self, *arguments):
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *arguments],
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=self.environment,
        )

    def kill_worker(self):
        self.processes[1].send_signal(signal.SIGKILL)

    def __enter__(self):
        return self

    def __exit__(self, *_):
        for process in reversed(self.processes):
            process.terminate()
        for process in self.processes:
            try:
                process.wait(10)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def test_a_lost_worker_loses_no_run(rig, tmp_path):
    seeds = range(64)
    with ExitStack() as stack:
        cluster = stack.enter_context(Cluster(tmp_path, workers=2))
        executor, workers = stack.enter_context(dask_executor(cluster.address, workers=2))
        killed = []

        def on_progress(_done):
            if not killed:
                cluster.kill_worker()
                killed.append(True)

        results = run_campaign(rig, seeds, RUN_S, executor, workers, on_progress)

        assert killed
        assert workers == 2
        assert cluster.processes[1].wait(10) == -signal.SIGKILL
    assert list(results) == list(seeds)
    alone = simulate(rig, 63, RUN_S)["right"]
    assert results[63].loops["right"].rms_px == pytest.approx(alone.rms_px, rel=1e-9)


def test_no_scheduler_is_said_with_the_next_step(monkeypatch):
    monkeypatch.setattr(campaign, "_CONNECT_TIMEOUT_S", 0.5)
    with pytest.raises(CampaignError, match="dask scheduler"), dask_executor("tcp://127.0.0.1:1"):
        pass


def test_an_interrupted_campaign_does_not_wait_for_its_runs():
    def interrupted():
        with local_executor() as (executor, _):
            executor.submit(time.sleep, 60.0)
            time.sleep(2.0)
            raise KeyboardInterrupt

    begun_s = time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        interrupted()
    assert time.monotonic() - begun_s < 30


def test_a_campaign_whose_parent_is_killed_leaves_no_worker_behind():
    parent = subprocess.Popen(
        [sys.executable, "-m", "fitctl", "simulate", "--runs", "100000", "--duration", "60"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    workers = []
    try:
        begun_s = time.monotonic()
        # What multiprocessing itself starts are two; then come the workers.
        while len(workers) < 3 and time.monotonic() < begun_s + 60:
            workers = psutil.Process(parent.pid).children(recursive=True)
            time.sleep(0.1)
    finally:
        parent.kill()
        parent.wait()

    assert len(workers) >= 3
    assert psutil.wait_procs(workers, timeout=30)[1] == []


def test_an_address_that_is_none_is_one_line_at_once():
    begun_s = time.monotonic()
    with pytest.raises(CampaignError, match="nonsense"), dask_executor("nonsense"):
        pass
    assert time.monotonic() - begun_s < 10
