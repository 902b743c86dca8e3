"""What the testbed reaches while its collector moves, beside what it must: a table for docs/measurements.md.

Each run is what `fitctl simulate --json` runs: by the batch, or with `--simulate` tick by tick. A results
file is added to: runs that it has are not run again. All are judged over one span, from where the motion
begins; a sine of a picometre is a collector that stands still.
"""

from __future__ import annotations

import argparse
import functools
import json
import os
from collections.abc import Iterable
from concurrent.futures import ProcessPoolExecutor, as_completed
from pathlib import Path
from statistics import median
from typing import NamedTuple

from fitctl.config import Rig, load_rig
from fitctl.simulation.batch.batch import Batch
from fitctl.simulation.simulation import simulate_rig
from fitctl.simulation.statistics import MetrologyResult

RIG = Path(__file__).parent.parent / "rigs" / "fit-testbed.toml"
MOTIONS: dict[str, dict[str, str | float]] = {
    "still": {"kind": "sine", "amplitude_mm": 1e-9},
    "drift 0.1 mm/s": {"kind": "drift", "velocity_mm_s": 0.1},
    "sine 1 mm, 0.05 Hz": {"kind": "sine", "amplitude_mm": 1.0, "frequency_hz": 0.05},
    "sine 0.1 mm, 0.5 Hz": {"kind": "sine", "amplitude_mm": 0.1, "frequency_hz": 0.5},
    "random 0.2 mm/s, 5 s": {"kind": "random", "rms_mm_s": 0.2, "correlation_s": 5.0},
}
CONTROLLERS = ("eq20", "minimum-variance")
LARGEST_LEFT_RATIO = 1.4
LARGEST_LEFT_PX = 0.030  # with Eq. 20
LARGEST_BEAM_ARCSEC = 1.0
LARGEST_RIGHT_CHANGE = 0.02
LARGEST_UP_S = 60.0


class Case(NamedTuple):
    """One run: `gain` is the feedforward's."""

    motion: str
    controller: str
    gain: float
    seed: int

    def still(self) -> Case:
        """The same with the collector still and the feedforward on: what it is compared with."""
        return self._replace(motion="still", gain=1.0)


class Figures(NamedTuple):
    """What one run came to: the worst axis of each loop's RMS while the collector moves."""

    left_px: float
    right_px: float
    beam_arcsec: float
    visibility: float
    up_s: float


def run(case: Case, duration_s: float, *, tick_by_tick: bool = False) -> Figures:
    """Simulate one case."""
    if tick_by_tick:
        result = simulate_rig(_rig(*case[:3]), case.seed, duration_s)
    else:
        result = _batch(*case[:3]).result(case.seed, duration_s)
    worst: dict[str, float] = {}
    up_s: list[float] = []
    for name, loop in result.loops.items():
        if isinstance(loop, MetrologyResult):
            rms, held_s = loop.rms_arcsec, loop.locked_s
        else:
            rms, held_s = loop.rms_px, loop.vernier_s
        worst[name] = max(rms.values())
        up_s.append(held_s)
    return Figures(worst["left"], worst["right"], worst["metrology"], result.visibility, max(up_s))


@functools.lru_cache(maxsize=2)
def _batch(motion: str, controller: str, gain: float) -> Batch:
    return Batch(_rig(motion, controller, gain))


def _rig(motion_name: str, controller: str, gain: float) -> Rig:
    motion = MOTIONS[motion_name]
    overrides = [f"collector.motion.{key}={value}" for key, value in motion.items()]
    overrides += [f"loops.{loop}.vernier.controller={controller}" for loop in ("left", "right")]
    return load_rig(RIG, [*overrides, f"loops.left.feedforward.gain={gain}"])


def cases(seeds: int, seeds_without: int) -> list[Case]:
    """All cases; those of one rig follow each other, so that its batch is made once."""
    return [
        Case(motion, controller, gain, seed)
        for gain, count in ((1.0, seeds), (0.0, seeds_without))
        for motion in MOTIONS
        for controller in CONTROLLERS
        for seed in range(count)
    ]


def read_results(path: Path, duration_s: float) -> dict[Case, Figures]:
    """What the results file has of runs as long as these."""
    if not path.exists():
        return {}
    rows = map(json.loads, path.read_text().splitlines())
    return {
        Case(*row["case"]): Figures(*row["figures"])
        for row in rows
        if row["duration_s"] == duration_s
    }


def table(results: dict[Case, Figures]) -> str:
    """Markdown: one row for each gain, controller and motion; worst (median) over the seeds."""
    heads = (
        "feedforward", "controller", "collector", "seeds", "left px", "left / still", "right px",
        "right / still", "metrology arcsec", "visibility", "all up s", "goals",
    )  # fmt: skip
    lines = [f"| {' | '.join(heads)} |", "|" + " --- |" * len(heads)]
    groups = dict.fromkeys(case._replace(seed=-1) for case in sorted(results, key=_order))
    for group in groups:
        rows = {c: f for c, f in results.items() if c._replace(seed=-1) == group}
        lines.append(_row(group, rows, results))
    return "\n".join(lines)


def _order(case: Case) -> tuple[float, int, int]:
    return -case.gain, CONTROLLERS.index(case.controller), list(MOTIONS).index(case.motion)


def _row(group: Case, rows: dict[Case, Figures], results: dict[Case, Figures]) -> str:
    figures = list(rows.values())
    still = {case: results[case.still()] for case in rows if case.still() in results}
    left_ratios = [rows[case].left_px / one.left_px for case, one in still.items()]
    right_ratios = [rows[case].right_px / one.right_px for case, one in still.items()]
    left_px = [one.left_px for one in figures]
    beam_arcsec = [one.beam_arcsec for one in figures]
    goals = {
        "left / still": max(left_ratios) <= LARGEST_LEFT_RATIO,
        "left px": group.controller != "eq20" or max(left_px) <= LARGEST_LEFT_PX,
        "metrology": max(beam_arcsec) <= LARGEST_BEAM_ARCSEC,
        "right / still": max(abs(one - 1) for one in right_ratios) <= LARGEST_RIGHT_CHANGE,
        "all up": all(one.up_s <= LARGEST_UP_S for one in figures),
    }
    missed = ", ".join(goal for goal, met in goals.items() if not met)
    return (
        f"| {'on' if group.gain else 'off'} | {group.controller} | {group.motion} | {len(rows)} "
        f"| {_worst(left_px, 4)} | {_worst(left_ratios, 2)} "
        f"| {_worst((one.right_px for one in figures), 4)} | {_span(right_ratios)} "
        f"| {_worst(beam_arcsec, 2)} | {_lowest(one.visibility for one in figures)} "
        f"| {_worst((one.up_s for one in figures), 1)} | {f'not met: {missed}' if missed else 'met'} |"
    )


def _worst(values: Iterable[float], digits: int) -> str:
    values = list(values)
    return f"{max(values):.{digits}f} ({median(values):.{digits}f})"


def _lowest(values: Iterable[float]) -> str:
    values = list(values)
    return f"{min(values):.4f} ({median(values):.4f})"


def _span(ratios: list[float]) -> str:
    """The ratio farthest from 1, and the median."""
    farthest = max(ratios, key=lambda ratio: abs(ratio - 1))
    return f"{farthest:.3f} ({median(ratios):.3f})"


def main() -> None:
    """Simulate and print."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seeds", type=int, default=10, help="with the feedforward")
    parser.add_argument("--seeds-without", type=int, default=10, help="with its gain at 0")
    parser.add_argument("--duration", type=float, default=240.0, help="of each run, seconds")
    parser.add_argument("--workers", type=int, default=os.cpu_count())
    parser.add_argument("--results", type=Path, default=Path(".testbed-results.jsonl"))
    parser.add_argument("--simulate", action="store_true", help="tick by tick, not by the batch")
    arguments = parser.parse_args()
    results = read_results(arguments.results, arguments.duration)
    wanted = cases(arguments.seeds, arguments.seeds_without)
    with (
        ProcessPoolExecutor(arguments.workers) as pool,
        arguments.results.open("a", encoding="utf-8") as file,
    ):
        runs = {
            pool.submit(run, case, arguments.duration, tick_by_tick=arguments.simulate): case
            for case in wanted
            if case not in results
        }
        for done in as_completed(runs):
            results[runs[done]] = done.result()
            row = {"case": runs[done], "figures": done.result(), "duration_s": arguments.duration}
            print(json.dumps(row), file=file, flush=True)
    print("Worst (median) over the seeds; both RMS of the worst axis.\n")
    print(table({case: results[case] for case in wanted}))


if __name__ == "__main__":
    main()
