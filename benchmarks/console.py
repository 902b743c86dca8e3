"""What a console costs: its share of a core, and what it does to the loop, beside the same without one.

The real instrument on its mocks, in VERNIER. Spells with a console on a terminal of its own take turns
with spells without one, in one run, so that what else the machine does meets both. Of each spell: the
console's processor time by wall time, and how late frames, ticks and servo were by the supervisor's records.
"""

from __future__ import annotations

import argparse
import fcntl
import json
import os
import pty
import select
import struct
import subprocess
import sys
import tempfile
import termios
import threading
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.recorder import processor_s
from fitctl import demo
from fitctl.config import default_rig_path
from fitctl.messages.client import Client
from fitctl.messages.modes import HOLDING
from fitctl.messages.telemetry import Telemetry

SETTLE_S = 8.0
WAIT_S = 120.0
NEAR = "plant.loops.right.star_offset_sky_arcsec_max=5.0"
HOLDING_NAMES = {mode.name for mode in HOLDING}
TICK_FIELDS = ("compute_s", "frame_age_s")


class Terminal:
    """A console on a pseudo terminal whose output is read and counted."""

    def __init__(self, sockets: Path, keys: str, columns: int, rows: int) -> None:
        self.bytes_read = 0
        self._main, side = pty.openpty()
        fcntl.ioctl(side, termios.TIOCSWINSZ, struct.pack("HHHH", rows, columns, 0, 0))
        self.process = subprocess.Popen(
            [sys.executable, "-m", "fitctl", "console", "--set", f"service.folder={sockets}"],
            stdin=side,
            stdout=side,
            stderr=side,
            start_new_session=True,
            env={**os.environ, "TERM": "xterm-256color", "COLORTERM": "truecolor"},
        )
        os.close(side)
        self._ended = threading.Event()
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        time.sleep(SETTLE_S)
        os.write(self._main, keys.encode())
        time.sleep(1.0)

    def _read(self) -> None:
        while not self._ended.is_set():
            if select.select([self._main], [], [], 0.2)[0]:
                try:
                    self.bytes_read += len(os.read(self._main, 65536))
                except OSError:  # the console has ended
                    return

    def close(self) -> None:
        """End the console."""
        self.process.terminate()
        self.process.wait(10.0)
        self._ended.set()
        self._reader.join()
        os.close(self._main)


def spell(client: Client, duration_s: float, pids: list[int]) -> dict[str, float]:
    """Listen for a while; figures of the loop, and processor time of some processes by wall time."""
    while client.receive(0.0) is not None:
        pass  # what came meanwhile
    end_s = time.monotonic() + duration_s
    used_s, begun_s = sum(map(processor_s, pids)), time.monotonic()
    heard: list[Telemetry] = []
    while time.monotonic() < end_s:
        telemetry = client.receive(0.5)
        if telemetry is not None:
            heard.append(telemetry)
    gone_s = time.monotonic() - begun_s
    used_s = sum(map(processor_s, pids)) - used_s
    ticks = [tick for telemetry in heard for tick in telemetry.ticks if tick.number >= 0]
    timing = {record.time_s: record for telemetry in heard for record in telemetry.timing}
    figures = {"cores": used_s / gone_s, "messages_hz": len(heard) / gone_s}
    for field in TICK_FIELDS:
        values = [getattr(tick, field) for tick in ticks]
        for name, percent in (("median", 50), ("99", 99)):
            figures[f"{field}_{name}"] = float(np.percentile(values, percent))
    figures["servo_late_median_s"] = float(
        np.median([record.servo_late_median_s for record in timing.values()])
    )
    figures["late_ticks_percent"] = 100 * sum(tick.late for tick in ticks) / len(ticks)
    return figures


def hold(running: demo.Instrument) -> None:
    """Acquire, and wait until every loop holds its star or its beam.

    Raises
    ------
    TimeoutError
    """
    demo.acquire(running)
    end_s = time.monotonic() + WAIT_S
    while time.monotonic() < end_s:
        telemetry = running.client.receive(0.5)
        if telemetry is not None and {loop.mode for loop in telemetry.loops} <= HOLDING_NAMES:
            return
    raise TimeoutError


def measure(
    duration_s: float, turns: int, keys: str, size: tuple[int, int], rig: Path
) -> dict[str, Any]:
    """Take turns; the median of each figure, with and without."""
    spells: dict[str, list[dict[str, float]]] = {"without": [], "with": []}
    written = 0.0
    with tempfile.TemporaryDirectory() as logs:
        settings = [NEAR, f"logging.folder={logs}"]
        with demo.instrument(rig, settings, seed=1) as running:
            hold(running)
            for _ in range(turns):
                spells["without"].append(spell(running.client, duration_s, []))
                terminal = Terminal(running.sockets, keys, *size)
                try:
                    before = terminal.bytes_read
                    spells["with"].append(spell(running.client, duration_s, [terminal.process.pid]))
                    written += (terminal.bytes_read - before) / duration_s / turns
                finally:
                    terminal.close()
    result: dict[str, Any] = {
        name: {key: float(np.median([one[key] for one in each])) for key in each[0]}
        for name, each in spells.items()
    }
    result["console_bytes_per_s"] = written
    return result


def main() -> None:
    """Print one table for each screen asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--duration", type=float, default=20.0, help="seconds of each spell")
    parser.add_argument("--turns", type=int, default=3, help="spells of each kind")
    parser.add_argument(
        "--keys", default="1", help="typed into the console first: 1 Operate, 3 Loop"
    )
    parser.add_argument("--size", default="120x40", help="of its terminal")
    parser.add_argument("--testbed", action="store_true", help="three loops instead of one")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    columns, rows = map(int, options.size.split("x"))
    rig = default_rig_path()
    rig = rig.with_name("fit-testbed.toml") if options.testbed else rig
    result = measure(options.duration, options.turns, options.keys, (columns, rows), rig)
    if options.json:
        print(json.dumps(result))
        return
    print(
        f"console: {result['with']['cores']:.3f} cores, {result['console_bytes_per_s'] / 1e3:.1f} kB/s"
    )
    for key in result["with"]:
        print(f"  {key:<24} without {result['without'][key]:.6g}  with {result['with'][key]:.6g}")


if __name__ == "__main__":
    main()
