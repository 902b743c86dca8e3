"""Two loops whose stars look alike on one frame: each follows its own."""

import numpy as np
import pytest

from fitctl.config import ARCSEC_PER_RAD, default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Jog, Release, SetTarget, Standby
from fitctl.messages.modes import Mode
from fitctl.model.optics import sky_px_per_rad
from fitctl.simulation.simulation import Simulation
from fitctl.simulation.statistics import true_residual_rms

pytestmark = pytest.mark.long

RIG = default_rig_path().with_name("two-stars.toml")
TARGET_PX = {"right": (28.0, 20.0), "left": (12.0, 20.0)}
NEAR = (3.0, -2.0)  # px: both stars are on the frame from the start
LEFT, RIGHT = "left", "right"


class TwoStars(Simulation):
    """The rig of two stars."""

    def __init__(self, *overrides, seed=0, star_offset_px=NEAR):
        super().__init__(
            load_rig(RIG, overrides), seed, star_offset_px=star_offset_px, history_s=60.0
        )
        self._light_dn = self.camera._scene._flux_dn

    def loop(self, name):
        return self.supervisor.stellar_loops[name]

    def modes(self):
        return {name: loop.mode for name, loop in self.supervisor.stellar_loops.items()}

    def light(self, right, left):
        """How much of each star's light comes, 0 to 1."""
        self.camera._scene._flux_dn = self._light_dn * np.array([right, right, left, left])

    def star_px(self, name):
        return (
            self.plants[name]
            .history_px(self.clock.now_s() - 1.0, self.clock.now_s())[:, 0, 0]
            .mean(axis=0)
        )

    def rms_px(self, name, since_s):
        now_s = self.clock.now_s()
        return true_residual_rms(self.plants[name], self.loop(name).target_px, since_s, now_s).max()

    def until(self, name, mode, limit_s=60.0):
        end_s = self.clock.now_s() + limit_s
        while self.loop(name).mode is not mode:
            assert self.clock.now_s() < end_s, f"{self.modes()}, wanted {name} {mode.name}"
            self.run(0.02)
        return self

    def assert_both_held(self, limit_s=60.0):
        """Each star comes to its own target, and stays there."""
        for name in TARGET_PX:
            self.until(name, Mode.VERNIER, limit_s)
        self.run(5.0)
        assert self.modes() == {RIGHT: Mode.VERNIER, LEFT: Mode.VERNIER}
        for name, target_px in TARGET_PX.items():
            assert self.star_px(name) == pytest.approx(target_px, abs=0.5), name


@pytest.fixture
def held():
    simulation = TwoStars()
    simulation.acquire()
    simulation.assert_both_held()
    return simulation


@pytest.mark.parametrize("seed", [0, 1])
def test_both_are_acquired_by_one_command(seed):
    simulation = TwoStars(seed=seed, star_offset_px=None)
    simulation.acquire()
    simulation.assert_both_held()


@pytest.mark.parametrize("seed", range(3))
def test_both_are_acquired_though_both_are_on_the_frame_from_the_start(seed):
    simulation = TwoStars(
        *(f"plant.loops.{name}.star_offset_sky_arcsec_max=50.0" for name in TARGET_PX),
        seed=seed,
        star_offset_px=None,
    )
    simulation.acquire()
    simulation.assert_both_held()


def test_a_star_that_does_not_move_with_the_loops_stages_is_not_its_own():
    simulation = TwoStars()
    simulation.light(right=0.0, left=1.0)
    simulation.command(Standby())
    simulation.command(Acquire(loop=RIGHT))
    simulation.until(RIGHT, Mode.STANDBY)
    assert "COARSE" not in [change.target for change in simulation.mode_changes]

    simulation.light(right=1.0, left=1.0)
    simulation.command(Acquire(loop=RIGHT))
    simulation.until(RIGHT, Mode.VERNIER)
    simulation.run(5.0)
    assert simulation.star_px(RIGHT) == pytest.approx(TARGET_PX[RIGHT], abs=0.5)


def test_a_star_that_is_jogged_to_where_the_candidate_is_expected_is_not_its_own(held):
    """Only the star of right is on the frame, and goes as the stages of left do."""
    held.command(Release())
    held.light(right=1.0, left=0.0)
    held.command(Acquire(loop=LEFT))
    left, right = held.loop(LEFT), held.loop(RIGHT)
    while left.star_finder.attribution.candidate is None:
        held.run(0.02)
        assert left.mode is Mode.ACQUISITION
    moves_px = TARGET_PX[LEFT] - held.star_px(RIGHT)
    per_rad = right.settings.siderostat.sky_arcsec_per_motor_rad
    az, el = (per_rad * right._scale.motor_rad(moves_px)).tolist()
    held.command(Jog(loop=RIGHT, az_sky_arcsec=az, el_sky_arcsec=el))
    since_s = held.clock.now_s()
    held.run(1.5)
    assert held.star_px(RIGHT) == pytest.approx(TARGET_PX[LEFT], abs=2.0)
    held.run(5.0)
    assert not [change for change in held.mode_changes if change.time_s > since_s]


def test_a_star_that_vanishes_is_lost_though_another_is_on_the_frame(held):
    held.command(Release(loop=LEFT))  # no loop follows its star from now on
    held.light(right=0.0, left=1.0)
    held.run(0.5)
    assert held.loop(RIGHT).mode is Mode.ACQUISITION

    held.run(20.0)
    assert held.loop(RIGHT).mode is Mode.ACQUISITION
    held.light(right=1.0, left=1.0)
    held.until(RIGHT, Mode.VERNIER)
    held.run(5.0)
    assert held.star_px(RIGHT) == pytest.approx(TARGET_PX[RIGHT], abs=0.5)


def test_another_loops_star_that_rests_does_not_draw_the_siderostat_away(held):
    held.command(Release(loop=LEFT))
    held.run(1.0)
    away_px = np.array(TARGET_PX[RIGHT]) - [4.0, 0.0] - held.star_px(LEFT)
    az_arcsec, el_arcsec = (away_px / sky_px_per_rad(held.rig) * ARCSEC_PER_RAD).tolist()
    held.command(Jog(loop=LEFT, az_sky_arcsec=az_arcsec, el_sky_arcsec=el_arcsec))
    held.run(20.0)
    held.light(right=0.0, left=1.0)  # what is left beside its target is the other star
    begun_rad = held.loop(RIGHT).servo.position_rad
    farthest_px = 0.0
    for _ in range(60):
        held.run(0.5)
        moved_rad = held.loop(RIGHT).servo.position_rad - begun_rad
        if held.loop(RIGHT).mode in {Mode.COARSE, Mode.VERNIER}:
            moved_px = abs(held.loop(RIGHT)._scale.motor_px_per_rad * moved_rad).max()
            farthest_px = max(farthest_px, moved_px)
    assert farthest_px < 15.0
    assert "did not move with them" in " ".join(c.reason for c in held.mode_changes)

    held.command(Jog(loop=LEFT, az_sky_arcsec=-az_arcsec, el_sky_arcsec=-el_arcsec))
    held.light(right=1.0, left=1.0)
    held.until(RIGHT, Mode.VERNIER)
    held.run(5.0)
    assert held.star_px(RIGHT) == pytest.approx(TARGET_PX[RIGHT], abs=0.5)


@pytest.mark.parametrize("dark_s", [2.0, 8.0])
def test_both_are_found_again_after_both_were_lost_at_once(held, dark_s):
    held.light(right=0.0, left=0.0)
    held.run(dark_s)
    assert held.modes() == {RIGHT: Mode.ACQUISITION, LEFT: Mode.ACQUISITION}

    held.light(right=1.0, left=1.0)
    held.assert_both_held()


@pytest.mark.parametrize(("lost", "stays"), [(RIGHT, LEFT), (LEFT, RIGHT)])
def test_a_star_that_is_searched_for_and_comes_back_does_not_disturb_the_other_loop(
    held, lost, stays
):
    since_s = held.clock.now_s()
    held.light(**{lost: 0.0, stays: 1.0})
    held.run(8.0)
    held.light(right=1.0, left=1.0)
    held.until(lost, Mode.VERNIER)
    held.run(2.0)
    assert held.loop(stays).mode is Mode.VERNIER
    assert held.rms_px(stays, since_s) < 0.04


@pytest.mark.parametrize(("dark", "stays"), [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_a_star_that_shows_only_on_the_other_half_of_the_frame_does_not_disturb_that_loop(
    held, monkeypatch, dark, stays
):
    """No light comes to the half with its target: the spiral carries it past the star that is held."""
    scene = held.camera._scene
    expose, half = scene.frame, slice(0, 20) if dark == LEFT else slice(20, 40)

    def half_dark(*arguments):
        image = expose(*arguments).copy()
        image[:, half] = held.rig.camera.bias_dn
        return image

    monkeypatch.setattr(scene, "frame", half_dark)
    since_s = held.clock.now_s()
    held.run(12.0)
    assert held.modes() == {dark: Mode.ACQUISITION, stays: Mode.VERNIER}
    assert held.rms_px(stays, since_s) < 0.035

    monkeypatch.undo()
    held.assert_both_held()


@pytest.mark.parametrize("again", [True, False])
def test_a_star_is_not_brought_to_where_the_target_was_and_another_loop_holds_its_star(held, again):
    held.command(SetTarget(loop=RIGHT, az_px=28.0, el_px=8.0))
    held.run(8.0)
    held.command(SetTarget(loop=LEFT, az_px=28.0, el_px=20.0))
    held.run(12.0)
    since_s = held.clock.now_s()
    if again:
        held.light(right=0.0, left=1.0)
        held.until(RIGHT, Mode.ACQUISITION)
        held.run(1.0)
        held.light(right=1.0, left=1.0)
    else:
        held.command(Release(loop=RIGHT))
        held.run(1.0)
        held.command(Acquire(loop=RIGHT))
    held.until(RIGHT, Mode.VERNIER)
    held.run(5.0)

    changes = [change for change in held.mode_changes if change.time_s > since_s]
    assert {change.loop for change in changes} == {RIGHT}
    assert held.star_px(RIGHT) == pytest.approx((28.0, 8.0), abs=0.5)
    assert held.star_px(LEFT) == pytest.approx((28.0, 20.0), abs=0.5)


def test_a_target_is_of_one_loop_so_that_two_stars_are_not_sent_to_one_place():
    simulation = TwoStars()
    targets_px = {name: simulation.loop(name).target_px.tolist() for name in TARGET_PX}

    refused = simulation.command(SetTarget(az_px=20.0, el_px=20.0))
    assert not refused.accepted
    assert refused.text == "a target is of one loop; name the loop: right, left"
    assert targets_px == {name: simulation.loop(name).target_px.tolist() for name in TARGET_PX}

    assert simulation.command(SetTarget(loop=LEFT, az_px=12.0, el_px=22.0)).accepted
    assert simulation.loop(RIGHT).target_px.tolist() == targets_px[RIGHT]
