"""The recorder under more than an instrument sends: what it costs, and what it loses.

A supervisor's queue in one process, the recorder in another, for each compression: ticks and 40x40 frames at
a pace (500 of each a second by default). Cores are the recorder's processor time by wall time, an offer is what
a record costs the supervisor. The log is on the disk of the folder that temporary files go to.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from fitctl.config import Logging, default_rig_path, load_rig
from fitctl.logging.queue import RecordQueue
from fitctl.logging.reading import log_info, read_records
from fitctl.logging.records import FrameRecord, RunInfo, Tick
from fitctl.logging.verifying import verify

PIXELS = 40
QUIET_S = 20.0

RECORDER = """
import signal, sys, threading
from pathlib import Path
from fitctl.config import Logging
from fitctl.logging.recorder import record

stop = threading.Event()
signal.signal(signal.SIGTERM, lambda *_: stop.set())
settings = Logging.model_validate_json(sys.argv[3])
record(sys.argv[1], settings, rig_name="bench", folder=Path(sys.argv[2]), stop=stop)
"""


def measure(settings: Logging, rate_hz: float, duration_s: float) -> dict[str, float]:
    """One run; figures by name."""
    with tempfile.TemporaryDirectory() as name:
        endpoint = f"ipc://{name}/records"
        queue = RecordQueue(endpoint, settings.queue_records)
        arguments = [endpoint, f"{name}/logs", settings.model_dump_json()]
        recorder = subprocess.Popen([sys.executable, "-c", RECORDER, *arguments])
        try:
            queue.offer(run_info())
            deadline_s = time.monotonic() + QUIET_S
            while queue.waiting and time.monotonic() < deadline_s:  # until it has started
                queue.pump()
                time.sleep(0.01)
            used_s, start_s = processor_s(recorder.pid), time.monotonic()
            own_s, most_waiting = feed(queue, rate_hz, duration_s)
            taken_s = time.monotonic() - start_s
            used_s = processor_s(recorder.pid) - used_s
            offered = 2 * round(rate_hz * duration_s)
            queue.close(timeout_s=QUIET_S)
        finally:
            recorder.terminate()
            recorder.wait(QUIET_S)
        paths = list(Path(f"{name}/logs").glob("*.mcap"))
        problems = [problem for path in paths for problem in verify(path).problems]
        if problems:
            raise SystemExit("; ".join(problems))
        topics = ("/fit/right/tick", "/fit/camera/frame")
        written = sum(log_info(path).counts.get(topic, 0) for path in paths for topic in topics)
        behind_s = [
            (entry.log_time_ns - entry.publish_time_ns) / 1e9
            for path in paths
            for entry in read_records(path, topics[:1])
        ]
        return {
            "cores": used_s / taken_s,
            "offer_us": 1e6 * own_s / offered,
            "missing": offered - written,
            "lost": queue.lost,
            "most_waiting": most_waiting,
            "behind_99_ms": 1e3 * float(np.percentile(behind_s, 99)),
            "behind_worst_ms": 1e3 * max(behind_s),
            "mb_per_hour": sum(path.stat().st_size for path in paths) / taken_s * 3600 / 1e6,
        }


def feed(queue: RecordQueue, rate_hz: float, duration_s: float) -> tuple[float, int]:
    """Offer ticks and frames at a pace; time spent offering, and the most that waited."""
    random = np.random.default_rng(0)
    pictures = [random.poisson(40, (PIXELS, PIXELS)).astype("<u2").tobytes() for _ in range(64)]
    own_s, most_waiting = 0.0, 0
    start_s = time.monotonic()
    for number in range(round(rate_hz * duration_s)):
        time.sleep(max(0.0, start_s + number / rate_hz - time.monotonic()))
        tick = example_tick(number, random.standard_normal())
        frame = FrameRecord(
            time_s=time.monotonic(),
            camera="camera",
            number=number,
            width_px=PIXELS,
            height_px=PIXELS,
            data=pictures[number % len(pictures)],
        )
        before_s = time.perf_counter()
        queue.offer(tick)
        queue.offer(frame)
        own_s += time.perf_counter() - before_s
        most_waiting = max(most_waiting, queue.waiting)
    return own_s, most_waiting


def example_tick(number: int, value: float) -> Tick:
    """A tick with a number in every field."""
    kinds = {float: value, int: number, bool: True, str: "right"}
    values: dict[str, Any] = {f.name: kinds[f.type] for f in msgspec.structs.fields(Tick)}
    return Tick(**values | {"time_s": time.monotonic()})


def run_info() -> RunInfo:
    """A run's description as large as a real one."""
    rig = load_rig(default_rig_path())
    return RunInfo(
        time_s=time.monotonic(),
        wall_minus_monotonic_s=time.time() - time.monotonic(),
        rig_name="bench",
        rig_json=rig.model_dump_json(),
        versions={},
        scheduling="",
    )


def processor_s(pid: int) -> float:
    """Processor time of a process so far, user and system."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def main() -> None:
    """Print one line for each compression."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rate", type=float, default=500.0, help="ticks, and frames, a second")
    parser.add_argument("--duration", type=float, default=20.0, help="seconds of each run")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    shipped = load_rig(default_rig_path()).logging
    for compression in ("zstd", "lz4", "none"):
        settings = shipped.model_copy(update={"compression": compression})
        figures = measure(settings, options.rate, options.duration)
        if options.json:
            print(json.dumps({"compression": compression} | figures), flush=True)
            continue
        print(
            f"{compression:4}  {figures['cores']:.3f} cores, {figures['offer_us']:.1f} us an offer; "
            f"missing {figures['missing']:.0f}, lost {figures['lost']:.0f}, "
            f"waiting {figures['most_waiting']:.0f} at most; to the recorder 99 % within "
            f"{figures['behind_99_ms']:.1f} ms, worst {figures['behind_worst_ms']:.1f} ms; "
            f"{figures['mb_per_hour']:.0f} MB an hour",
            flush=True,
        )


if __name__ == "__main__":
    main()
