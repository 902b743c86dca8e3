"""Stages whose axes have different gains: the scales undo them, and loops that know them hold the star."""

import numpy as np
import pytest

from fitctl.config import ConfigError, default_rig_path, load_rig
from fitctl.model.optics import scales
from fitctl.simulation.simulation import simulate

SIDEROSTAT = "axis_gains=[[1.3, 0.1], [-0.1, 0.7]]"
FSM = "axis_gains=[[0.7, 0.1], [0.2, 1.3]]"
KNOWN = [f"loops.right.siderostat.{SIDEROSTAT}", f"loops.right.fsm.{FSM}"]
TRUE = [f"plant.loops.right.siderostat_{SIDEROSTAT}", f"plant.loops.right.fsm_{FSM}"]
TURNED = ["loops.right.siderostat.rotation_deg=30.0", "loops.right.fsm.rotation_deg=-70.0"]
RADIANS = np.array([[0.3, -0.2], [1.0, 0.0], [0.0, -2.0]])


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


def scale_of(rig):
    return scales(rig, rig.loops["right"])


def test_motor_angles_and_pixels_lead_back_to_each_other():
    scale = scale_of(rig_with(*KNOWN, *TURNED))

    assert scale.motor_rad(scale.motor_px(RADIANS)) == pytest.approx(RADIANS, abs=1e-12)
    assert scale.mirror_px(RADIANS).dot(scale.mirror_back.T) == pytest.approx(
        scale.mirror_px_per_rad * RADIANS, rel=1e-9, abs=1e-6
    )


def test_without_gains_the_way_back_is_the_rotations_to_the_last_bit():
    scale = scale_of(rig_with(*TURNED))

    assert np.array_equal(scale.siderostat_back, scale.siderostat_turn.T)
    assert np.array_equal(scale.mirror_back, scale.mirror_turn.T)


def test_angles_on_the_sky_are_as_without_gains():
    even, uneven = scale_of(rig_with(*TURNED)), scale_of(rig_with(*KNOWN, *TURNED))

    assert np.array_equal(even.sky_px(RADIANS), uneven.sky_px(RADIANS))
    assert uneven.sky_arcsec(uneven.sky_px(RADIANS)) == pytest.approx(RADIANS, abs=1e-12)


@pytest.mark.long
@pytest.mark.parametrize("controller", ["eq20", "minimum-variance"])
def test_a_loop_that_knows_its_gains_holds_the_star_as_one_of_even_axes(controller):
    chosen = f"loops.right.vernier.controller={controller}"
    even = simulate(rig_with(chosen), 1, 35.0)["right"]
    known = simulate(rig_with(chosen, *KNOWN, *TRUE), 1, 35.0)["right"]

    for axis, even_px in even.rms_px.items():
        assert known.rms_px[axis] == pytest.approx(even_px, rel=0.15), axis


@pytest.mark.long
def test_a_loop_that_does_not_know_its_gains_holds_the_star_worse():
    even = simulate(rig_with(), 1, 35.0)["right"]
    unknown = simulate(rig_with(*TRUE), 1, 35.0)["right"]

    assert not max(unknown.rms_px.values()) < 1.2 * max(even.rms_px.values())


@pytest.mark.parametrize("stage", ["loops.right.fsm.", "plant.loops.right.fsm_"])
def test_gains_that_cannot_be_undone_are_an_error(stage):
    with pytest.raises(ConfigError, match=r"must have a determinant of at least 0\.1"):
        rig_with(f"{stage}axis_gains=[[1.0, 1.0], [1.0, 1.0]]")
