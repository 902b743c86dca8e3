"""`make bench-loop` measures what it says: checked without the minutes that a run of it lasts."""

import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from benchmarks.can import late_counts, late_us
from benchmarks.loop.__main__ import RATES_HZ, goals, summary, table
from benchmarks.loop.instrument import LOOP, overrides, tick_times_us
from benchmarks.loop.others import floor
from fitctl.config import default_rig_path, load_rig
from fitctl.simulation.simulation import Simulation

SOURCE = Path(__file__).parents[2] / "benchmarks" / "loop" / "floor.c"


@pytest.mark.parametrize("rate_hz", RATES_HZ)
def test_every_rate_makes_a_rig_that_can_be_designed_for(rate_hz):
    rig = load_rig(default_rig_path(), overrides(rate_hz))
    assert rig.camera.frame_rate_hz == rate_hz
    assert rig.loops[LOOP].vernier.controller == "minimum-variance"


def test_the_time_to_the_request_is_parted_into_its_steps():
    simulation = Simulation(load_rig(default_rig_path(), overrides(50.0)), 0)
    simulation.acquire()
    simulation.run(0.5)
    times = tick_times_us([tick for tick in simulation.ticks if tick.number >= 0])
    sent, rest = times["last packet to request sent"], times["the same without sense and decide"]
    assert len(sent) > 10
    assert np.isfinite(sent).all()
    np.testing.assert_allclose(sent, rest + times["sense"] + times["decide"])
    assert (times["last packet to confirmation"] >= sent).all()


def test_the_floor_answers_every_frame(tmp_path):
    compiler = shutil.which("cc")
    assert compiler, "a C compiler is needed: Debian package gcc"
    program = tmp_path / "floor"
    subprocess.run(
        [compiler, "-O2", "-Wall", "-Wextra", "-Werror", "-o", program, SOURCE], check=True
    )
    times = floor(program, 500.0, 0.2)
    sent, confirmed, outside = times.values()
    assert len(sent) == 100
    assert (sent > 0).all()
    assert (sent < confirmed).all()
    assert (outside > 0).all()


def test_a_floor_without_its_frames_is_an_error(tmp_path):
    program = tmp_path / "floor"
    program.write_text("#!/bin/sh\necho 1 2 3\nexit 1\n")
    program.chmod(0o755)
    with pytest.raises(subprocess.CalledProcessError):
        floor(program, 500.0, 0.2)


def test_percentiles_of_cyclictest_are_of_all_its_wake_ups():
    counts = late_counts("# Histogram\n000003 000098\n000040 000001\n000900 000001\n# Total: 100\n")
    assert counts == {3: 98, 40: 1, 900: 1}
    assert late_us(counts) == [3.0, 40.0, 900.0]


def test_goals_compare_what_was_measured_with_what_was_to_be_reached():
    row = {"p50_us": 150.0, "p99_us": 510.0, "max_us": 900.0}
    figures = {
        "frames": 1000,
        "frames_lost": 0,
        "frames_skipped": 0,
        "late_ticks": 0,
        "stalled_s": 0.0,
        "late_beyond_stalls_percent": 0.05,
        "residual_px": 0.0030,
        "bound_px": 0.0020,
        "times": {
            "sense and decide": summary(np.array([80.0, np.nan, 82.0])),
            "last packet to request sent": row,
        },
    }
    result = {
        "fitctl": {"500 Hz": figures, "2000 Hz": figures},
        "floor": {},
        "pyrtc": {"soft": row | {"p50_us": 320.0}, "hard": row | {"p50_us": 290.0}},
    }
    result["goals"] = goals(result)
    met = {name: goal["met"] for name, goal in result["goals"].items()}
    assert met == {
        "500 Hz, sense and decide, median us": True,
        "500 Hz, last packet to request sent, median us": True,
        "500 Hz, last packet to request sent, 99 % us": False,
        "the same, beside half of pyRTC's best median, us": False,
        "2000 Hz, frames lost": True,
        "2000 Hz, frames skipped": True,
        "2000 Hz, late ticks beyond stalls, %": True,
        "2000 Hz, residual over its bound": False,
    }
    assert sum("not met" in line for line in table(result)) == 3
