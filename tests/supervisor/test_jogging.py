"""Moving the stages by hand: in STANDBY alone, within limits, and nothing that was not asked for."""

import math

import numpy as np
import pytest

from fitctl.config import ARCSEC_PER_RAD
from fitctl.messages.commands import (
    Acquire,
    Jog,
    Off,
    Recover,
    Release,
    SetBiasOffset,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode


@pytest.fixture
def standby(simulate_with):
    simulation = simulate_with(star_offset_px=(10.0, -6.0))
    assert simulation.command(Standby()).accepted
    simulation.run(0.5)
    assert loop_of(simulation).mode is Mode.STANDBY
    return simulation


def loop_of(simulation):
    return simulation.supervisor.loops["right"]


def sky_arcsec(simulation):
    tick = simulation.ticks[-1]
    return np.array([tick.siderostat_az_sky_arcsec, tick.siderostat_el_sky_arcsec])


def test_a_jog_moves_the_siderostat_by_as_much_as_was_asked_and_no_mirror(standby):
    before = sky_arcsec(standby)
    assert standby.command(Jog(az_sky_arcsec=10.0, el_sky_arcsec=-4.0)).accepted
    standby.run(2.0)

    assert sky_arcsec(standby) - before == pytest.approx([10.0, -4.0], abs=0.05)
    assert loop_of(standby).mirror.at_bias()


def test_jogs_add_up(standby):
    before = sky_arcsec(standby)
    for _ in range(3):
        assert standby.command(Jog(az_sky_arcsec=1.0, el_sky_arcsec=0.0)).accepted
    standby.run(2.0)

    assert sky_arcsec(standby) - before == pytest.approx([3.0, 0.0], abs=0.05)


@pytest.mark.parametrize("az", [200.0, -200.0, math.nan, math.inf])
def test_a_jog_beyond_a_field_of_view_is_refused_and_moves_nothing(standby, az):
    before = loop_of(standby).siderostat.setpoint_rad.copy()
    reply = standby.command(Jog(az_sky_arcsec=az, el_sky_arcsec=0.0))

    assert not reply.accepted
    assert "at most a field of view, 108.3 arcsec" in reply.text
    assert (loop_of(standby).siderostat.setpoint_rad == before).all()


def test_no_jog_leaves_the_travel(standby):
    travel_arcsec = loop_of(standby).settings.siderostat.travel_sky_arcsec
    jogs = math.ceil(travel_arcsec / 100.0) + 1
    replies = [standby.command(Jog(az_sky_arcsec=100.0, el_sky_arcsec=0.0)) for _ in range(jogs)]

    assert not replies[-1].accepted
    assert "would leave its travel" in replies[-1].text
    siderostat = loop_of(standby).siderostat
    assert abs(siderostat.setpoint_rad).max() <= siderostat.travel_rad


@pytest.mark.parametrize(
    "command",
    [Jog(az_sky_arcsec=1.0, el_sky_arcsec=0.0), SetBiasOffset(az_urad=1.0, el_urad=0.0)],
)
def test_stages_are_moved_by_hand_only_in_standby(simulate_with, command):
    simulation = simulate_with()
    reply = simulation.command(command)

    assert not reply.accepted
    assert "only in STANDBY (is OFF)" in reply.text


def test_the_mirror_goes_to_its_offset_no_faster_than_it_may_and_back_with_it(standby):
    loop = loop_of(standby)
    assert standby.command(SetBiasOffset(az_urad=40.0, el_urad=-20.0)).accepted
    standby.run(3.0)
    assert loop.mirror.now_rad * 1e6 == pytest.approx([40.0, -20.0], abs=0.5)

    stack_v = np.array([[t.stack1_v, t.stack2_v, t.stack3_v] for t in standby.ticks])
    most_v = loop.settings.fsm.slew_v_per_s * standby.supervisor.rig.camera.period_s
    assert np.abs(np.diff(stack_v, axis=0)).max() <= most_v * (1 + 1e-9)

    assert standby.command(SetBiasOffset(az_urad=0.0, el_urad=0.0)).accepted
    standby.run(3.0)
    assert loop.mirror.at_bias()


@pytest.mark.parametrize("az", [500.0, math.nan])
def test_an_offset_beyond_the_diamond_is_refused(standby, az):
    reply = standby.command(SetBiasOffset(az_urad=az, el_urad=0.0))

    assert not reply.accepted
    assert "within the mirror's 177." in reply.text
    standby.run(0.5)
    assert loop_of(standby).mirror.at_bias()


@pytest.mark.parametrize("ending", [Stop(), Off()])
def test_stop_and_off_forget_the_offset(standby, ending):
    loop = loop_of(standby)
    standby.command(SetBiasOffset(az_urad=60.0, el_urad=0.0))
    standby.run(3.0)
    while not standby.command(ending).accepted:  # off waits for the mirror
        standby.run(0.1)
        assert standby.clock.now_s() < 60.0
    standby.run(3.0)

    assert not loop.mirror.bias_offset_rad.any()
    assert loop.mirror.at_bias()


def test_after_a_stop_nothing_moves_by_itself(standby):
    standby.command(SetBiasOffset(az_urad=60.0, el_urad=0.0))
    standby.run(1.0)
    standby.command(Stop())
    standby.run(2.0)
    standby.command(Recover())
    standby.run(2.0)

    assert loop_of(standby).mode is Mode.STANDBY
    assert loop_of(standby).mirror.at_bias()


def test_the_search_leaves_the_mirror_where_the_operator_put_it(standby):
    standby.command(SetBiasOffset(az_urad=30.0, el_urad=0.0))
    standby.run(2.0)
    standby.command(Acquire())
    standby.run(0.5)
    assert loop_of(standby).mirror.now_rad[0] * 1e6 == pytest.approx(30.0, abs=0.5)
    standby.command(Release())
    standby.run(0.5)
    assert loop_of(standby).mirror.now_rad[0] * 1e6 == pytest.approx(30.0, abs=0.5)


def test_a_siderostat_beyond_its_travel_can_be_jogged_back_and_no_farther(standby):
    """It turned on while its amplifiers did not answer."""
    stage = loop_of(standby).siderostat
    step = 20.0  # arcsec on the sky
    beyond_rad = step / ARCSEC_PER_RAD / loop_of(standby).settings.siderostat.sky_rad_per_motor_rad
    stage.hold(np.array([stage.travel_rad + 2.0 * beyond_rad, 0.0]))

    assert "jog the other way" in standby.command(Jog(az_sky_arcsec=step, el_sky_arcsec=0.0)).text
    assert standby.command(Jog(az_sky_arcsec=-step, el_sky_arcsec=0.0)).accepted
    assert standby.command(Jog(az_sky_arcsec=0.0, el_sky_arcsec=step)).accepted
