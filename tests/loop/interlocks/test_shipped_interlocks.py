"""Each interlock of the shipped rig file: struck, it trips and acts; healed, it resets as the file says."""

import pytest
from interlock_bench import RESETS_WITHIN_S, ROWS, STRIKES, struck

from fitctl.messages.commands import Recover, Reset
from fitctl.messages.modes import Mode


def test_every_shipped_row_is_struck_here():
    assert set(STRIKES) == set(ROWS)


@pytest.mark.parametrize("name", STRIKES)
def test_a_shipped_row_trips_acts_and_resets(name):
    bench = struck(name)
    trip, loop = bench.tripped[name], bench.loop

    assert trip.action == ROWS[name].action
    assert trip.reset == ROWS[name].reset
    told = [event.severity for event in bench.told(trip.reason)]
    assert told.count("error" if trip.action == "safe" else "warning") == 1
    if trip.action == "safe":
        assert bench.loop.mode is Mode.SAFE
        assert bench.loop.last_change.reason == trip.reason
    elif trip.action == "freeze":
        before = (*loop.mirror.stack_v, *loop.siderostat.setpoint_rad)
        bench.run(0.5)
        assert (*loop.mirror.stack_v, *loop.siderostat.setpoint_rad) == before

    RESETS[trip.reset](bench, name)


def resets_itself_once_its_cause_is_gone(bench, name):
    bench.run(0.5)
    assert name in bench.tripped
    bench.heal()

    assert bench.until(lambda: name not in bench.tripped, RESETS_WITHIN_S)
    assert bench.told(f"interlock {name} is over")


def waits_for_a_hand(bench, name):
    bench.heal()
    bench.run(5.0)
    assert name in bench.tripped
    was = bench.loop.mode
    assert was is (Mode.SAFE if ROWS[name].action == "safe" else Mode.VERNIER)

    if was is Mode.SAFE and bench.loop.servo.fault is not None:
        assert not bench.simulation.command(Reset(name=name)).accepted  # its cause is still there
    else:
        assert bench.simulation.command(Reset(name=name)).accepted
        assert name not in bench.tripped
        assert bench.loop.mode is was
    if was is Mode.SAFE:
        assert bench.simulation.command(Recover()).accepted
        bench.run(3.0)
        assert not bench.tripped
        assert bench.loop.mode is Mode.STANDBY


RESETS = {"itself": resets_itself_once_its_cause_is_gone, "hand": waits_for_a_hand}
