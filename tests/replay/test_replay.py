"""A log through today's code is the same to the last bit."""

import math
from types import SimpleNamespace

import pytest
from samples.replay_courses import COURSES, hold_a_star, replayed, two_loops

from fitctl.config import default_rig_path, load_rig
from fitctl.controllers.design.choose import design_for
from fitctl.logging.records import ControllerChange, ModeChange
from fitctl.messages.command_table import command_record
from fitctl.messages.commands import (
    Acquire,
    Off,
    Release,
    Reply,
    SetBiasOffset,
    Standby,
    Stop,
)
from fitctl.replay.devices import LoggedExecutor

QUICK = {
    "every command",
    "another star",
    "a lost star",
    "interlocks",
    "a star of a killed supervisor",
    "the piezo amplifier is silent",
}
assert COURSES.keys() >= QUICK


@pytest.mark.parametrize(
    ("course", "overrides", "happens"),
    [
        pytest.param(*course, id=name, marks=[] if name in QUICK else pytest.mark.long)
        for name, course in COURSES.items()
    ],
)
def test_a_run_replayed_is_the_same_to_the_last_bit(logged, course, overrides, happens):
    path, simulation = logged(course, *overrides)
    result = replayed(path)

    assert happens <= {change.trigger for change in simulation.mode_changes}
    assert result.same, result
    loop = result.loops["right"]
    assert loop.ticks == sum(tick.number >= 0 or tick.mode != "OFF" for tick in simulation.ticks)
    assert all(found.compared >= 2 * loop.ticks for found in loop.differences.values())


def test_an_off_that_was_refused_moves_the_mirror_only_if_that_is_the_reason(logged):
    def course(simulation):
        hold_a_star(simulation)
        simulation.command(Release())
        simulation.command(SetBiasOffset(az_urad=100.0, el_urad=0.0))
        simulation.run(1.0)
        refused = Reply(accepted=False, text="ada has the instrument")
        simulation.log(command_record(Off(), refused, "ben", "", simulation.clock.now_s()))
        simulation.run(0.5)
        assert "is on its way to its bias" in simulation.command(Off()).text
        simulation.run(0.5)

    path, _ = logged(course)
    result = replayed(path)

    assert result.same, result


@pytest.mark.long
def test_two_loops_that_do_different_things_are_replayed_together(logged):
    def course(simulation):
        simulation.command(Standby(loop="right"))
        simulation.command(Acquire(loop="right"))
        simulation.run(2.0)
        simulation.command(Standby(loop="left"))
        simulation.command(Acquire(loop="left"))
        simulation.run(4.0)
        simulation.command(Stop(loop="right"))
        simulation.run(0.5)

    path, simulation = logged(course, rig=two_loops())
    result = replayed(path)

    found = {(change.loop, change.trigger) for change in simulation.mode_changes}
    assert {("left", "IN_REACH"), ("right", "IN_REACH"), ("right", "STOP")} <= found
    assert result.same, result
    assert result.loops["left"].ticks > 200


def test_every_mode_change_of_the_log_says_where_the_motors_were(logged):
    changes = []
    logged(hold_a_star, change=lambda r: changes.append(r) or r)
    found = [record for record in changes if isinstance(record, ModeChange)]

    assert len(found) == 4
    assert not any(math.isnan(change.siderostat_az_rad) for change in found)


def test_a_design_that_another_command_replaced_is_not_made_again():
    rig, executor = load_rig(default_rig_path()), LoggedExecutor()
    names = ["minimum-variance", "eq20", "minimum-variance"]
    replaced, another, used = (
        executor.submit(design_for, rig, "right", controller) for controller in names
    )
    replaced.cancel()
    another.cancel()
    change = SimpleNamespace(loop="right", target="minimum-variance")
    executor.load_step(
        SimpleNamespace(of=lambda kind: [change] if kind is ControllerChange else [])
    )

    assert used.result(0).title == "minimum-variance"
    assert replaced.cancelled()
    assert another.cancelled()
