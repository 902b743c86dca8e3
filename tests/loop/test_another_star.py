"""The loop is told to look at another star of the same frame, on the virtual clock with the full plant."""

import math

import pytest
from instruments.simulated import NEAR, TWO_STARS, events_of, mode_of, until

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
