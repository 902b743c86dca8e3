"""Every accepted command that takes time ends once in each loop, and a failure stays until another command."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest
from instruments.simulated import NEAR, SlowExecutor, darken, events_of, failing, until

from fitctl.config import ConfigError
from fitctl.drivers.interface import DeviceTimeout
from fitctl.messages.command_table import COMMANDS
from fitctl.messages.commands import (
    Acquire,
    Off,
    Recover,
    Release,
    SetController,
    SetTarget,
    Shutdown,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode, Trigger

SILENT = DeviceTimeout("piezo right", "/dev/ttyUSB0", "an answer in 1 s", "none", "is it on?")


def state(simulation, loop="right"):
    now_s = simulation.clock.now_s()
    supervisor = simulation.supervisor
    return supervisor.outcomes.add_to(supervisor.loops[loop].state(now_s))


def outcome(simulation, number, loop="right"):
    (found,) = (each for each in state(simulation, loop).outcomes if each.number == number)
    return found


def ended(simulation, reply, limit_s=40.0):
    """How an accepted command ends in the loop."""
    assert reply.accepted, reply.text
    end_s = simulation.clock.now_s() + limit_s
    while outcome(simulation, reply.number).state == "under way":
        assert simulation.clock.now_s() < end_s, "it does not end"
        simulation.run(0.1)
    return outcome(simulation, reply.number)


@pytest.fixture
def fresh(simulate_with):
    return simulate_with(**NEAR)


@pytest.fixture
def no_star(simulate_with):
    simulation = simulate_with("loops.right.acquisition.search_radius_sky_arcsec=60.0", **NEAR)
    darken(simulation)
    simulation.command(Standby())
    return simulation


def broken_piezo(simulation, monkeypatch):
    piezo = simulation.devices.loops["right"].piezo
    monkeypatch.setattr(piezo, "open", failing(SILENT))


def test_each_command_that_takes_time_ends_done(fresh):
    course = [
        (Standby(), "STANDBY: all devices open"),
        (Acquire(), "VERNIER: "),
        (SetController(name="eq20"), "controller eq20 is in force"),
        (Stop(), None),
        (Recover(), "STANDBY: all devices open"),
        (Off(), "OFF: "),
    ]
    for command, text in course:
        reply = fresh.command(command)
        if text is None:
            assert (reply.accepted, reply.number) == (True, 0)
            fresh.run(2.0)
            continue
        found = ended(fresh, reply)
        assert (found.state, text in found.text) == ("done", True), found
        assert found.began_s <= found.ended_s
        assert state(fresh).last_failure is None

    takes_time = {row.make for row in COMMANDS if row.wait_s} - {Shutdown}  # which ends all of this
    assert takes_time == {type(command) for command, text in course if text}


def test_devices_that_do_not_open_fail_standby(fresh, monkeypatch):
    broken_piezo(fresh, monkeypatch)

    found = ended(fresh, fresh.command(Standby()))

    assert (found.state, found.command, found.text) == ("failed", "standby", str(SILENT))
    failure = state(fresh).last_failure
    assert (failure.what, failure.text) == ("standby", str(SILENT))
    assert failure.time_s == found.ended_s


def test_when_a_failed_command_has_ended_it_can_be_given_again(fresh, monkeypatch):
    executor = SlowExecutor()
    broken_piezo(fresh, monkeypatch)
    monkeypatch.setattr(fresh.supervisor._device_jobs, "_executor", executor)
    reply = fresh.command(Standby())
    executor.finish()
    fresh.run(0.1)
    assert outcome(fresh, reply.number).state == "under way"  # the devices are still being closed
    executor.finish()
    assert ended(fresh, reply, 1.0).state == "failed"

    monkeypatch.undo()

    assert ended(fresh, fresh.command(Standby())).state == "done"


def test_a_failure_is_over_once_another_command_is_accepted(fresh, monkeypatch):
    broken_piezo(fresh, monkeypatch)
    fresh.command(Standby())
    fresh.run(0.1)
    assert not fresh.command(Release()).accepted
    assert state(fresh).last_failure is not None

    assert fresh.command(SetTarget(az_px=22.0, el_px=19.0)).accepted

    assert state(fresh).last_failure is None


def test_opening_that_is_stopped_fails_and_says_so(fresh, monkeypatch):
    executor = SlowExecutor()
    monkeypatch.setattr(fresh.supervisor._device_jobs, "_executor", executor)
    reply = fresh.command(Standby())
    fresh.command(Stop())
    for _ in range(2):  # opened, closed
        executor.finish()
        fresh.run(0.1)

    found = outcome(fresh, reply.number)
    assert found.state == "failed"
    assert found.text.startswith("stopped while opening; when ready, recover")
    assert state(fresh).last_failure.text == found.text


def test_a_shutdown_while_devices_are_opened_leaves_safe_alone(fresh, monkeypatch):
    executor = SlowExecutor()
    fresh.command(Stop())
    monkeypatch.setattr(fresh.supervisor._device_jobs, "_executor", executor)
    reply = fresh.command(Recover())
    fresh.supervisor.stop("shutting down")
    for _ in range(2):  # opened, closed
        executor.finish()
        fresh.run(0.1)

    assert outcome(fresh, reply.number).state == "failed"
    assert state(fresh).mode == "SAFE"


def test_a_loop_that_goes_to_safe_while_its_devices_are_opened_has_failed(fresh, monkeypatch):
    executor = SlowExecutor()
    monkeypatch.setattr(fresh.supervisor._device_jobs, "_executor", executor)
    reply = fresh.command(Standby())
    fresh.supervisor.loops["right"].fire(Trigger.STOP, "an interlock")
    executor.finish()
    fresh.run(0.1)

    found = outcome(fresh, reply.number)
    assert (found.state, found.text) == ("failed", "right went to SAFE meanwhile; send recover")


def test_while_devices_are_opened_a_command_is_refused_with_what_to_wait_for(fresh, monkeypatch):
    monkeypatch.setattr(fresh.supervisor._device_jobs, "_executor", SlowExecutor())
    fresh.command(Standby())

    refused = fresh.command(Acquire())

    assert not refused.accepted
    assert refused.text == "acquire is not available while devices are opened; wait for STANDBY"


def test_a_star_that_is_not_found_fails_acquire(no_star):
    found = ended(no_star, no_star.command(Acquire()))

    assert found.state == "failed"
    assert "no star within 60 arcsec" in found.text
    assert state(no_star).last_failure.what == "acquire"


def test_a_fault_during_the_search_fails_acquire_with_its_reason(no_star, monkeypatch):
    reply = no_star.command(Acquire())
    monkeypatch.setattr(no_star.camera, "next_frame", failing(SILENT))

    found = ended(no_star, reply)

    assert (found.state, found.text) == ("failed", str(SILENT))


@pytest.mark.parametrize("command", [Release(), Stop()], ids=["release", "stop"])
def test_a_search_that_a_person_ends_is_no_failure(no_star, command):
    reply = no_star.command(Acquire())
    no_star.command(command)

    found = ended(no_star, reply)

    assert (found.state, found.text.split()[0]) == ("ended", type(command).__name__.lower())
    assert state(no_star).last_failure is None


def test_another_acquire_replaces_the_first(no_star):
    first = no_star.command(Acquire())
    second = no_star.command(Acquire())

    assert first.number != second.number
    assert outcome(no_star, first.number).state == "ended"
    assert outcome(no_star, first.number).text == "another acquire replaced it"
    assert ended(no_star, second).state == "failed"


def test_a_lost_star_that_does_not_come_back_in_time_is_a_failure_of_the_search(simulate_with):
    simulation = simulate_with("loops.right.acquisition.search_again_s=2.0", **NEAR)
    simulation.acquire()
    until(simulation, Mode.VERNIER)
    darken(simulation)
    until(simulation, Mode.STANDBY, limit_s=60.0)
    simulation.run(0.1)

    failure = state(simulation).last_failure
    assert failure.what == "search"
    assert "did not come back within 2 s" in failure.text


def test_a_mistake_in_the_making_of_a_design_says_what_it_is(fresh, monkeypatch):
    monkeypatch.setattr(fresh.supervisor._design_jobs, "_design", failing(KeyError("noise_px")))

    found = ended(fresh, fresh.command(SetController(name="lqg-ltr")))

    assert found.text == (
        "no design lqg-ltr: expected no error inside fitctl, got KeyError('noise_px'); "
        "report it with the log"
    )


def test_a_design_that_cannot_be_made_fails_and_the_old_one_stays(fresh, monkeypatch):
    before = state(fresh).controller
    monkeypatch.setattr(
        fresh.supervisor._design_jobs, "_design", failing(ConfigError("no such plant"))
    )

    found = ended(fresh, fresh.command(SetController(name="lqg-ltr")))

    assert found.state == "failed"
    assert "no design lqg-ltr: no such plant" in found.text
    assert state(fresh).last_failure.what == "controller"
    assert state(fresh).controller == before


def test_a_newer_controller_command_replaces_one_whose_design_is_not_there_yet(fresh, monkeypatch):
    made, may_go_on = [], threading.Event()
    design = fresh.supervisor._design_jobs._design

    def slow(rig, name, controller):
        assert may_go_on.wait(10.0)
        made.append(controller)
        return design(rig, name, controller)

    monkeypatch.setattr(fresh.supervisor._design_jobs, "_design", slow)
    before = state(fresh).controller
    with ThreadPoolExecutor(1) as executor:
        monkeypatch.setattr(fresh.supervisor._design_jobs, "_executor", executor)
        names = ["lqg-ltr", "minimum-variance", "lqg-ltr", "eq20", "minimum-variance"]
        replies = [fresh.command(SetController(name=name)) for name in names]
        may_go_on.set()

    fresh.run(0.1)

    assert len(made) == 2  # the first had begun
    texts = [outcome(fresh, reply.number).text for reply in replies[1:]]
    assert texts == [
        *["another controller replaced it"] * 3,
        "controller minimum-variance is in force",
    ]
    changed = [event.message for event in events_of(fresh) if "controller" in event.message]
    assert changed == [f"controller {before} -> minimum-variance: operator"]


def test_amplifiers_that_do_not_close_well_fail_off(fresh, monkeypatch):
    fresh.command(Standby())
    fresh.run(0.5)
    servo = fresh.supervisor.servos["right"]
    monkeypatch.setattr(servo, "close", failing(SILENT))

    found = ended(fresh, fresh.command(Off()))

    assert found.state == "failed"
    assert "right siderostat did not close well: " in found.text
    monkeypatch.undo()


def test_the_last_four_outcomes_are_kept(fresh, monkeypatch):
    broken_piezo(fresh, monkeypatch)
    replies = [fresh.command(Standby()) for _ in range(7)]
    fresh.run(0.1)

    numbers = [each.number for each in state(fresh).outcomes]

    assert numbers == [reply.number for reply in replies[-4:]]
