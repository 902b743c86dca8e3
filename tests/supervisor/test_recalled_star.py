"""A supervisor that follows one that was killed goes back to the star that was known then."""

import math
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from instruments.simulated import darken, events_of, failing, mode_of, until

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import DeviceFault
from fitctl.logging.records import BeamPlace, StarPlace
from fitctl.messages.commands import Acquire, Off, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.simulation.devices import InlineExecutor
from fitctl.simulation.simulation import Simulation
from fitctl.supervisor.supervisor import Supervisor

KNOWN = "the star's place is known from before the supervisor was killed"
FORGOTTEN = "the star's place is forgotten"


def searches_elsewhere(simulation):
    """The star is held, lost, and searched for until the siderostat is far from it; then its light is back."""
    simulation.acquire()
    until(simulation, Mode.VERNIER)
    scene = simulation.camera._scene
    flux_dn = scene._flux_dn.copy()
    darken(simulation)
    held_rad = simulation.supervisor.servos["right"].position_rad
    loop = simulation.rig.loops["right"]
    far_rad = 120.0 / loop.siderostat.sky_arcsec_per_motor_rad
    while np.abs(simulation.supervisor.servos["right"].position_rad - held_rad).max() < far_rad:
        simulation.run(0.1)
        assert simulation.clock.now_s() < 200.0
    scene._flux_dn = flux_dn
    return held_rad * loop.siderostat.sky_arcsec_per_motor_rad


def killed(simulation, *, recall=True):
    """Another supervisor on the same devices, as the one before it left them."""
    places = simulation.supervisor.places
    for devices in simulation.devices.loops.values():
        devices.amplifiers.disable()
    simulation.supervisor = Supervisor(
        simulation.rig,
        simulation.devices,
        simulation.clock,
        InlineExecutor(),
        simulation._receive,
        design_for,
    )
    simulation.camera.on_servo_period = [
        (work.period_s, work.period) for work in simulation.supervisor.periodic
    ]
    if recall:
        simulation.supervisor.recall(places)
    return places


def search_from_arcsec(simulation, held_arcsec):
    """How far from where the star was held the next search begins."""
    simulation.command(Standby())
    simulation.run(0.1)
    assert simulation.command(Acquire()).accepted
    loop = simulation.supervisor.loops["right"]
    centre_arcsec = loop.state(simulation.clock.now_s()).search_centre_sky_arcsec
    return float(np.abs(np.array(centre_arcsec) - held_arcsec).max())


MOVING = "loops.right.star_rate_sky_arcsec_s={az=0.4, el=-0.3}"


@pytest.mark.long
@pytest.mark.parametrize(
    "overrides",
    [[], [MOVING, MOVING.replace("loops.", "plant.loops.")]],
    ids=["fixed", "moving"],
)
def test_the_star_is_searched_for_where_it_was(simulate_with, overrides):
    simulation = simulate_with(*overrides, star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)

    killed(simulation)

    assert search_from_arcsec(simulation, held_arcsec) < 40.0
    assert any(KNOWN in event.message for event in events_of(simulation))
    until(simulation, Mode.VERNIER, limit_s=60.0)


@pytest.mark.long
def test_a_supervisor_that_is_killed_before_it_opens_anything_passes_on_what_it_was_left(
    simulate_with,
):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)

    places = killed(simulation)
    simulation.run(2.0)

    found = [
        msgspec.structs.replace(place, time_s=places[0].time_s) for place in killed(simulation)
    ]
    assert found == places != []
    assert search_from_arcsec(simulation, held_arcsec) < 40.0


@pytest.mark.long
def test_without_it_the_search_begins_where_the_siderostat_stands(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)

    killed(simulation, recall=False)

    assert search_from_arcsec(simulation, held_arcsec) > 80.0


def lose_zero(simulation, name="right"):
    """From now on the encoders count from zero where the motors are."""
    amplifiers = simulation.devices.loops[name].amplifiers
    at_rad = amplifiers.exchange((0.0, 0.0)).position_rad
    exchange = amplifiers.exchange

    def from_zero(velocity_rad_s):
        reading = exchange(velocity_rad_s)
        now_rad = tuple(now - at for now, at in zip(reading.position_rad, at_rad, strict=True))
        return reading._replace(position_rad=now_rad)

    amplifiers.exchange = from_zero


def test_encoders_that_lost_their_zero_lead_nowhere(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    searches_elsewhere(simulation)
    lose_zero(simulation)
    killed(simulation)
    simulation.command(Standby())

    texts = [event.message for event in events_of(simulation)]
    assert any(FORGOTTEN in text for text in texts)
    assert not any(KNOWN in text for text in texts)
    assert simulation.supervisor.places == []


@pytest.mark.long
def test_encoders_that_lost_their_zero_lead_nowhere_though_opening_failed_after_they_were_read(
    simulate_with,
):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    searches_elsewhere(simulation)
    simulation.command(Stop())
    simulation.command(Off())
    lose_zero(simulation)
    amplifiers = simulation.devices.loops["right"].amplifiers
    fault = DeviceFault("siderostat", "here", "both axes enabled", "a fault")
    with patch.object(amplifiers, "enable", failing(fault)):
        simulation.command(Standby())
    assert mode_of(simulation) is Mode.OFF

    killed(simulation)
    simulation.command(Standby())

    assert mode_of(simulation) is Mode.STANDBY
    assert not any(KNOWN in event.message for event in events_of(simulation))


def test_nothing_is_known_of_a_star_that_was_never_searched_for(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    simulation.command(Standby())
    simulation.run(0.2)

    assert killed(simulation) == []
    simulation.command(Standby())
    assert mode_of(simulation) is Mode.STANDBY
    assert not any(KNOWN in event.message for event in events_of(simulation))


def test_a_place_of_before_the_computer_restarted_is_ignored(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)
    (place,) = killed(simulation, recall=False)

    simulation.supervisor.recall(
        [msgspec.structs.replace(place, time_s=simulation.clock.now_s() + 1.0)]
    )

    assert search_from_arcsec(simulation, held_arcsec) > 80.0


def killed_while_the_link_searches(*, far_rad=20.0):
    """A testbed whose laser is back; its supervisor was killed in a search for the beam, far from it."""
    records = []
    rig = load_rig(default_rig_path().with_name("fit-testbed.toml"), [])
    simulation = Simulation(rig, 0, star_offset_px=(10.0, -6.0), record=records.append)
    simulation.records = records
    simulation.acquire()
    until_all(simulation, metrology=Mode.LOCKED, left=Mode.VERNIER, right=Mode.VERNIER)
    laser = simulation.plant.loops["metrology"].inputs.laser
    servo = simulation.supervisor.servos["metrology"]
    locked_rad, power = servo.position_rad, laser.copy()
    laser[:] = 0.0
    while np.abs(servo.position_rad - locked_rad).max() < far_rad:
        simulation.run(0.1)
        assert simulation.clock.now_s() < 200.0
    places = killed(simulation)
    laser[:] = power
    return simulation, places


def until_all(simulation, limit_s=60.0, **modes):
    end_s, loops = simulation.clock.now_s() + limit_s, simulation.supervisor.loops
    while any(loops[name].mode is not mode for name, mode in modes.items()):
        assert simulation.clock.now_s() < end_s, {name: loops[name].mode for name in modes}
        simulation.run(0.1)


@pytest.mark.long
def test_what_the_link_turns_until_it_holds_again_moves_the_place_of_the_star():
    """Its siderostat goes on with its search before the loop's own search begins."""
    simulation, _ = killed_while_the_link_searches()
    simulation.command(Standby())
    assert simulation.command(Acquire(loop="metrology")).accepted
    simulation.run(1.0)
    for name in ("left", "right"):
        assert simulation.command(Acquire(loop=name)).accepted

    until_all(simulation, metrology=Mode.LOCKED, left=Mode.VERNIER, right=Mode.VERNIER)
    texts = [event.message for event in events_of(simulation) if event.source == "left"]
    assert any(KNOWN in text for text in texts)


@pytest.mark.long
def test_a_place_with_the_link_goes_through_any_number_of_killed_supervisors():
    simulation, places = killed_while_the_link_searches()
    simulation.command(Standby(loop="metrology"))
    simulation.command(Acquire(loop="metrology"))
    simulation.run(0.5)
    assert {place.loop for place in places} == {"metrology", "left", "right"}

    killed(simulation)
    simulation.acquire()
    until_all(simulation, metrology=Mode.LOCKED, left=Mode.VERNIER, right=Mode.VERNIER)


@pytest.mark.long
def test_a_link_whose_encoders_lost_their_zero_leads_nowhere():
    simulation, _ = killed_while_the_link_searches()
    lose_zero(simulation, "metrology")
    simulation.command(Standby(loop="left"))
    assert {place.loop for place in simulation.supervisor.places} == {"metrology", "left", "right"}

    simulation.command(Standby(loop="metrology"))

    assert {place.loop for place in simulation.supervisor.places} == {"right"}
    simulation.run(0.1)
    texts = [event.message for event in events_of(simulation) if event.source == "left"]
    assert any("encoders of metrology" in text and FORGOTTEN in text for text in texts)


def test_a_place_says_where_the_motors_were(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    simulation.acquire()
    until(simulation, Mode.VERNIER)

    (place,) = simulation.supervisor.places

    assert place.loop == "right"
    assert (place.link_az_rad, place.link_el_rad) == (0.0, 0.0)
    motor_rad = simulation.supervisor.servos["right"].position_rad
    assert (place.siderostat_az_rad, place.siderostat_el_rad) == tuple(motor_rad)
    assert math.isfinite(place.az_px + place.el_px)


@pytest.mark.long
def test_a_beam_that_was_not_found_is_searched_for_where_it_was():
    simulation, places = killed_while_the_link_searches()
    (beam,) = [place for place in places if place.loop == "metrology"]
    simulation.command(Standby())
    simulation.run(0.1)

    assert simulation.command(Acquire(loop="metrology")).accepted
    loop = simulation.supervisor.loops["metrology"]
    assert loop.search.centre_rad.tolist() == [beam.search_az_rad, beam.search_el_rad]
    texts = [event.message for event in events_of(simulation) if event.source == "metrology"]
    assert any("the search for the beam is known" in text for text in texts)


@pytest.mark.long
def test_encoders_that_lost_their_zero_lead_to_no_place_of_a_search_for_a_beam():
    simulation, _ = killed_while_the_link_searches()
    assert simulation.supervisor.loops["metrology"].place is not None
    lose_zero(simulation, "metrology")
    simulation.command(Standby())

    assert simulation.supervisor.loops["metrology"].place is None


FAST = {"rate_az_sky_arcsec_s": 12.0, "rate_el_sky_arcsec_s": -9.0}
TRUE = "plant.loops.right.star_rate_sky_arcsec_s={az=12.0, el=-9.0}"


@pytest.fixture
def follows(simulate_with):
    """A star whose rate a command gave is held, and its supervisor killed; the next one is in STANDBY."""
    simulation = simulate_with(TRUE, star_offset_px=(10.0, -6.0))
    simulation.command(Standby())
    simulation.run(0.2)
    assert simulation.command(Acquire(**FAST)).accepted
    until(simulation, Mode.VERNIER)
    simulation.run(10.0)
    killed(simulation)
    simulation.run(5.0)
    killed(simulation)  # what was not used yet is passed on
    simulation.command(Standby())
    simulation.run(0.2)
    return simulation


@pytest.mark.long
def test_a_star_whose_rate_a_command_gave_is_followed_by_the_next_supervisor(follows):
    assert follows.command(Acquire()).accepted
    until(follows, Mode.VERNIER, limit_s=10.0)
    follows.run(10.0)
    spot_px = follows.plants["right"].spots_px(follows.clock.now_s())[0, 0]
    target_px = follows.supervisor.stellar_loops["right"].target_px
    assert spot_px == pytest.approx(target_px, abs=0.15)


@pytest.mark.long
@pytest.mark.parametrize("times", [1, 2])
def test_a_rate_of_before_the_kill_holds_for_one_search(follows, times):
    for _ in range(times):
        assert follows.command(Acquire()).accepted
    (place,) = follows.supervisor.places
    assert place.rate_is_given is (times == 1)


@pytest.mark.long
def test_a_command_that_gives_a_place_means_another_star(follows):
    other = Acquire(expected_az_sky_arcsec=50.0, expected_el_sky_arcsec=0.0)
    assert follows.command(other).accepted
    loop = follows.supervisor.stellar_loops["right"]
    before_rad = loop.star_motion.sky.turned_at(follows.clock.now_s())
    assert (
        loop.star_motion.sky.turned_at(follows.clock.now_s() + 9.0).tolist() == before_rad.tolist()
    )


@pytest.mark.long
def test_a_rig_file_s_rate_that_came_after_the_kill_counts_from_the_kill_on(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)
    rate = "loops.right.star_rate_sky_arcsec_s={az=1.0, el=0.0}"
    simulation.rig = load_rig(default_rig_path(), [rate])
    before_s = simulation.clock.now_s()
    killed(simulation)

    moved_arcsec = simulation.clock.now_s() - before_s
    assert search_from_arcsec(simulation, held_arcsec) < 40.0 + moved_arcsec


def test_places_of_unknown_loops_or_of_another_kind_are_ignored(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    nowhere = {"siderostat_az_rad": 1.0, "siderostat_el_rad": 1.0}
    beam = BeamPlace(time_s=0.0, loop="right", search_az_rad=9.0, search_el_rad=9.0, **nowhere)
    star = StarPlace(time_s=0.0, loop="middle", az_px=1.0, el_px=1.0, **nowhere)

    simulation.supervisor.recall([beam, star])

    assert simulation.supervisor.places == []
