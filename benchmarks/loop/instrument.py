"""fitctl's part: the instrument on its mocks at a rate, and where the time of its ticks goes."""

from __future__ import annotations

import subprocess
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from benchmarks.can import late_counts, start_cyclictest
from benchmarks.flood import hold
from fitctl import demo
from fitctl.config import Rig, default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.logging.records import Tick
from fitctl.mocks.bench import Residual, ResidualQuestion, ask_bench

LOOP = "right"
_SETTLE_S = 3.0
_STALL_US = 1000  # cyclictest kept waiting for longer is a stall of the machine
_NEAR = "plant.loops.right.star_offset_sky_arcsec_max=5.0"
# Exposed for half a period, in use 1.75 periods after the middle of the exposure, as in the laboratory.
_SLOWEST_OF_FLIGHT_HZ = 500.0


class Segment(NamedTuple):
    """One run at one rate.

    Attributes
    ----------
    times_us : dict of str to array, shape (ticks,)
        By what they last; what the table calls them.
    figures : dict
        Frames, lost and late ones, stalls of the machine, the residual and its bound.
    cyclictest_us : dict of int to int
        How many of cyclictest's wake-ups in the same time were late by so many us.
    """

    times_us: dict[str, NDArray[np.float64]]
    figures: dict[str, Any]
    cyclictest_us: dict[int, int]


def overrides(rate_hz: float) -> list[str]:
    """What makes the default rig one of this rate."""
    settings = [_NEAR, f"loops.{LOOP}.vernier.controller=minimum-variance"]
    if rate_hz >= _SLOWEST_OF_FLIGHT_HZ:
        settings += [
            f"camera.frame_rate_hz={rate_hz}",
            f"camera.exposure_s={0.5 / rate_hz}",
            f"camera.frame_delay_s={1.75 / rate_hz}",
        ]
    return settings


def measure(rate_hz: float, duration_s: float, seed: int) -> Segment:
    """Hold the star for `duration_s` at a rate, with cyclictest at the same pace beside it."""
    with tempfile.TemporaryDirectory(prefix="fitctl-bench-") as folder:
        settings = [
            *overrides(rate_hz),
            f"logging.folder={Path(folder) / 'logs'}",
            f"service.folder={Path(folder) / 's'}",
        ]
        rig = load_rig(default_rig_path(), settings)
        with demo.instrument(default_rig_path(), settings, seed) as running:
            demo.acquire(running)
            hold(running)
            demo.watch(running, _SETTLE_S, lambda *_: None)
            cyclictest = start_cyclictest(rate_hz, duration_s)
            course = demo.watch(running, duration_s, lambda *_: None)
            counts = {} if cyclictest is None else late_counts(_output(cyclictest))
            ticks = [tick for tick in course.ticks[LOOP] if tick.mode == "VERNIER"]
            residual_px = _true_residual_px(rig, running, ticks)
    return Segment(
        tick_times_us(ticks), _figures(rig, course, ticks, residual_px, counts, duration_s), counts
    )


def _true_residual_px(rig: Rig, running: demo.Instrument, ticks: list[Tick]) -> float:
    """RMS of the worst axis, from where the plant had the star; of the last 30 s at the most."""
    target, end_s = rig.stellar_loops[LOOP].target_px, ticks[-1].mid_exposure_s
    start_s = max(ticks[0].mid_exposure_s, end_s - demo.JUDGED_S)
    question = ResidualQuestion(LOOP, start_s, end_s, target.az, target.el)
    residual = ask_bench(running.bench_port, question, Residual)
    return max(residual.az_rms_px, residual.el_rms_px)


def _output(cyclictest: subprocess.Popen[str]) -> str:
    return cyclictest.communicate(timeout=30.0)[0]


def tick_times_us(ticks: list[Tick]) -> dict[str, NDArray[np.float64]]:
    """What the steps of each tick lasted; `received` is when the driver had the last packet of the frame."""
    columns = [
        (
            tick.mid_exposure_s + tick.frame_age_s,
            tick.sense_s,
            tick.decide_s,
            tick.dac_sent_s,
            tick.fsm_written_s,
        )
        for tick in ticks
    ]
    received_s, sense_s, decide_s, sent_s, confirmed_s = np.array(columns).T
    times_s = {
        "sense": sense_s,
        "decide": decide_s,
        "sense and decide": sense_s + decide_s,
        "last packet to request sent": sent_s - received_s,
        "the same without sense and decide": sent_s - received_s - sense_s - decide_s,
        "last packet to confirmation": confirmed_s - received_s,
    }
    return {name: 1e6 * values for name, values in times_s.items()}


def _figures(
    rig: Rig,
    course: demo.Course,
    ticks: list[Tick],
    residual_px: float,
    counts: dict[int, int],
    duration_s: float,
) -> dict[str, Any]:
    all_ticks = course.ticks[LOOP]
    stalled_s = sum(late * count for late, count in counts.items() if late > _STALL_US) / 1e6
    late = sum(tick.late for tick in all_ticks)
    return {
        "frames": len(all_ticks),
        "held": len(ticks),
        "frames_lost": all_ticks[-1].frames_lost - all_ticks[0].frames_lost,
        "frames_skipped": all_ticks[-1].frames_skipped - all_ticks[0].frames_skipped,
        "late_ticks": late,
        "stalled_s": stalled_s,
        "late_beyond_stalls_percent": max(
            0.0, 100 * (late / len(all_ticks) - stalled_s / duration_s)
        ),
        "residual_px": residual_px,
        "bound_px": bound(basis(rig, LOOP)).residual_px,
    }
