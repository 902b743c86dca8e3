"""The CAN servo cycle through driver and mock, beside cyclictest at the same pace and time.

Each period commands both motors and waits for both positions, as the servo does: absolute deadlines, FIFO
scheduling where permitted. The mock drive runs in a process of its own, with motors that cost it nothing.
Two processes and cyclictest share the machine with everything else: compare lines of one run only.
"""

from __future__ import annotations

import argparse
import asyncio
import multiprocessing
import shutil
import subprocess
import time
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from benchmarks.motors import StillMotors
from fitctl.clock import MonotonicClock
from fitctl.config import default_rig_path, load_rig
from fitctl.daemon.devices import AMPLIFIERS
from fitctl.drivers.interface import ServoAmplifiers
from fitctl.mocks.cia402.drive import Cia402DriveMock
from fitctl.mocks.event_loop import run_on_time
from fitctl.stages.realtime import become_realtime, lock_memory, quiet_interpreter

PRIORITY = 60
PERCENTILES = (50, 99, 100)


def serve(pipe: Connection) -> None:
    """A mock drive until the pipe says something; tells its port first."""

    async def run() -> None:
        siderostat = load_rig(default_rig_path()).loops["right"].siderostat
        mock = Cia402DriveMock(siderostat, StillMotors(), port=0)
        pipe.send(await mock.start())
        await asyncio.to_thread(pipe.recv)
        await mock.stop()

    run_on_time(run())


def cycle(amplifiers: ServoAmplifiers, rate_hz: float, duration_s: float) -> NDArray[np.float64]:
    """Each period's deadline, waking, and end of exchange (nan without a reading); shape (periods, 3)."""
    clock = MonotonicClock()
    period_s = 1 / rate_hz
    times_s = np.full((round(duration_s * rate_hz), 3), np.nan)
    deadline_s = clock.now_s() + period_s
    for row in times_s:
        clock.sleep_until(deadline_s)
        woke_s = clock.now_s()
        reading = amplifiers.exchange((0.0, 0.0))
        done_s = clock.now_s()
        fresh = reading is not None and reading.time_s > woke_s
        row[:] = deadline_s, woke_s, done_s if fresh else np.nan
        deadline_s += period_s * max(1, int((done_s - deadline_s) / period_s) + 1)
    return times_s


def start_cyclictest(rate_hz: float, duration_s: float) -> subprocess.Popen[str] | None:
    """Cyclictest with a histogram, one thread; None where it is not installed."""
    program = shutil.which("cyclictest")
    if program is None:
        return None
    pace = ["--interval", f"{1e6 / rate_hz:.0f}", "--loops", f"{duration_s * rate_hz:.0f}"]
    options = ["--quiet", "--mlockall", "--policy", "fifo", "--priority", str(PRIORITY)]
    return subprocess.Popen(
        [program, *options, *pace, "--histogram", "200000"], stdout=subprocess.PIPE, text=True
    )


def late_counts(histogram: str) -> dict[int, int]:
    """How many wake-ups were late by so many us, from cyclictest's histogram."""
    lines = [line.split() for line in histogram.splitlines() if line and line[0].isdigit()]
    return {int(late): int(count) for late, count in lines if int(count)}


def late_us(counts: dict[int, int]) -> list[float]:
    """Median, 99 % and worst of cyclictest's wake-ups, us."""
    total, seen = sum(counts.values()), 0
    found: list[float] = []
    for late in sorted(counts):
        seen += counts[late]
        while len(found) < len(PERCENTILES) and 100 * seen >= PERCENTILES[len(found)] * total:
            found.append(float(late))
    return found


def line(name: str, values: list[float]) -> str:
    """One line of the table, us."""
    return f"{name:44}" + "".join(f"{value:10.0f}" for value in values)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--duration", type=float, default=20.0, help="seconds")
    parser.add_argument("--rate", type=float, default=500.0, help="periods a second")
    arguments = parser.parse_args()
    here, there = multiprocessing.Pipe()
    process = multiprocessing.get_context("spawn").Process(target=serve, args=(there,))
    process.start()
    try:
        channel = f"socket://127.0.0.1:{here.recv()}"
        rig = load_rig(
            default_rig_path(),
            [
                f"loops.right.siderostat.device.channel='{channel}'",
                f"loops.right.siderostat.servo.rate_hz={arguments.rate}",
            ],
        )
        amplifiers = AMPLIFIERS["cia402"](rig.loops["right"].siderostat)
        amplifiers.open()
        amplifiers.enable()
        quiet_interpreter()
        print(f"{become_realtime(PRIORITY)}, {lock_memory()}")
        cyclictest = start_cyclictest(arguments.rate, arguments.duration)
        began_s = time.process_time()
        times_s = cycle(amplifiers, arguments.rate, arguments.duration)
        core = (time.process_time() - began_s) / arguments.duration
        amplifiers.close()
        here.send("stop")
    finally:
        process.join(10)
        process.kill()
    deadline_s, woke_s, done_s = times_s.T
    missed = int(np.isnan(done_s).sum())
    steps_s = np.abs(np.diff(woke_s) - np.diff(deadline_s))
    took_s = (done_s - woke_s)[~np.isnan(done_s)]
    print(f"{'us':44}{'median':>10}{'99 %':>10}{'worst':>10}")
    if cyclictest is None:
        print("cyclictest is not installed: Debian package rt-tests")
    else:
        print(line("cyclictest, late", late_us(late_counts(cyclictest.communicate(timeout=60)[0]))))
    print(line("servo cycle, late", list(1e6 * np.percentile(woke_s - deadline_s, PERCENTILES))))
    print(line("servo cycle, period error", list(1e6 * np.percentile(steps_s, PERCENTILES))))
    print(line("from waking to both positions", list(1e6 * np.percentile(took_s, PERCENTILES))))
    print(f"{len(times_s)} periods, {missed} without a reading in time, {core:.2f} cores here")


if __name__ == "__main__":
    main()
