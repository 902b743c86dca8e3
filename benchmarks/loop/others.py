"""What fitctl is measured beside: a floor in C, and pyRTC's pipeline in an environment of its own."""

from __future__ import annotations

import json
import os
import subprocess
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_LOOP_PRIORITY, _PEER_PRIORITY = 50, 40  # as fitctl's supervisor and its mocks
_START_S = 120.0  # compiling included
FLOOR_TIMES = (
    "last packet to request sent",
    "last packet to confirmation",
    "last packet's departure to command's arrival",
)
# How its components share the machine (threads, or a process each), and whether streams wake their readers or
# are polled. The first is what it does by itself.
PYRTC_WAYS = (("soft", "on"), ("soft", "off"), ("hard", "off"))


def floor(program: Path, rate_hz: float, duration_s: float) -> dict[str, NDArray[np.float64]]:
    """Times of the loop in C, us, shape (frames,) each.

    Raises
    ------
    subprocess.SubprocessError
        If it fails, or frames are missing.
    """
    words = [str(word) for word in (rate_hz, duration_s, _LOOP_PRIORITY, _PEER_PRIORITY)]
    done = subprocess.run(
        [program, *words], capture_output=True, text=True, check=True, timeout=duration_s + 30
    )
    rows = np.array([line.split() for line in done.stdout.splitlines()], dtype=float)
    return dict(zip(FLOOR_TIMES, 1e-3 * rows.T, strict=True))


def pyrtc(
    python: Path, example: Path, rate_hz: float, duration_s: float, way: tuple[str, str]
) -> dict[str, float]:
    """Median, 99 % and worst of pyRTC's own benchmark, us: from the sensor's frame to the corrector's command.

    Its simulated sensor runs at the same rate, without the science camera of its example.

    Raises
    ------
    subprocess.SubprocessError
        If it fails.
    """
    mode, notify = way
    with tempfile.TemporaryDirectory() as folder:
        report = Path(folder) / "report.json"
        options = {
            "--modes": mode,
            "--notify": notify,
            "--samples": round(rate_hz * duration_s),
            "--frame-rate-hz": rate_hz,
            "--settle": 1.0,
            "--timeout": _START_S,
            "--example-dir": example.absolute(),
            "--output": report,
        }
        words = [str(word) for option in options.items() for word in option]
        subprocess.run(
            # From a folder without benchmarks of its own: pyRTC's package has that name too.
            [python.absolute(), "-m", "benchmarks.pipeline_latency_bench", "--no-psf", *words],
            cwd=folder,
            env=os.environ | {"OPENBLAS_NUM_THREADS": "1"},
            capture_output=True,
            check=True,
            timeout=2 * _START_S,
        )
        total = json.loads(report.read_text())["summary"][0]["total"]
    return {key: total[key] for key in ("p50_us", "p99_us", "max_us")}
