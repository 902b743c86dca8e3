"""Stacks that creep after a step: with the logarithm of time, whatever their hysteresis."""

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.model.optics import scales
from fitctl.model.plant import Plant

STILL_AIR = "plant.loops.right.air_path.gain_px=0.0"
STRAIGHT_STACKS = [
    "plant.loops.right.hysteresis.loop_width_fraction=0.0",
    "plant.loops.right.hysteresis.full_swing_stroke_m=8.0e-6",  # SF_PZT times 10 V
]


def rig_with(*overrides):
    return load_rig(default_rig_path(), [STILL_AIR, *overrides])


def creeping(part, *overrides):
    return rig_with(f"plant.loops.right.hysteresis.creep_per_decade={part}", *overrides)


def star_of(rig):
    """Whose stacks stand at their bias."""
    star = Plant(rig, [0], star_offset_px=np.zeros((1, 2)), history_s=1.0).stellar_loops["right"]
    star.advance(0.1)
    return star


def place_px(star, time_s):
    return star.spots_px(time_s)[0, 0].copy()


@pytest.mark.parametrize("part", [0.01, 0.02])
def test_a_step_goes_on_by_the_same_part_in_each_decade_of_time(part):
    star = star_of(creeping(part, *STRAIGHT_STACKS))
    rest_px = place_px(star, 0.1)
    star.inputs.stack_v[0] = [6.0, 5.0, 5.0]  # elevation

    at_s = np.array([0.5, 5.0, 50.0, 500.0])
    moved_px = np.array([place_px(star, 0.1 + time_s) - rest_px for time_s in at_s])[:, 1]

    sky_px = scales(rig_with(), rig_with().loops["right"]).mirror_px_per_rad
    step_px = sky_px * 8e-7 / (2 * 0.0225)
    assert np.diff(moved_px) / step_px == pytest.approx(part, rel=0.1)
    assert moved_px[0] == pytest.approx(step_px, rel=2 * part)


def test_stacks_at_their_bias_do_not_creep():
    star = star_of(creeping(0.02))

    assert place_px(star, 20.0) == pytest.approx(place_px(star, 19.5), abs=1e-12)


def test_creep_that_goes_back_leaves_nothing():
    star = star_of(creeping(0.02, *STRAIGHT_STACKS))
    rest_px = place_px(star, 0.1)
    star.inputs.stack_v[0, 0] = 6.0
    star.advance(10.0)
    star.inputs.stack_v[0, 0] = 5.0

    left_px = [abs(place_px(star, time_s) - rest_px)[1] for time_s in (10.5, 20.0, 600.0)]

    assert 0.2 > left_px[0] > left_px[1] > left_px[2]
    assert left_px[2] < 0.001


def test_stacks_that_do_not_creep_are_as_before():
    moved = []
    for rig in (rig_with(), creeping(0.0), creeping(1e-9)):
        star = star_of(rig)
        star.inputs.stack_v[0] = [8.0, 2.0, 6.0]
        moved.append(place_px(star, 3.0))

    assert np.array_equal(moved[0], moved[1])
    assert moved[0] == pytest.approx(moved[2], abs=1e-6)


def test_what_has_crept_does_not_depend_on_how_time_is_cut():
    ways = [], np.arange(0.1, 2.0, 0.0035), np.arange(0.1, 2.0, 0.0005)
    ends = []
    for cuts in ways:
        star = star_of(creeping(0.02))
        for time_s in [1.0, 1.0125]:
            for cut_s in cuts:
                if star.time_s < cut_s < time_s:
                    star.advance(cut_s)
            star.advance(time_s)
            star.inputs.stack_v[0] = [5.0 + time_s, 3.0 * time_s, 4.0]
        for cut_s in cuts:
            star.advance(cut_s)
        ends.append([place_px(star, time_s) for time_s in (1.5, 1.9975)])

    for end in ends[1:]:
        assert np.array(end) == pytest.approx(np.array(ends[0]), abs=1e-12)


def test_the_pistons_creep_is_that_of_the_stacks():
    star = star_of(creeping(0.02, *STRAIGHT_STACKS))
    star.inputs.stack_v[0] = 6.0
    star.advance(0.7)
    early_m = star.history_piston_m(0.6, 0.6)[0, 0]
    star.advance(5.1)

    late_m = star.history_piston_m(5.1, 5.1)[0, 0]

    assert (late_m - early_m) / 8e-7 == pytest.approx(0.02, rel=0.1)
