"""A rehearsal from an instrument's present state foresees what the instrument then does."""

import math

import pytest

from fitctl.config import default_rig_path, load_rig
from fitctl.messages.commands import Jog, Recover, Release, SetTarget, Stop
from fitctl.service.telemetry_buffer import ServiceState, TelemetryBuffer
from fitctl.simulation.rehearsal import RehearsalError, present_of, rehearse
from fitctl.simulation.simulation import Simulation

LIMIT_S = 120.0


class Instrument:
    """A rig of another seed than the rehearsal's, which a test commands and listens to."""

    def __init__(self, rig, seed=3):
        self.rig = rig
        self.buffer = TelemetryBuffer()
        self.simulation = Simulation(rig, seed, record=self.buffer.add)
        self.service = ServiceState(1, 0.0, "", lambda: 0, lambda: 0)
        self.simulation.acquire()
        self.simulation.run(25.0)

    def present(self):
        self.telemetry()
        self.simulation.run(0.1)
        return present_of([self.telemetry()])

    def telemetry(self):
        self.service.sequence += 1
        now_s = self.simulation.clock.now_s()
        return self.buffer.telemetry(self.simulation.supervisor, self.service, now_s)

    def foresee_and_do(self, command):
        """The rehearsal of a command, and the instrument after it really had the command for as long."""
        foreseen = rehearse(self.rig, self.present(), command, LIMIT_S)
        self.simulation.command(command)
        self.simulation.run(foreseen.duration_s)
        return foreseen, self.present()


@pytest.fixture
def instrument():
    return Instrument(load_rig(default_rig_path()))


def siderostat_of(present):
    return present.tick.siderostat_az_sky_arcsec, present.tick.siderostat_el_sky_arcsec


@pytest.mark.long
def test_a_new_target_is_foreseen_with_both_stages(instrument):
    foreseen, after = instrument.foresee_and_do(SetTarget(az_px=22.0, el_px=21.0))
    (end,) = foreseen.ends
    assert foreseen.accepted
    assert not foreseen.trips
    assert not foreseen.unlike
    assert end.mode == ("VERNIER", "VERNIER")
    assert math.dist(end.siderostat_sky_arcsec[1], siderostat_of(after["right"])) < 2.0
    tick = after["right"].tick
    mirror_urad = (1e6 * tick.fsm_az_rad, 1e6 * tick.fsm_el_rad)
    assert math.dist(end.mirror_urad[1], mirror_urad) < 40.0
    assert math.dist(*end.mirror_urad) > 40.0


@pytest.mark.long
def test_the_interlock_that_trips_is_foreseen_and_when(instrument):
    far = SetTarget(az_px=20.0, el_px=24.0)
    foreseen = rehearse(instrument.rig, instrument.present(), far, LIMIT_S)
    (trip,) = foreseen.trips
    assert (trip.loop, trip.name, trip.action) == ("right", "fsm_edge", "warn")
    loop = instrument.simulation.supervisor.loops["right"]
    instrument.simulation.command(far)
    began_s = instrument.simulation.clock.now_s()
    while not loop.interlocks.tripped:
        instrument.simulation.run(0.1)
        assert instrument.simulation.clock.now_s() - began_s < 20.0
    assert loop.interlocks.tripped[0].name == "fsm_edge"
    assert trip.after_s == pytest.approx(instrument.simulation.clock.now_s() - began_s, abs=2.0)


@pytest.mark.long
def test_a_jog_is_foreseen_to_its_place_or_to_its_refusal(instrument):
    instrument.simulation.command(Release())
    instrument.simulation.run(1.0)
    foreseen, after = instrument.foresee_and_do(Jog(az_sky_arcsec=20.0, el_sky_arcsec=-10.0))
    end = foreseen.ends[0].siderostat_sky_arcsec[1]
    assert math.dist(end, siderostat_of(after["right"])) < 0.5
    far = rehearse(
        instrument.rig, instrument.present(), Jog(az_sky_arcsec=2e3, el_sky_arcsec=0.0), LIMIT_S
    )
    assert not far.accepted
    assert "at most a field of view" in far.refused


@pytest.mark.long
def test_recover_from_safe_is_foreseen(instrument):
    instrument.simulation.command(Stop())
    instrument.simulation.run(1.0)
    foreseen, after = instrument.foresee_and_do(Recover())
    assert foreseen.ends[0].mode == ("SAFE", "STANDBY")
    assert after["right"].state.mode == "STANDBY"


@pytest.mark.long
def test_a_rehearsal_is_given_up_in_time(instrument):
    with pytest.raises(RehearsalError, match="the instrument was not touched"):
        rehearse(instrument.rig, instrument.present(), Recover(), 0.0)


@pytest.mark.long
def test_the_instrument_is_not_touched(instrument):
    present = instrument.present()
    state = instrument.simulation.plant.stellar_loops["right"].state
    motor_rad = state.motor_rad.copy()
    rehearse(instrument.rig, present, Stop(), LIMIT_S)
    assert (state.motor_rad == motor_rad).all()
    assert instrument.simulation.supervisor.loops["right"].mode.name == "VERNIER"
