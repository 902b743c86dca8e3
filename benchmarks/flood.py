"""The loop's tick while its service is flooded, beside the tick while it is not, in one run.

Mocks, supervisor and recorder are processes of their own, the star is held in VERNIER, and floods take turns,
each in a process of its own that offers messages at a pace (10 000 a second by default). One flood goes
elsewhere: it costs the machine as much, and the service nothing. What the service does not take waits with its
sender.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from fitctl import demo
from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import LoopTiming, Tick
from fitctl.supervisor.keys import new_key

SETTLING_S = 1.0
FLOODS = {
    "nothing": "no flood",
    "elsewhere": "as many messages to another socket",
    "garbage": "garbage, Unix socket",
    "commands": "commands, Unix socket",
    "key": "commands, TCP, an allowed key",
    "stranger": "connections, TCP, a key that is not allowed",
}


class Window(NamedTuple):
    """What was seen while one flood ran."""

    ticks: list[Tick]
    timing: list[LoopTiming]
    offered: int
    sent: int


# ---------------------------------------------------------------- what the loop does meanwhile


def measure(options: argparse.Namespace) -> dict[str, Window]:
    """All floods in turn, several times over."""
    windows: dict[str, list[Window]] = defaultdict(list)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        settings = [
            "service.tcp_address=127.0.0.1",
            f"service.folder={folder / 's'}",
            f"service.keys_folder={folder / 'keys'}",
            f"logging.folder={folder / 'logs'}",
        ]
        key_file = folder / "key.toml"
        new_key(load_rig(default_rig_path(), settings), "flood", "commander", "", key_file)
        near = "plant.loops.right.star_offset_sky_arcsec_max=5.0"
        with demo.instrument(default_rig_path(), [*settings, near], seed=0) as running:
            demo.acquire(running)
            follow(running, lambda telemetry: telemetry.loops[0].mode == "VERNIER")
            for _ in range(options.rounds):
                for kind in FLOODS:
                    arguments = [kind, str(running.sockets), str(key_file), str(options.rate)]
                    windows[kind].append(one(running, kind, arguments, options.duration))
                    print(".", end="", file=sys.stderr, flush=True)
    return {
        kind: Window(
            [tick for window in some for tick in window.ticks],
            [timing for window in some for timing in window.timing],
            sum(window.offered for window in some),
            sum(window.sent for window in some),
        )
        for kind, some in windows.items()
    }


def follow(running: demo.Instrument, reached: Callable) -> None:
    """Receive telemetry until something is reached."""
    deadline_s = time.monotonic() + 120
    while time.monotonic() < deadline_s:
        telemetry = running.client.receive(0.5)
        if telemetry is not None and reached(telemetry):
            return
    raise SystemExit("the star was not held within 120 s; look at `fitctl demo`")


def one(running: demo.Instrument, kind: str, arguments: list[str], duration_s: float) -> Window:
    """The loop's records while one flood runs."""
    process = None
    if kind != "nothing":
        duration = str(duration_s + 2 * SETTLING_S)
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.flooder", *arguments, duration],
            stdout=subprocess.PIPE,
        )
        process.stdout.readline()  # it has begun
    time.sleep(SETTLING_S)
    while running.client.receive(0.0) is not None:
        pass  # what came before
    begun_s = time.monotonic()
    course = demo.watch(running, duration_s, lambda gone_s, telemetry: None)
    offered, sent = json.loads(process.communicate()[0]) if process else (0, 0)
    ticks = [tick for tick in course.ticks["right"] if tick.time_s >= begun_s]
    timing = [timing for timing in course.timing.values() if timing.time_s >= begun_s]
    return Window([tick for tick in ticks if tick.number >= 0], timing, offered, sent)


def spread(values: list[float], unit: float) -> str:
    """Median, 99 % and worst."""
    median, most, worst = np.percentile(values, [50, 99, 100]) * unit
    return f"{median:.2f} / {most:.2f} / {worst:.2f}"


def main() -> None:
    """Print a table: one line for each flood."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=10_000.0, help="messages offered a second")
    parser.add_argument("--duration", type=float, default=10.0, help="seconds of each flood")
    parser.add_argument("--rounds", type=int, default=3, help="how often each has its turn")
    options = parser.parse_args()
    windows = measure(options)
    print(
        "\n| flood | offered a second | sent a second | ticks in VERNIER % | compute ms "
        "| exposure to command ms | servo late ms |"
    )
    print("| --- | --- | --- | --- | --- | --- | --- |")
    for kind, seen in windows.items():
        lasted_s = options.rounds * (options.duration + 2 * SETTLING_S)
        servo = [timing.servo_late_median_s for timing in seen.timing]
        worst = max(timing.servo_late_worst_s for timing in seen.timing)
        print(
            f"| {FLOODS[kind]} | {seen.offered / lasted_s:.0f} | {seen.sent / lasted_s:.0f} "
            f"| {100 * float(np.mean([tick.mode == 'VERNIER' for tick in seen.ticks])):.0f} "
            f"| {spread([tick.compute_s for tick in seen.ticks], 1e3)} "
            f"| {spread([t.time_s - t.mid_exposure_s for t in seen.ticks], 1e3)} "
            f"| {1e3 * float(np.median(servo)):.2f} / {1e3 * worst:.2f} |"
        )


if __name__ == "__main__":
    main()
