"""A star that moves at a known rate, on the virtual clock with the full plant."""

import math

import numpy as np
import pytest
from instruments.simulated import darken, mode_of, until

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Experiment, Release, Standby
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive
from fitctl.simulation.simulation import Simulation, simulate

RATE_ARCSEC_S = (12.0, -9.0)  # together 15: the sidereal rate
_RATE = "loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}"
TRUE, KNOWN = f"plant.{_RATE}", _RATE
CONTROLLER = "loops.right.vernier.controller={}"


def rig_with(*overrides):
    return load_rig(default_rig_path(), overrides)


@pytest.fixture
def held():
    """It holds a star that moves, with a siderostat that is turned."""
    rig = rig_with(TRUE, KNOWN, "loops.right.siderostat.rotation_deg=30.0")
    simulation = Simulation(rig, 1, star_offset_px=np.array([10.0, -6.0]))
    simulation.records = []
    simulation.acquire()
    until(simulation, Mode.VERNIER)
    simulation.run(2.0)
    return simulation


def star_px(simulation):
    return simulation.plants["right"].spots_px(simulation.clock.now_s())[0, 0]


def star_is_held(simulation):
    return star_px(simulation) == pytest.approx((24.0, 19.5), abs=0.15)


def test_a_star_moves_at_its_rate_when_nothing_follows_it():
    rig = rig_with(TRUE, "plant.loops.right.air_path.gain_px=0.0")
    simulation = Simulation(rig, 1, star_offset_px=np.zeros(2))
    star = simulation.plants["right"]
    star.advance(10.0)

    moved_px = star.spots_px(10.0)[0] - star.constants.spot_origin_px[0]

    arcsec_per_px = 2.708
    expected_px = np.array(RATE_ARCSEC_S) * 10.0 / arcsec_per_px
    assert moved_px == pytest.approx(np.array([expected_px, expected_px]), rel=1e-3)


@pytest.mark.long
@pytest.mark.parametrize("controller", ["eq20", "minimum-variance"])
def test_a_star_at_the_sidereal_rate_is_held_as_one_that_stands(controller):
    still, moving = (
        simulate(rig_with(CONTROLLER.format(controller), *rates), 1, 35.0)["right"]
        for rates in ((), (TRUE, KNOWN))
    )

    for axis, still_px in still.rms_px.items():
        assert moving.rms_px[axis] == pytest.approx(still_px, rel=0.1), axis
    assert moving.vernier_s < still.vernier_s + 5.0


@pytest.mark.long
def test_a_star_whose_rate_is_not_known_is_not_held():
    moving = simulate(rig_with(TRUE, CONTROLLER.format("eq20")), 1, 35.0)["right"]

    assert not moving.rms_px["az"] < 0.5


@pytest.mark.long
def test_a_rate_that_is_a_little_wrong_is_learned_as_drift():
    true = TRUE.replace("12.0", "12.2")

    moving = simulate(rig_with(true, KNOWN, CONTROLLER.format("minimum-variance")), 1, 35.0)

    assert moving["right"].rms_px["az"] < 0.03


@pytest.mark.long
def test_the_siderostat_stands_in_standby_and_the_next_search_begins_where_the_star_has_gone(held):
    held.command(Release())
    held.run(0.5)
    stood_rad = held.ticks[-1].siderostat_az_rad, held.ticks[-1].siderostat_el_rad
    held.run(10.0)
    assert (held.ticks[-1].siderostat_az_rad, held.ticks[-1].siderostat_el_rad) == pytest.approx(
        stood_rad, abs=2e-3
    )
    assert np.linalg.norm(star_px(held) - (24.0, 19.5)) > 50

    assert held.command(Acquire()).accepted
    until(held, Mode.VERNIER, limit_s=10.0)

    held.run(2.0)
    assert star_is_held(held)


def asked_for(simulation, az=RATE_ARCSEC_S[0], el=RATE_ARCSEC_S[1]):
    return simulation.command(Acquire(rate_az_sky_arcsec_s=az, rate_el_sky_arcsec_s=el))


@pytest.mark.long
def test_a_command_gives_the_rate_of_a_star_which_holds_until_the_next_search_by_command():
    simulation = Simulation(rig_with(TRUE), 1, star_offset_px=np.array([10.0, -6.0]))
    simulation.command(Standby())
    assert asked_for(simulation).accepted
    until(simulation, Mode.VERNIER)
    simulation.run(10.0)
    assert star_is_held(simulation)

    simulation.command(Release())
    simulation.run(5.0)
    assert asked_for(simulation).accepted
    until(simulation, Mode.VERNIER, limit_s=10.0)
    simulation.run(5.0)
    assert star_is_held(simulation)

    simulation.command(Release())
    simulation.command(Acquire())
    simulation.run(10.0)
    assert not star_is_held(simulation)  # the rig file has no rate


def test_a_rate_that_is_asked_for_stands_in_place_of_the_rig_files(held):
    held.command(Release())
    assert asked_for(held, 0.0, 0.0).accepted
    held.run(10.0)

    assert not star_is_held(held)


@pytest.mark.parametrize(
    ("rate", "why_not"),
    [
        ((12.0, None), "belong together"),
        ((math.nan, 0.0), "cannot follow a star at az nan"),
        ((1e6, 0.0), "cannot follow a star at az 1e+06, el 0 arcsec/s"),
    ],
)
def test_a_rate_that_the_siderostat_cannot_follow_is_refused(held, rate, why_not):
    held.command(Release())

    reply = asked_for(held, *rate)

    assert not reply.accepted
    assert why_not in reply.text


@pytest.mark.long
def test_a_star_that_is_dark_for_a_while_is_found_where_it_has_gone(held):
    light = held.camera._scene._flux_dn
    darken(held)
    held.run(8.0)
    assert mode_of(held) is Mode.ACQUISITION
    held.camera._scene._flux_dn = light

    until(held, Mode.VERNIER, limit_s=25.0)

    held.run(2.0)
    assert star_is_held(held)


def test_a_star_is_searched_for_where_a_command_says_that_it_would_be_with_the_motors_at_zero(held):
    """The command's place is of this moment."""
    held.command(Release())
    held.run(1.0)
    now_s = held.clock.now_s()
    away_arcsec = np.array([10.0, -6.0]) * 2.708 + np.array(RATE_ARCSEC_S) * now_s
    asked = Acquire(
        expected_az_sky_arcsec=float(away_arcsec[0]), expected_el_sky_arcsec=float(away_arcsec[1])
    )

    assert held.command(asked).accepted

    until(held, Mode.VERNIER, limit_s=10.0)


def test_motions_of_an_experiment_come_on_top_of_the_stars(held):
    drive = Drive(
        channel="siderostat_az", shape="sine", amplitude=2.0, frequency_hz=1.0, duration_s=2.0
    )
    assert held.command(Experiment(name="test", drives=[drive])).accepted
    held.run(1.0)
    assert mode_of(held) is Mode.EXPERIMENT
    assert np.abs(star_px(held) - (24.0, 19.5)).max() < 4.0

    until(held, Mode.VERNIER, limit_s=10.0)

    held.run(2.0)
    assert star_is_held(held)
