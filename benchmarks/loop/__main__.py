"""From a frame's last packet to the D/A: fitctl on its mocks, beside pyRTC and a floor in C, in one run.

All take turns, in rounds, so that a slow minute of the machine affects all of them. fitctl's times are from its
tick records; "last packet" is when the camera's driver has received it and the frame is complete. pyRTC has
no packets and no D/A: its time is from the frame in shared memory to the command in shared memory. cyclictest
runs beside each of fitctl's turns, at the same pace. Prints a table, then one JSON object on the last line.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.can import late_us
from benchmarks.loop.instrument import Segment, measure
from benchmarks.loop.others import PYRTC_WAYS, floor, pyrtc

RATES_HZ = (50.0, 500.0, 1000.0, 2000.0)
GOAL_HZ, FASTEST_HZ = 500.0, 2000.0
SENT = "last packet to request sent"
Row = dict[str, float]


def summary(values: np.ndarray) -> Row:
    """Median, 99 % and worst of times, shape (n,), leaving out ticks without them (a tick without a frame)."""
    values = values[np.isfinite(values)]
    p50, p99 = np.percentile(values, [50, 99])
    return {"p50_us": float(p50), "p99_us": float(p99), "max_us": float(values.max())}


def together(segments: list[Segment]) -> dict[str, Any]:
    """The segments of one rate as one; residual and bound are the worst segment's."""
    times = {
        name: summary(np.concatenate([segment.times_us[name] for segment in segments]))
        for name in segments[0].times_us
    }
    counts: Counter[int] = Counter()
    for segment in segments:
        counts.update(segment.cyclictest_us)
    if counts:
        p50, p99, worst = late_us(dict(counts))
        times["cyclictest beside it, late"] = {"p50_us": p50, "p99_us": p99, "max_us": worst}
    figures = [segment.figures for segment in segments]
    summed = {"frames", "held", "frames_lost", "frames_skipped", "late_ticks", "stalled_s"}
    merged = {
        key: (sum if key in summed else max)(each[key] for each in figures) for key in figures[0]
    }
    return {"times": times, **merged}


def measured(options: argparse.Namespace) -> dict[str, Any]:
    """Everything, in turns."""
    segments: dict[float, list[Segment]] = {rate_hz: [] for rate_hz in options.rates}
    floors: dict[str, list[np.ndarray]] = {}
    others: dict[str, list[Row]] = {}
    for turn in range(options.rounds):
        for rate_hz in options.rates:
            for name, values in floor(options.floor, rate_hz, options.duration / 4).items():
                floors.setdefault(f"{rate_hz:g} Hz, {name}", []).append(values)
            last = turn == options.rounds - 1
            lasts_s = options.longest if rate_hz == FASTEST_HZ and last else options.duration
            segments[rate_hz].append(measure(rate_hz, lasts_s, seed=turn))
            print(".", end="", file=sys.stderr, flush=True)
        for way in PYRTC_WAYS if options.pyrtc else ():
            row = pyrtc(options.pyrtc, options.pyrtc_example, GOAL_HZ, options.duration / 4, way)
            others.setdefault(f"{way[0]} real time, notify {way[1]}", []).append(row)
            print(".", end="", file=sys.stderr, flush=True)
    print(file=sys.stderr)
    result = {
        "fitctl": {f"{rate_hz:g} Hz": together(some) for rate_hz, some in segments.items()},
        "floor": {name: summary(np.concatenate(some)) for name, some in floors.items()},
        # Its own benchmark has no more than percentiles: the median of the rounds', and the worst of all.
        "pyrtc": {
            name: {key: float(_merge(key)([row[key] for row in rows])) for key in rows[0]}
            for name, rows in others.items()
        },
    }
    return result | {"goals": goals(result)}


def _merge(key: str) -> Any:
    return np.max if key == "max_us" else np.median


def goals(result: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """What was to be reached, what was, and whether it is enough; what was not measured is left out."""
    rows: list[tuple[str, float, float]] = []
    if at_goal := result["fitctl"].get(f"{GOAL_HZ:g} Hz"):
        sent = at_goal["times"][SENT]
        decided = at_goal["times"]["sense and decide"]["p50_us"]
        rows += [
            ("500 Hz, sense and decide, median us", decided, 90.0),
            ("500 Hz, last packet to request sent, median us", sent["p50_us"], 200.0),
            ("500 Hz, last packet to request sent, 99 % us", sent["p99_us"], 500.0),
        ]
        if result["pyrtc"]:
            best = min(row["p50_us"] for row in result["pyrtc"].values())
            rows.append(
                ("the same, beside half of pyRTC's best median, us", sent["p50_us"], best / 2)
            )
    if fastest := result["fitctl"].get(f"{FASTEST_HZ:g} Hz"):
        late, residual_px = fastest["late_beyond_stalls_percent"], fastest["residual_px"]
        rows += [
            ("2000 Hz, frames lost", fastest["frames_lost"], 0.0),
            ("2000 Hz, frames skipped", fastest["frames_skipped"], 0.0),
            ("2000 Hz, late ticks beyond stalls, %", late, 0.1),
            ("2000 Hz, residual over its bound", residual_px / fastest["bound_px"], 1.2),
        ]
    return {name: {"got": got, "at_most": most, "met": got <= most} for name, got, most in rows}


def table(result: dict[str, Any]) -> list[str]:
    """The result for people."""
    lines = [f"{'us':52}{'median':>10}{'99 %':>10}{'worst':>10}"]
    for rate, figures in result["fitctl"].items():
        lines += [_row(f"fitctl {rate}, {name}", row) for name, row in figures["times"].items()]
    lines += [_row(f"C {name}", row) for name, row in result["floor"].items()]
    lines += [_row(f"pyRTC {GOAL_HZ:g} Hz, {name}", row) for name, row in result["pyrtc"].items()]
    lines += ["", f"{'':12}" + "".join(f"{head:>12}" for head in _HEADS)]
    for rate, figures in result["fitctl"].items():
        cells = [f"{figures[key]:{form}}" for key, form in _HEADS.values()]
        lines.append(f"{rate:12}" + "".join(f"{cell:>12}" for cell in cells))
    lines += ["", f"{'goals':52}{'got':>10}{'at most':>10}"]
    for name, goal in result["goals"].items():
        met = "" if goal["met"] else "  not met"
        lines.append(f"{name:52}{goal['got']:10.3g}{goal['at_most']:10.3g}{met}")
    return lines


_HEADS = {
    "frames": ("frames", "d"),
    "lost": ("frames_lost", "d"),
    "skipped": ("frames_skipped", "d"),
    "late": ("late_ticks", "d"),
    "stalled s": ("stalled_s", ".3f"),
    "late % *": ("late_beyond_stalls_percent", ".3f"),
    "residual px": ("residual_px", ".4f"),
    "bound px": ("bound_px", ".4f"),
}


def _row(name: str, row: Row) -> str:
    return f"{name:52}" + "".join(f"{value:10.0f}" for value in row.values())


def main() -> None:
    """Print table and JSON."""
    parser = argparse.ArgumentParser(
        prog="benchmarks.loop", description=__doc__, formatter_class=argparse.RawTextHelpFormatter
    )
    parser.add_argument("--floor", type=Path, required=True, help="floor.c, compiled")
    parser.add_argument("--pyrtc", type=Path, help="Python of an environment with pyrtcao")
    parser.add_argument("--pyrtc-example", type=Path, help="examples/synthetic_shwfs of its source")
    parser.add_argument("--rates", type=float, nargs="+", default=RATES_HZ, metavar="HZ")
    parser.add_argument("--rounds", type=int, default=2)
    parser.add_argument("--duration", type=float, default=12.0, help="seconds of one turn")
    parser.add_argument(
        "--longest", type=float, default=60.0, help="seconds of the last turn at 2000 Hz"
    )
    result = measured(parser.parse_args())
    print("\n".join(table(result)))
    print(
        "* of the ticks, less the part of the time for which cyclictest was kept waiting over 1 ms"
    )
    print(json.dumps(result))


if __name__ == "__main__":
    main()
