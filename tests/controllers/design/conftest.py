import dataclasses

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.basis import basis

FLIGHT = ["camera.frame_rate_hz=500.0", "camera.exposure_s=0.001", "camera.frame_delay_s=0.0035"]


@pytest.fixture(scope="session")
def fit():
    """FIT's right loop."""
    return basis(load_rig(default_rig_path()), "right")


@pytest.fixture(scope="session")
def flight():
    """The same loop at the flight rate."""
    return basis(load_rig(default_rig_path(), FLIGHT), "right")


@pytest.fixture(scope="session")
def changed():
    """A basis with another air path or delay."""

    def change(basis, *, delay_s=0.0, gain=1.0):
        air = basis.air_path.model_copy(update={"gain_px": basis.air_path.gain_px * gain})
        return dataclasses.replace(basis, delay_s=basis.delay_s + delay_s, air_path=air)

    return change
