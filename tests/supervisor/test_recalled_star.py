"""A supervisor that follows one that was killed goes back to the star that was known then."""

import math
from unittest.mock import patch

import msgspec
import numpy as np
import pytest
from instruments.simulated import darken, events_of, failing, mode_of, until

from fitctl.controllers.design.choose import design_for
from fitctl.drivers.interface import DeviceFault
from fitctl.messages.commands import Acquire, Off, Standby, Stop
from fitctl.messages.modes import Mode
from fitctl.model.optics import scales
from fitctl.simulation.devices import InlineExecutor
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
    far_rad = 120.0 / scales(simulation.rig, loop).motor_sky_arcsec_per_rad
    while np.abs(simulation.supervisor.servos["right"].position_rad - held_rad).max() < far_rad:
        simulation.run(0.1)
        assert simulation.clock.now_s() < 200.0
    scene._flux_dn = flux_dn
    return held_rad * scales(simulation.rig, loop).motor_sky_arcsec_per_rad


def killed(simulation, *, recall=True):
    """Another supervisor on the same devices, as the one before it left them."""
    places = simulation.supervisor.star_places
    simulation.devices.loops["right"].amplifiers.disable()
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


def test_a_supervisor_that_is_killed_before_it_opens_anything_passes_on_what_it_was_left(
    simulate_with,
):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)

    places = killed(simulation)
    simulation.run(2.0)

    assert killed(simulation) == places != []
    assert search_from_arcsec(simulation, held_arcsec) < 40.0


def test_without_it_the_search_begins_where_the_siderostat_stands(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    held_arcsec = searches_elsewhere(simulation)

    killed(simulation, recall=False)

    assert search_from_arcsec(simulation, held_arcsec) > 80.0


def lose_zero(simulation):
    """From now on the encoders count from zero where the motors are."""
    at_rad = simulation.supervisor.servos["right"].position_rad
    amplifiers = simulation.devices.loops["right"].amplifiers
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
    assert simulation.supervisor.star_places == []


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


def test_a_place_says_where_the_motors_were(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    simulation.acquire()
    until(simulation, Mode.VERNIER)

    (place,) = simulation.supervisor.star_places

    assert place.loop == "right"
    motor_rad = simulation.supervisor.servos["right"].position_rad
    assert (place.siderostat_az_rad, place.siderostat_el_rad) == tuple(motor_rad)
    assert math.isfinite(place.az_px + place.el_px)
