"""The loop's tick while its service is flooded, beside the tick while it is not, in one run.

Mocks, supervisor and recorder are processes of their own, the star is held in VERNIER, and floods take turns,
each in a process of its own that offers messages at a pace (10 000 a second by default). One flood goes
elsewhere: it costs the machine as much, and the service nothing. What the service does not take waits with its
sender. Before each flood the star is held again, in case the one before, or the machine, has cost it.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import psutil

from benchmarks.recorder import processor_s
from fitctl import demo
from fitctl.config import default_rig_path, load_rig
from fitctl.logging.records import LoopTiming, Tick
from fitctl.messages.commands import Acquire, AnyCommand, Recover
from fitctl.messages.keys import new_key

SETTLING_S = 1.0
HOLD_S = 120.0
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
    supervisor_cpu_s: float
    gateway_cpu_s: float
    lasted_s: float


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
            for _ in range(options.rounds):
                for kind in FLOODS:
                    arguments = [kind, str(running.sockets), str(key_file), str(options.rate)]
                    windows[kind].append(one(running, kind, arguments, options.duration))
                    print(".", end="", file=sys.stderr, flush=True)
    return {kind: together(some) for kind, some in windows.items()}


def together(some: list[Window]) -> Window:
    """All windows of one flood as one."""
    columns: list[Any] = list(zip(*some, strict=True))
    ticks, timing, *sums = columns
    return Window(
        [tick for part in ticks for tick in part],
        [second for part in timing for second in part],
        *map(sum, sums),
    )


def hold(running: demo.Instrument) -> None:
    """Wait until the star is held, and see that it will be."""
    deadline_s, told = time.monotonic() + HOLD_S, ""
    towards: dict[str, AnyCommand] = {"SAFE": Recover(), "STANDBY": Acquire()}
    catch_up(running)
    while time.monotonic() < deadline_s:
        telemetry = running.client.receive(0.5)
        running.check()
        mode = "" if telemetry is None else telemetry.loops[0].mode
        if mode == "VERNIER":
            return
        if mode in towards:
            told = running.client.send(towards[mode]).text
            time.sleep(SETTLING_S)
            catch_up(running)
    raise SystemExit(
        f"the star was not held within {HOLD_S:g} s: {mode} {told}; look at `fitctl demo`"
    )


def catch_up(running: demo.Instrument) -> None:
    """Let go of telemetry that came before now."""
    while running.client.receive(0.0) is not None:
        pass


def cpu_s(pid: int) -> tuple[float, float]:
    """What supervisor and gateway have taken of a processor so far; a new gateway begins at nothing."""
    children = psutil.Process(pid).children()
    gateways = [child.pid for child in children if "gateway" in child.cmdline()]
    return processor_s(pid), sum(map(processor_s, gateways))


def one(running: demo.Instrument, kind: str, arguments: list[str], duration_s: float) -> Window:
    """The loop's records while one flood runs."""
    hold(running)
    pid = running.supervisor.pid
    process = None
    if kind != "nothing":
        duration = str(duration_s + 2 * SETTLING_S)
        process = subprocess.Popen(
            [sys.executable, "-m", "benchmarks.flooder", *arguments, duration],
            stdout=subprocess.PIPE,
        )
        assert process.stdout is not None  # noqa: S101  # a pipe, as asked for
        process.stdout.readline()  # it has begun
    time.sleep(SETTLING_S)
    catch_up(running)
    begun_s, before = time.monotonic(), cpu_s(pid)
    course = demo.watch(running, duration_s, lambda gone_s, telemetry: None)
    lasted_s, after = time.monotonic() - begun_s, cpu_s(pid)
    offered, sent = json.loads(process.communicate()[0]) if process else (0, 0)
    ticks = [tick for tick in course.ticks["right"] if tick.time_s >= begun_s]
    timing = [timing for timing in course.timing.values() if timing.time_s >= begun_s]
    supervisor_cpu_s, gateway_cpu_s = (
        max(0.0, now - then) for now, then in zip(after, before, strict=True)
    )
    return Window(ticks, timing, offered, sent, supervisor_cpu_s, gateway_cpu_s, lasted_s)


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
        "| exposure to command ms | servo late ms | supervisor, of a core | gateway, of a core |"
    )
    print("| --- " * 9 + "|")
    for kind, seen in windows.items():
        lasted_s = options.rounds * (options.duration + 2 * SETTLING_S)
        servo = [timing.servo_late_median_s for timing in seen.timing]
        worst = max(timing.servo_late_worst_s for timing in seen.timing)
        print(
            f"| {FLOODS[kind]} | {seen.offered / lasted_s:.0f} | {seen.sent / lasted_s:.0f} "
            f"| {100 * float(np.mean([tick.mode == 'VERNIER' for tick in seen.ticks])):.0f} "
            f"| {spread([tick.compute_s for tick in seen.ticks], 1e3)} "
            f"| {spread([t.time_s - t.mid_exposure_s for t in seen.ticks], 1e3)} "
            f"| {1e3 * float(np.median(servo)):.2f} / {1e3 * worst:.2f} "
            f"| {seen.supervisor_cpu_s / seen.lasted_s:.2f} | {seen.gateway_cpu_s / seen.lasted_s:.2f} |"
        )


if __name__ == "__main__":
    main()
