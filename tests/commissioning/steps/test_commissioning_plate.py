"""What measured motions of the star make of the rig file: order, signs, rotation, scale."""

import itertools
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from commissioning.motor_bench import RIG, BenchAmplifiers, site_of
from hypothesis import assume, example, given, settings
from hypothesis import strategies as st

from fitctl.clock import VirtualClock
from fitctl.commissioning.outcome import BEFORE, StepError
from fitctl.commissioning.steps.mirror import _mirror_outcome
from fitctl.commissioning.steps.motors import Motors
from fitctl.commissioning.steps.plate import (
    _flipped,
    _refuse_meeting,
    _rough,
    _siderostat_outcome,
    own_star,
    similar,
)
from fitctl.commissioning.steps.sky import Watch, square_spiral
from fitctl.config import default_rig_path, load_rig
from fitctl.config.wiring import AmplifierWiring
from fitctl.controllers.centroid import Star
from fitctl.model.optics import rotation, scales

STRAIGHT = np.array([[0.0, 1.0], [1.0, -1.0], [-1.0, 0.0]])
"""Where stack 1, 2 and 3 move a star, in units of their stroke."""
degrees = st.floats(-170.0, 170.0)
scale = st.floats(0.5, 2.0)


def found(outcome, stage):
    return outcome.found.get("loops", {}).get("right", {}).get(stage, {})


def apart_deg(a, b):
    return abs((a - b + 180) % 360 - 180)


@given(degrees, scale)
def test_a_turned_siderostat_gets_its_rotation_and_its_gear(turned, size):
    outcome = _siderostat_outcome(site_of(), size * rotation(turned), 0.0)
    said = found(outcome, "siderostat")
    assert apart_deg(said.get("rotation_deg", 0.0), turned) <= 5.0
    gear = RIG.loops["right"].siderostat.spur_gear_ratio
    assert said.get("spur_gear_ratio", gear) * size == pytest.approx(gear, rel=0.09)
    assert "wiring" not in said


@given(degrees, st.sampled_from([[-1.0, 1.0], [1.0, -1.0]]))
def test_a_mirror_image_becomes_a_wiring_with_which_the_rest_is_a_rotation(turned, hand):
    seen = rotation(turned) @ np.diag(hand)
    said = found(_siderostat_outcome(site_of(), seen, 0.0), "siderostat")
    wiring = AmplifierWiring(**said["wiring"])
    assert wiring.velocity_signs == wiring.encoder_signs  # angles change their hand, not the servo
    undo = np.diag(wiring.encoder_signs) if wiring.axes == [0, 1] else np.array([[0, 1], [1, 0]])
    left = seen @ undo
    assert np.linalg.det(left) > 0
    assert apart_deg(similar(left).rotation_deg, said.get("rotation_deg", 0.0)) <= 5.0


def test_axes_of_different_gains_become_axis_gains():
    seen = rotation(20.0) @ np.array([[1.3, 0.0], [0.0, 0.9]])
    said = found(_siderostat_outcome(site_of(), seen, 0.0), "siderostat")
    again = rotation(said["rotation_deg"]) @ np.array(said["axis_gains"])
    assert again == pytest.approx(seen, abs=0.01)


def rig_with(stage, **keys):
    """The default rig with other keys of one of its stages; those that are None are left out."""
    overrides = [
        f"loops.right.{stage}.{key}={value}" for key, value in keys.items() if value is not None
    ]
    return load_rig(default_rig_path(), overrides)


def corrected(rig, stage, said):
    """The rig with what a step found of a stage laid over."""
    loop = rig.loops["right"]
    settings = getattr(loop, stage).model_copy(update=said)
    return rig.model_copy(update={"loops": {"right": loop.model_copy(update={stage: settings})}})


def px_per_rad(rig):
    """How far the motors move the star by the rig file, without rotation and gains."""
    return scales(rig, rig.loops["right"]).motor_px_per_rad


@st.composite
def gains(draw, least, most, across):
    (a, d), (b, c) = (
        [draw(st.floats(*ends)) for _ in "ab"] for ends in ((least, most), (-across, across))
    )
    return [[a, b], [c, d]]


@pytest.mark.parametrize("seen", [np.eye(2), np.diag([0.77, 1.3])])
def test_wrong_gains_in_the_rig_file_are_found_also_if_they_are_as_uneven_as_the_true_ones(seen):
    rig = rig_with("siderostat", axis_gains=[[1.3, 0.0], [0.0, 0.77]])

    outcome = _siderostat_outcome(site_of(rig), seen, 0.0)

    assert found(outcome, "siderostat") == {"axis_gains": seen.tolist()}
    assert "the ratio of the axes' gains differs from the rig file's" in outcome.lines[-1]


def assert_corrected(off, said, *, scale_apart):
    """What is left of a stage's response is exact with new gains, and within the limits without."""
    if "axis_gains" in said:
        assert off == pytest.approx(np.eye(2), abs=0.005)
    parts = similar(off)
    assert abs(parts.rotation_deg) <= 5.06
    assert parts.scale == pytest.approx(1.0, abs=scale_apart)
    assert parts.uneven <= 1.151


@settings(deadline=None)
@given(st.none() | gains(0.75, 1.35, 0.1), degrees, gains(0.75, 1.35, 0.1), degrees)
@pytest.mark.long
def test_with_what_is_found_the_siderostat_of_any_rig_file_has_the_measured_response(
    rig_gains, rig_deg, true_gains, true_deg
):
    rig = rig_with("siderostat", rotation_deg=rig_deg, axis_gains=rig_gains)
    seen = rotation(true_deg) @ np.array(true_gains)

    said = found(_siderostat_outcome(site_of(rig), seen, 0.0), "siderostat")

    again = corrected(rig, "siderostat", said)
    over = px_per_rad(rig) / px_per_rad(again)
    model = scales(again, again.loops["right"]).siderostat_turn
    off = seen * over @ np.linalg.inv(model)
    assert_corrected(off, said, scale_apart=0.081)
    repeated = _siderostat_outcome(site_of(again), seen * over, 0.0)
    assert found(repeated, "siderostat") == {}


ALIKE = [[1.1875, 0.0], [0.0, 0.859375]], 0.0, [[0.859375, 0.0], [0.0625, 1.1875]], 0.0, 1.0
"""Axes so uneven that stacks exchanged in a circle would move the star almost alike."""


def test_stacks_that_may_be_exchanged_are_left_as_the_rig_file_has_them_with_a_remark():
    rig_gains, _, true_gains, _, _ = ALIKE
    rig = rig_with("fsm", axis_gains=rig_gains)
    expected = STRAIGHT @ np.array(rig_gains).T

    outcome = _mirror_outcome(site_of(rig), STRAIGHT @ np.array(true_gains).T, expected, 0.0)

    remark = "the amplifier's outputs 1, 2, 3 may also be on stacks 2, 3, 1; check the cables"
    assert remark in outcome.lines
    assert found(outcome, "fsm").keys() == {"axis_gains"}


@settings(deadline=None)
@example(*ALIKE)
@given(
    st.none() | gains(0.85, 1.2, 0.08), degrees, gains(0.85, 1.2, 0.08), st.floats(-30.0, 30.0),
    st.floats(0.6, 1.5),
)  # fmt: skip
@pytest.mark.long
def test_with_what_is_found_the_mirror_of_any_rig_file_has_the_measured_response(
    rig_gains, rig_deg, true_gains, by_deg, size
):
    rig = rig_with("fsm", rotation_deg=rig_deg, axis_gains=rig_gains)
    expected = scales(rig, rig.loops["right"]).mirror_turn
    truth = size * rotation(rig_deg + by_deg) @ np.array(true_gains)

    outcome = _mirror_outcome(site_of(rig), STRAIGHT @ truth.T, STRAIGHT @ expected.T, 0.0)

    said = found(outcome, "fsm")
    assert "dac" not in said
    again = corrected(rig, "fsm", said)
    off = truth @ np.linalg.inv(scales(again, again.loops["right"]).mirror_turn)
    assert_corrected(off, said, scale_apart=0.161)


@pytest.mark.parametrize("seen", [1.4 * np.eye(2), np.diag([1.2, 1.7])])
def test_a_focal_length_that_explains_both_scales_leaves_the_siderostat_s_response(seen):
    """The siderostat's step puts the scale into the gear, or into the gains of uneven axes."""
    first = _siderostat_outcome(site_of(), seen, 0.0)
    rig = corrected(RIG, "siderostat", found(first, "siderostat"))
    figures = {f"right.siderostat.{key}{BEFORE}": value for key, value in first.figures.items()}
    size = first.figures["scale_over_expected"]

    outcome = _mirror_outcome(
        replace(site_of(rig), figures=figures), size * STRAIGHT, STRAIGHT, 0.0
    )

    again = corrected(rig, "siderostat", found(outcome, "siderostat"))
    optics = again.optics.model_copy(update=outcome.found["optics"])
    again = again.model_copy(update={"optics": optics})
    response = [
        px_per_rad(each) * scales(each, each.loops["right"]).siderostat_turn
        for each in (rig, again)
    ]
    assert response[1] == pytest.approx(response[0], rel=1e-3)
    siderostat = again.loops["right"].siderostat
    assert siderostat.spur_gear_ratio == pytest.approx(
        RIG.loops["right"].siderostat.spur_gear_ratio
    )


def test_axes_of_a_mirror_that_are_even_replace_the_gains_of_the_rig_file():
    uneven = np.diag([1.3, 0.77])
    rig = rig_with("fsm", axis_gains=uneven.tolist())

    outcome = _mirror_outcome(site_of(rig), STRAIGHT, STRAIGHT @ uneven, 0.0)

    assert found(outcome, "fsm") == {"axis_gains": [[1.0, 0.0], [0.0, 1.0]]}


def test_exchanged_axes_keep_the_signs_that_were_found_before():
    wiring = AmplifierWiring(axes=[0, 1], velocity_signs=[1, -1], encoder_signs=[1, 1])
    loop = RIG.loops["right"]
    siderostat = loop.siderostat.model_copy(update={"wiring": wiring})
    rig = RIG.model_copy(
        update={"loops": {"right": loop.model_copy(update={"siderostat": siderostat})}}
    )
    flipped = _flipped(site_of(rig), np.array([[0.0, 1.0], [1.0, 0.0]]))
    assert flipped == {"axes": [1, 0], "velocity_signs": [-1, 1], "encoder_signs": [1, 1]}


@given(st.permutations([0, 1, 2]), st.floats(-4.0, 4.0), st.floats(0.9, 1.1))
def test_stacks_in_any_order_are_told_apart(order, turned, size):
    seen = size * (STRAIGHT[list(order)] @ rotation(turned).T)
    said = found(_mirror_outcome(site_of(), seen, STRAIGHT, 0.0), "fsm")
    channels = said.get("dac", {"channels": [1, 2, 3]})["channels"]
    assert [order[channel - 1] for channel in channels] == [0, 1, 2]
    assert channels == said.get("piezo", {"channels": [1, 2, 3]})["channels"]


@given(degrees)
def test_a_turned_mirror_gets_its_rotation(turned):
    said = found(_mirror_outcome(site_of(), STRAIGHT @ rotation(turned).T, STRAIGHT, 0.0), "fsm")
    assert apart_deg(said.get("rotation_deg", 0.0), turned) <= 5.05
    assert "dac" not in said


@given(degrees)
def test_a_mirror_image_is_two_stacks_exchanged_and_a_rotation(turned):
    seen = STRAIGHT @ (rotation(turned) @ np.diag([-1.0, 1.0])).T
    said = found(_mirror_outcome(site_of(), seen, STRAIGHT, 0.0), "fsm")
    assert said["dac"]["channels"] == [3, 2, 1]
    assert (
        apart_deg(said.get("rotation_deg", 0.0), turned + 90) <= 5.05
        or apart_deg(said.get("rotation_deg", 0.0), turned - 90) <= 5.05
    )


def test_a_stack_that_moves_no_star_is_named():
    seen = STRAIGHT * [[1.0], [1.0], [0.01]]
    with pytest.raises(StepError, match="stack 3"):
        _mirror_outcome(site_of(), seen, STRAIGHT, 0.0)


@given(st.integers(1, 6))
def test_the_spiral_visits_every_place_once_by_neighbours(turns):
    places = [(0, 0), *square_spiral(turns)]
    assert len(set(places)) == len(places) == (2 * turns + 1) ** 2
    assert all(abs(a - c) + abs(b - d) == 1 for (a, b), (c, d) in itertools.pairwise(places))


@given(degrees, scale)
def test_a_rotation_with_a_scale_is_taken_apart(turned, size):
    assume(abs(turned) < 170)
    parts = similar(size * rotation(turned))
    assert parts == pytest.approx((size, turned, 1.0))


RIGHT_PX, LEFT_PX = np.array([30.0, 21.0]), np.array([11.0, 19.0])
TARGET_PX = np.array([28.0, 20.0])


def test_a_star_is_not_sent_where_another_one_is():
    """As where two loops' amplifiers are exchanged."""
    with pytest.raises(StepError, match="another star"):
        _refuse_meeting(site_of(), [LEFT_PX, RIGHT_PX], LEFT_PX, TARGET_PX)
    _refuse_meeting(site_of(), [LEFT_PX, RIGHT_PX], RIGHT_PX, TARGET_PX)
    _refuse_meeting(site_of(), [LEFT_PX], LEFT_PX, TARGET_PX)


def test_no_star_on_the_frame_is_one_clear_line():
    dark = SimpleNamespace(goal_rad=np.zeros(2), turn_to=lambda _: None, places_px=list)
    with pytest.raises(StepError, match="no star is on the frame any more"):
        _rough(site_of(), dark, 0)


class TwoStars(Watch):
    """A bright star of the other loop, and a dimmer one that this loop's motors move."""

    def __init__(self, site, light):
        self.bench = BenchAmplifiers(site.clock)
        self.bench.enable()
        super().__init__(site, None, Motors(self.bench, 0.002, site.clock))
        self._px_of_a_rad = scales(site.rig, site.loop).motor_px_per_rad
        self._light = light

    def _spots(self, count):
        az, el = np.array([12.0, 20.0]) + self._px_of_a_rad * self.bench.motor_rad
        return [[Star(28.0, 20.0, 28000.0, 0, 0), Star(az, el, self._light, 0, 0)]] * count


@pytest.mark.parametrize("light", [20000.0, 28000.0, 35000.0])
def test_of_several_stars_the_one_that_moves_with_the_motors_is_the_loops_own(light):
    site = site_of(load_rig(default_rig_path().parent / "two-stars.toml"), VirtualClock(), "left")
    watch = TwoStars(site, light)
    star, looks = own_star(site, watch, watch.spots())

    assert (star.flux_dn, looks) == (light, 0)
