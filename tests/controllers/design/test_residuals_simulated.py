"""What the designs leave on the full nonlinear plant, under the whole supervisor."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.simulation.simulation import simulate

WORSE_STAGES = (
    "plant.loops.right.hysteresis.loop_width_fraction=0.30",
    "plant.loops.right.backlash_sky_arcsec=2.0",
)


def worst_axis_px(controller, seeds, duration_s, *overrides):
    """Mean over seeds of the worse axis's true residual."""
    rig = load_rig(default_rig_path(), [f"loops.right.vernier.controller={controller}", *overrides])
    runs = [simulate(rig, seed, duration_s)["right"].rms_px for seed in range(seeds)]
    return float(np.mean([max(run["az"], run["el"]) for run in runs]))


@pytest.fixture(scope="module")
def least_px(rig):
    return bound(basis(rig, "right")).residual_px


@pytest.mark.long
def test_one_short_run_is_near_the_bound(least_px):
    assert worst_axis_px("minimum-variance", 1, 45.0) < 1.15 * least_px


@pytest.mark.slow
def test_eq_20_leaves_0_019_px():
    assert worst_axis_px("eq20", 10, 120.0) == pytest.approx(0.019, abs=0.001)


@pytest.mark.slow
def test_minimum_variance_comes_within_8_percent_of_the_bound(least_px):
    assert worst_axis_px("minimum-variance", 10, 120.0) <= 1.08 * least_px


@pytest.mark.slow
def test_and_within_20_percent_on_stages_twice_as_bad_as_it_knows(least_px):
    assert worst_axis_px("minimum-variance", 10, 120.0, *WORSE_STAGES) <= 1.20 * least_px
