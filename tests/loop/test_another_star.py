"""The loop is told to look at another star of the same frame, on the virtual clock with the full plant."""

import math

import pytest
from instruments.simulated import NEAR, TWO_STARS, darken, events_of, mode_of, until

from fitctl.messages.commands import Look
from fitctl.messages.modes import Mode


@pytest.fixture
def two_stars(simulate_with):
    """It holds the brighter of two stars."""
    simulation = simulate_with(TWO_STARS, **NEAR)
    simulation.acquire()
    until(simulation, Mode.VERNIER)
    simulation.run(1.0)
    return simulation


def true_places(simulation):
    return simulation.plants["right"].spots_px(simulation.clock.now_s())[0]


def test_the_loop_is_told_to_look_at_another_star_and_pulls_that_one_to_its_target(two_stars):
    first, second = true_places(two_stars)
    assert first == pytest.approx((24.0, 19.5), abs=0.5)

    az_px, el_px = second.tolist()
    assert two_stars.command(Look(az_px=az_px + 1.5, el_px=el_px - 1.5)).accepted
    two_stars.run(0.1)
    assert two_stars.ticks[-1].star_flux_dn == pytest.approx(24_000, rel=0.02)
    until(two_stars, Mode.VERNIER)
    two_stars.run(10.0)

    first, second = true_places(two_stars)
    assert second == pytest.approx((24.0, 19.5), abs=0.2)
    assert "is followed from now on" in str(events_of(two_stars))
    assert "ACQUISITION" not in [change.target for change in two_stars.mode_changes[3:]]


@pytest.fixture
def fainter(two_stars):
    """It holds the fainter of two stars."""
    az_px, el_px = true_places(two_stars)[1].tolist()
    assert two_stars.command(Look(az_px=az_px, el_px=el_px)).accepted
    two_stars.run(0.2)
    until(two_stars, Mode.VERNIER)
    two_stars.run(3.0)
    return two_stars


def dim(simulation, factor, frames):
    """All light fades to `factor` for some frames."""
    scene = simulation.camera._scene
    flux_dn = scene._flux_dn
    darken(simulation, factor)
    simulation.run(frames * simulation.rig.camera.period_s)
    scene._flux_dn = flux_dn


@pytest.mark.parametrize(("factor", "frames"), [(0.0, 1), (0.0, 3), (0.69, 5)])
def test_a_star_that_is_gone_for_some_frames_is_not_exchanged_for_a_brighter_one(
    fainter, factor, frames
):
    changes = len(fainter.mode_changes)

    dim(fainter, factor, frames)
    fainter.run(5.0)

    assert true_places(fainter)[1] == pytest.approx((24.0, 19.5), abs=0.2)
    assert len(fainter.mode_changes) == changes


def test_a_star_that_was_lost_is_found_again_beside_a_brighter_one(fainter):
    dim(fainter, 0.0, 15)
    assert mode_of(fainter) is Mode.ACQUISITION
    until(fainter, Mode.VERNIER)
    fainter.run(5.0)

    assert true_places(fainter)[1] == pytest.approx((24.0, 19.5), abs=0.2)


def test_where_there_is_no_star_the_one_before_is_followed(two_stars):
    assert two_stars.command(Look(az_px=30.0, el_px=30.0)).accepted
    two_stars.run(2.0)

    assert mode_of(two_stars) is Mode.VERNIER
    assert true_places(two_stars)[0] == pytest.approx((24.0, 19.5), abs=0.2)
    assert "no star in the window at az 30, el 30 px" in events_of(two_stars)[-1].message


@pytest.mark.parametrize(
    ("place", "why_not"), [((1.0, 19.5), "look must lie"), ((math.nan, 19.5), "look must lie")]
)
def test_a_window_that_is_not_on_the_frame_is_refused(vernier, place, why_not):
    reply = vernier.command(Look(az_px=place[0], el_px=place[1]))

    assert not reply.accepted
    assert why_not in reply.text


def test_where_no_star_is_followed_to_look_means_nothing(simulate_with):
    simulation = simulate_with(**NEAR)
    assert "look is not available in OFF" in simulation.command(Look(az_px=20.0, el_px=20.0)).text
    simulation.acquire()
    until(simulation, Mode.ACQUISITION)

    reply = simulation.command(Look(az_px=20.0, el_px=20.0))

    assert reply.text == ("look is not available in ACQUISITION; it needs COARSE or VERNIER")


def test_a_star_that_was_pointed_at_on_the_way_to_the_target_is_not_compared_with_the_one_before(
    simulate_with,
):
    beside = TWO_STARS.replace("az=-9.0, el=5.0", "az=-9.0, el=0.0")
    simulation = simulate_with(beside, star_offset_px=(5.0, 0.0))
    simulation.acquire()
    until(simulation, Mode.COARSE)
    simulation.run(0.2)
    az_px, el_px = true_places(simulation)[1].tolist()

    assert simulation.command(Look(az_px=az_px, el_px=el_px)).accepted
    until(simulation, Mode.VERNIER)

    assert "did not move with them" not in str(events_of(simulation))
    assert "ACQUISITION" not in [change.target for change in simulation.mode_changes[3:]]
