"""The whole testbed over wires: three loops come up and hold while the hexapod moves the collector."""

import json
import subprocess

import pytest

from ..conftest import fitctl, nothing_was_lost_without_a_stall


@pytest.fixture
def demo(tmp_path):
    demo = fitctl(
        "demo",
        "--testbed",
        "--headless",
        "--json",
        *("--duration", 75),
        *("--seed", 3),
        *("--set", "collector.motion.kind=sine"),
        *("--set", f"logging.folder={tmp_path}"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    yield demo
    demo.kill()
    demo.communicate()


def test_three_loops_hold_over_wires_while_the_collector_moves(demo):
    printed, errors = demo.communicate(timeout=200)
    assert demo.returncode == 0, errors
    whole = json.loads(printed.splitlines()[-1])

    loops = whole["loops"]
    assert list(loops) == ["right", "metrology", "left"]
    assert all(loop["judged_s"] == pytest.approx(30.0, abs=0.1) for loop in loops.values())
    held_s = [
        loops["right"]["vernier_s"],
        loops["metrology"]["locked_s"],
        loops["left"]["vernier_s"],
    ]
    assert max(held_s) < 60.0  # of which the processes take some ten seconds to start
    for name in ("right", "left"):
        assert max(loops[name]["rms_px"].values()) < 0.03
    assert max(loops["metrology"]["rms_arcsec"].values()) < 1.0
    assert whole["visibility"] > 0.95
    assert whole["frames"] > 3000
    assert nothing_was_lost_without_a_stall(whole)


def test_the_testbed_is_a_rig_of_its_own(tmp_path):
    demo = fitctl(
        *("demo", "--testbed", "--rig", tmp_path / "my.toml", "--headless"),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
    )
    _, errors = demo.communicate(timeout=60)
    assert demo.returncode == 2
    assert (
        "demo: --testbed is the rig rigs/fit-testbed.toml; leave out --testbed, or --rig" in errors
    )
