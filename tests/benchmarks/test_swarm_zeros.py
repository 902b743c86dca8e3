"""What the swarm requires of encoders that lose their zero."""

import msgspec
import pytest

from benchmarks.swarm.devices.amplifiers import SwarmAmplifiers
from benchmarks.swarm.happenings import Strike
from benchmarks.swarm.rigs import RIGS
from benchmarks.swarm.run import run_plan
from fitctl.logging.records import Event
from fitctl.messages.commands import Acquire, Jog, Recover, Standby, Stop
from fitctl.stages.servo import SiderostatServo
from tests.benchmarks.plans import gives, plan

POWER_CUT = plan(
    gives(0.1, Standby()),
    gives(2.0, Acquire(expected_az_sky_arcsec=400.0, expected_el_sky_arcsec=0.0)),
    Strike(at_s=6.0, device="right siderostat", fault="power cut"),
    gives(7.0, Recover()),
)


@pytest.mark.long
def test_after_a_power_cut_of_its_amplifiers_a_star_is_found_again():
    result = run_plan(POWER_CUT)

    assert result.violations == []
    assert result.modes["VERNIER"] >= 1


def power_cuts_about_openings(times, step_s):
    """Every three seconds a jog, a stop, an opening and a power cut, each time a step later in the opening."""
    for number in range(times):
        at_s = 1.0 + 3.0 * number
        yield gives(
            at_s, Jog(loop="right", az_sky_arcsec=-60.0 if number % 2 else 60.0, el_sky_arcsec=0.0)
        )
        yield gives(at_s + 1.0, Stop())
        yield gives(at_s + 1.3, Recover())
        cut_s = at_s + 1.25 + step_s * number
        yield Strike(at_s=cut_s, device="right siderostat", fault="power cut")
        yield gives(at_s + 2.2, Recover())


@pytest.mark.long
@pytest.mark.parametrize("rig", sorted(RIGS.keys() - {"fit-testbed.toml"}))
def test_a_power_cut_at_any_instant_of_an_opening_is_noticed(rig):
    times, noticed = 60, []
    happenings = [gives(0.1, Standby()), *power_cuts_about_openings(times, 0.005)]

    def on_record(record):
        if isinstance(record, Event) and "encoders read elsewhere" in record.message:
            noticed.append(record.time_s)

    result = run_plan(plan(*happenings, duration_s=1.0 + 3.0 * times, rig=rig), on_record)

    assert result.violations == []
    assert [int((at_s - 1.0) / 3.0) for at_s in noticed] == list(range(times))


@pytest.mark.long
def test_encoders_that_lost_their_zero_unnoticed_are_a_violation(monkeypatch):
    never = property(lambda _: False, lambda _, jumped: None)
    monkeypatch.setattr(SiderostatServo, "encoders_jumped", never, raising=False)
    violated = {one.invariant for one in run_plan(POWER_CUT).violations}

    assert "encoders that count from elsewhere are noticed" in violated


@pytest.mark.long
def test_a_stage_that_moves_by_a_zero_that_is_lost_is_a_violation(monkeypatch):
    # As if the link outlived the loss of power. Analogue amplifiers do not report that they have none.
    monkeypatch.setattr(SwarmAmplifiers, "reset", SwarmAmplifiers._power_down)
    on_analogue = msgspec.structs.replace(POWER_CUT, rig="fit-bal-analog.toml")
    violated = {one.invariant for one in run_plan(on_analogue).violations}

    assert "no stage moves by a zero that is lost" in violated
