"""A loop that followed its star and lost it searches until the star is back, or somebody ends the search."""

import numpy as np
import pytest
from instruments.simulated import darken, events_of, mode_of, until

from fitctl.messages.commands import Acquire, Release, Stop
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales

ACQUISITION = "loops.right.acquisition."


def lose(simulation, dark_s):
    """The starlight goes out for so long; what remains of it is restored then."""
    scene = simulation.camera._scene
    flux_dn = scene._flux_dn.copy()
    darken(simulation)
    simulation.run(dark_s)
    assert mode_of(simulation) is not Mode.VERNIER
    scene._flux_dn = flux_dn


def move_star(simulation, *sky_arcsec):
    loop = simulation.rig.loops["right"]
    offset_px = scales(simulation.rig, loop).sky_px(np.array(sky_arcsec))
    simulation.plants["right"].constants.spot_origin_px[:] += offset_px


def again(simulation):
    return simulation.supervisor.loops["right"].state(simulation.clock.now_s()).search_again


@pytest.fixture
def held(simulate_with):
    """An instrument that holds its star, with some values of the rig replaced."""

    def make(*overrides):
        simulation = simulate_with(*overrides, star_offset_px=(10.0, -6.0))
        simulation.acquire()
        return until(simulation, Mode.VERNIER)

    return make


@pytest.mark.long
@pytest.mark.parametrize("dark_s", [1.0, 5.0, 30.0, 180.0])
def test_a_star_that_comes_back_where_it_was_is_held_again(held, dark_s):
    simulation = held()

    lose(simulation, dark_s)

    assert mode_of(simulation) is Mode.ACQUISITION
    until(simulation, Mode.VERNIER, limit_s=45.0)
    assert {change.target for change in simulation.mode_changes} <= {
        "STANDBY",
        "ACQUISITION",
        "COARSE",
        "VERNIER",
    }
    assert again(simulation) is None


@pytest.mark.long
@pytest.mark.parametrize("moved", [(60.0, 0.0), (-60.0, 60.0), (0.0, 190.0)])
def test_a_star_that_comes_back_elsewhere_is_found_by_a_wider_round(held, moved):
    simulation = held()

    move_star(simulation, *moved)
    until(simulation, Mode.ACQUISITION, limit_s=2.0)

    until(simulation, Mode.VERNIER, limit_s=90.0)


def test_a_star_in_the_field_is_looked_for_at_its_last_place_before_the_siderostat_moves(held):
    simulation = held()
    before = len(simulation.ticks)

    lose(simulation, 3.0)  # shorter than the first pause
    until(simulation, Mode.COARSE, limit_s=2.0)

    searched = [tick for tick in list(simulation.ticks)[before:] if tick.mode == "ACQUISITION"]
    assert searched
    assert all(tick.search_progress == 0.0 for tick in searched)


@pytest.mark.long
def test_rounds_grow_to_the_rigs_radius_with_pauses_and_stay_there(held):
    simulation = held()
    darken(simulation)
    until(simulation, Mode.ACQUISITION)

    rounds = []
    for _ in range(1200):
        simulation.run(0.1)
        state = again(simulation)
        shown = (state.radius_sky_arcsec, state.pauses)
        if not rounds or rounds[-1] != shown:
            rounds.append(shown)

    widest = simulation.rig.loops["right"].acquisition.search_radius_sky_arcsec
    first = [(part * widest, pauses) for part in (0.25, 0.5, 1.0) for pauses in (True, False)]
    assert rounds[:6] == first
    assert set(rounds[6:]) == {(widest, True), (widest, False)}


@pytest.mark.long
def test_a_long_search_is_reported_once_and_consoles_are_shown_since_when(held):
    simulation = held()
    darken(simulation)

    simulation.run(300.0)

    told = [event for event in events_of(simulation) if "the search repeats" in event.message]
    assert [event.severity for event in told] == ["warning"]
    assert "no star within 215 arcsec of its last place" in told[0].message
    assert again(simulation).since_s == pytest.approx(simulation.mode_changes[-1].time_s)


@pytest.mark.long
def test_the_siderostat_stays_within_its_travel_however_long_it_searches(held):
    simulation = held(
        "loops.right.siderostat.travel_sky_arcsec=100.0",
        "loops.right.acquisition.search_radius_sky_arcsec=90.0",
    )
    move_star(simulation, 3000.0, 0.0)

    simulation.run(60.0)

    assert again(simulation).round_number > 3
    arcsec = [
        max(abs(tick.siderostat_az_sky_arcsec), abs(tick.siderostat_el_sky_arcsec))
        for tick in simulation.ticks
    ]
    assert max(arcsec) < 101.0


@pytest.mark.long
@pytest.mark.parametrize(
    ("command", "ends"),
    [(Release(), Mode.STANDBY), (Stop(), Mode.SAFE), (Acquire(), Mode.ACQUISITION)],
)
def test_hold_stop_and_another_acquire_end_it(held, command, ends):
    simulation = held()
    lose(simulation, 5.0)
    darken(simulation)
    assert again(simulation) is not None

    assert simulation.command(command).accepted

    assert mode_of(simulation) is ends
    assert again(simulation) is None
    darken(simulation)
    simulation.run(60.0)
    assert mode_of(simulation) is (Mode.SAFE if ends is Mode.SAFE else Mode.STANDBY)


@pytest.mark.long
def test_it_ends_in_standby_after_the_time_that_the_rig_file_allows(held):
    simulation = held(f"{ACQUISITION}search_again_s=40.0")
    darken(simulation)
    until(simulation, Mode.ACQUISITION)
    lost_s = simulation.clock.now_s()

    until(simulation, Mode.STANDBY, limit_s=60.0)

    assert simulation.clock.now_s() - lost_s == pytest.approx(40.0, abs=0.2)
    assert "did not come back within 40 s" in simulation.mode_changes[-1].reason


def test_without_a_time_for_it_a_lost_star_is_searched_for_as_a_first_one(held):
    simulation = held(f"{ACQUISITION}search_again_s=0.0")
    darken(simulation)

    until(simulation, Mode.STANDBY, limit_s=20.0)

    assert "no star within 215 arcsec of the start" in simulation.mode_changes[-1].reason


def test_a_first_search_ends_when_its_radius_was_seen(simulate_with):
    simulation = simulate_with(star_offset_px=(3000.0, 0.0))
    simulation.acquire()

    until(simulation, Mode.STANDBY, limit_s=20.0)

    assert again(simulation) is None


@pytest.mark.long
def test_a_search_that_finds_the_star_and_loses_it_again_begins_with_the_first_round(held):
    simulation = held()
    lose(simulation, 60.0)
    until(simulation, Mode.VERNIER, limit_s=45.0)

    lose(simulation, 1.0)

    assert again(simulation).round_number == 1
