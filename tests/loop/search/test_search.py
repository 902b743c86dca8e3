"""Searches that a command asks for: how wide, how fine, and about where."""

import math

import numpy as np
import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Acquire, Release, Standby
from fitctl.messages.modes import Mode, Trigger
from fitctl.model.optics import scales
from fitctl.simulation.simulation import Simulation

RIG = load_rig(default_rig_path())
ARCSEC_PER_PX = scales(RIG, RIG.loops["right"]).sky_arcsec_per_px
FAR = (900.0, -700.0)


def star_at(az_sky_arcsec, el_sky_arcsec):
    """The instrument powered up, with its star there from where the encoders read zero."""
    offset_px = np.array([az_sky_arcsec, el_sky_arcsec]) / ARCSEC_PER_PX
    simulation = Simulation(RIG, 1, star_offset_px=offset_px)
    assert simulation.command(Standby()).accepted
    return simulation


def modes(simulation):
    return [change.target for change in simulation.mode_changes]


def run_until(simulation, mode, most_s):
    end_s = simulation.clock.now_s() + most_s
    while simulation.supervisor.loops["right"].mode is not mode:
        simulation.run(RIG.camera.period_s)
        assert simulation.clock.now_s() < end_s, modes(simulation)


def searched_px(simulation):
    """How far the searches went from their middle."""
    return math.sqrt(
        max(tick.search_progress for tick in simulation.ticks if tick.mode == "ACQUISITION")
    )


@pytest.mark.parametrize("aside", [(0.0, 0.0), (30.0, -50.0)])
def test_a_star_far_away_is_found_where_it_is_expected(aside):
    simulation = star_at(*np.add(FAR, aside))

    reply = simulation.command(
        Acquire(
            expected_az_sky_arcsec=FAR[0],
            expected_el_sky_arcsec=FAR[1],
            search_radius_sky_arcsec=80.0,
        )
    )

    assert reply.accepted
    run_until(simulation, Mode.VERNIER, 30.0)
    motor_rad = np.array(simulation.supervisor.loops["right"].servo.position_rad)
    sky = motor_rad * RIG.loops["right"].siderostat.sky_arcsec_per_motor_rad
    assert -sky == pytest.approx(np.add(FAR, aside), abs=2.0)


def test_the_spiral_waits_for_the_siderostat_to_be_in_its_middle():
    simulation = star_at(*FAR)

    simulation.command(Acquire(expected_az_sky_arcsec=FAR[0], expected_el_sky_arcsec=FAR[1]))
    run_until(simulation, Mode.COARSE, 5.0)

    assert searched_px(simulation) < 0.1  # it was seen at once, not by a later turn


def test_a_star_that_is_passed_on_the_way_is_another_one():
    simulation = star_at(0.0, 0.0)

    simulation.command(
        Acquire(
            expected_az_sky_arcsec=FAR[0],
            expected_el_sky_arcsec=FAR[1],
            search_radius_sky_arcsec=20.0,
        )
    )
    run_until(simulation, Mode.STANDBY, 20.0)

    assert modes(simulation)[-2:] == ["ACQUISITION", "STANDBY"]
    assert not any(tick.star_visible for tick in simulation.ticks if tick.mode == "ACQUISITION")


@pytest.mark.long
def test_a_flux_that_is_asked_for_holds_until_the_next_search_by_command():
    simulation = star_at(0.0, 0.0)
    loop = simulation.supervisor.loops["right"]

    simulation.command(Acquire(star_flux_dn=0.8 * RIG.loops["right"].star_flux_dn))
    run_until(simulation, Mode.VERNIER, 30.0)
    loop.fire(Trigger.STAR_LOST, "a test")
    run_until(simulation, Mode.VERNIER, 30.0)  # found again, as the same star

    assert loop.quantities.readings["star_flux_fraction"][0] == pytest.approx(1 / 0.8, rel=0.05)
    simulation.command(Release())
    simulation.command(Acquire())
    run_until(simulation, Mode.VERNIER, 30.0)
    assert loop.quantities.readings["star_flux_fraction"][0] == pytest.approx(1.0, rel=0.05)


def test_a_middle_beyond_the_travel_is_not_waited_for():
    simulation = star_at(0.0, 3000.0)  # nowhere near
    loop = simulation.supervisor.loops["right"]
    beyond_px = np.array([1300.0, 0.0]) / ARCSEC_PER_PX
    loop.star_finder.estimator.place(loop.target_px + beyond_px, np.zeros(2), np.zeros(2))

    simulation.command(Acquire())
    run_until(simulation, Mode.STANDBY, 60.0)

    assert modes(simulation)[-2:] == ["ACQUISITION", "STANDBY"]


def test_a_radius_holds_for_one_search_only():
    simulation = star_at(0.0, 0.0)
    loop = simulation.supervisor.loops["right"]
    simulation.command(Acquire(search_radius_sky_arcsec=10.0))
    run_until(simulation, Mode.COARSE, 10.0)

    simulation.command(Release())
    simulation.plants["right"].constants.spot_origin_px[:] += 2000.0
    simulation.command(Acquire())
    run_until(simulation, Mode.STANDBY, 60.0)

    assert "no star within 215 arcsec" in loop.last_change.reason


def test_an_acquire_during_a_search_begins_it_anew_as_asked():
    simulation = star_at(3000.0, 0.0)
    simulation.command(Acquire())
    simulation.run(5.0)

    assert simulation.command(Acquire(search_radius_sky_arcsec=50.0)).accepted
    run_until(simulation, Mode.STANDBY, 10.0)

    assert "no star within 50 arcsec" in simulation.mode_changes[-1].reason


def test_a_search_may_reach_as_far_as_the_siderostat_travels():
    simulation = star_at(0.0, 0.0)

    assert simulation.command(Acquire(search_radius_sky_arcsec=1200.0)).accepted


def test_a_finer_search_takes_longer():
    times_s = []
    for overlap in (None, 0.5):
        simulation = star_at(3000.0, 0.0)
        simulation.command(Acquire(search_radius_sky_arcsec=100.0, field_overlap=overlap))
        began_s = simulation.clock.now_s()
        run_until(simulation, Mode.STANDBY, 60.0)
        times_s.append(simulation.clock.now_s() - began_s)

    assert "no star within 100 arcsec" in simulation.mode_changes[-1].reason
    assert times_s[1] > 1.5 * times_s[0]


@pytest.mark.parametrize(
    ("asked", "said"),
    [
        ({"search_radius_sky_arcsec": 1201.0}, "would reach 1201 arcsec"),
        ({"search_radius_sky_arcsec": 0.0}, "must be above 0"),
        ({"star_flux_dn": math.nan}, "star_flux_dn must be above 0"),
        ({"star_flux_dn": 1e308}, "would saturate its brightest pixel"),
        ({"star_flux_dn": 1.0}, "a star of 1 DN could not be distinguished from noise"),
        ({"search_radius_sky_arcsec": math.nan}, "must be above 0"),
        ({"search_radius_sky_arcsec": math.inf}, "must be above 0"),
        ({"field_overlap": 0.9}, "must lie in 0.05 to 0.6"),
        ({"field_overlap": math.nan}, "must lie in"),
        ({"expected_az_sky_arcsec": 1.0}, "belong together"),
        (
            {"expected_az_sky_arcsec": -1000.0, "expected_el_sky_arcsec": 0.0},
            "would reach 1215 arcsec from where the encoders read zero; travel_sky_arcsec of "
            "loops.right.siderostat is 1200",
        ),
        ({"expected_az_sky_arcsec": 0.0, "expected_el_sky_arcsec": math.nan}, "would reach nan"),
    ],
)
def test_a_search_that_cannot_be_made_is_refused_and_moves_nothing(asked, said):
    simulation = star_at(0.0, 0.0)

    reply = simulation.command(Acquire(**asked))

    assert not reply.accepted
    assert said in reply.text
    assert modes(simulation) == ["STANDBY"]
