"""What the predicting pairs make of a plant that is not what the rig file says, hysteresis and all."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis
from fitctl.controllers.design.linear_loop.bound import bound
from fitctl.simulation.batch.batch import Batch

pytestmark = pytest.mark.long

pytest.importorskip("numba")
SEEDS = range(6)


def truth_over_bound(controller, *truth):
    """Residual, worst axis, mean of some runs of 120 s, over what no controller could go below."""
    rig = load_rig(default_rig_path(), [f"loops.right.vernier.controller={controller}", *truth])
    batch = Batch(rig)
    rms_px = [max(batch.result(seed, 120.0).loops["right"].rms_px.values()) for seed in SEEDS]
    told = [
        text.replace("plant.loops.right.air_path", "loops.right.vernier.air_path").replace(
            "plant.frame_delay_s", "camera.frame_delay_s"
        )
        for text in truth
        if "gain_px" in text or "frame_delay_s" in text
    ]
    least = bound(basis(load_rig(default_rig_path(), told), "right"))
    return np.mean(rms_px) / least.residual_px


@pytest.mark.parametrize("controller", ["minimum-variance", "fslq"])
@pytest.mark.parametrize(
    ("truth", "most"),
    [
        ([], 1.08),
        (["plant.frame_delay_s=0.032"], 1.08),
        (["plant.frame_delay_s=0.038"], 1.08),
        (["plant.loops.right.air_path.gain_px=0.225"], 1.2),
        (["plant.loops.right.air_path.gain_px=0.9"], 1.2),
        (
            [
                "plant.loops.right.hysteresis.loop_width_fraction=0.30",
                "plant.loops.right.backlash_sky_arcsec=2.0",
            ],
            1.2,
        ),
    ],
    ids=[
        "as the rig file says",
        "3 ms quicker",
        "3 ms slower",
        "half the disturbance",
        "twice the disturbance",
        "twice the hysteresis and backlash",
    ],
)
def test_the_predicting_pairs_stay_near_the_bound(controller, truth, most):
    assert truth_over_bound(controller, *truth) < most
