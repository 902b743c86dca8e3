"""Alarms of real states: each cause once, and no reset asked for that is not needed.

The states are those of an instrument on the virtual clock: every row of the shipped interlocks tripped by what
it is about, every device failed, commands that fail, two loops on one camera.
"""

import pytest
from instruments.simulated import failing
from interlock_bench import STRIKES, Bench, light, struck
from samples.replay_courses import two_loops

from fitctl.config import ConfigError
from fitctl.drivers.interface import DeviceTimeout, DeviceUnreachable
from fitctl.messages.commands import (
    Acquire,
    Off,
    Recover,
    Release,
    Reset,
    SetController,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.messages.troubles import troubles
from fitctl.tui.alarms import AlarmBook
from fitctl.tui.state import ConsoleState

LOST = [("right: star lost", "acquire ends the search")]
# What each strike's alarms begin with, and how they tell what to do; the last word is what resets it.
OF_STRIKES = {
    "star_lost": LOST,
    "flux_low": [("interlock flux_low: star of right: ", "star_flux_dn")],
    "fsm_edge": [("interlock fsm_edge: mirror right: ", "crossover_hz")],
    "siderostat_limit": [*LOST, ("interlock siderostat_limit: ", "a wrong star")],
    "siderostat_beyond": [("interlock siderostat_beyond: ", "then recover")],
    "siderostat_rate": [
        ("interlock siderostat_rate: ", "then recover"),
        ("interlock siderostat_moves: ", "cut the motors' power"),
    ],
    "siderostat_moves": [("interlock siderostat_moves: ", "cut the motors' power")],
    "following_error": [("interlock following_error: ", "gain_per_s")],
    "amplifier_fault": [("siderostat at can0: expected no fault, got hot", "wait, then recover")],
    "amplifier_slow": [("interlock amplifier_slow: ", "what else is on it")],
    "servo_overrun": [("interlock servo_overrun: ", "realtime rights")],
    "piezo_limit": [("interlock piezo_limit: ", "correct limit_v, then recover")],
    "piezo_fault": [("piezo amplifier at ttyUSB0: ", "remove its cause, then recover")],
    "dac_watchdog": [("interlock dac_watchdog: ", "then recover")],
    "dac_slow": [("interlock dac_slow: ", "what else is on it")],
    "frame_missing": [("interlock frame_missing: camera at ", "then recover")],
    "frame_age": [("interlock frame_age: ", "the delay")],
    "frame_interval": [("interlock frame_interval: ", "frame rate")],
    "loop_overrun": [
        ("interlock dac_slow: ", "what else is on it")
    ],  # which is why the tick is long
    "disk_space": [("interlock disk_space: computer: ", "another logging.folder")],
    "recorder_behind": [("interlock recorder_behind: ", "at the disk")],
    "clock_step": [("interlock clock_step: ", "then reset clock_step")],
}
FAILING = {
    "camera": ("camera", "next_frame"),
    "D/A": ("dac", "confirm"),
    "piezo": ("piezo", "stack_volts"),
    "siderostat": ("amplifiers", "exchange"),
}
GONE = DeviceUnreachable("device", "127.0.0.1:1", "an answer", "nothing", "look at the cable")
SILENT = DeviceTimeout("device", "127.0.0.1:1", "a connection", "none", "look at the cable")


def alarms(bench):
    """What the console shows, weightiest first: what is wrong, and what to do."""
    message = bench.telemetry()
    state, book = ConsoleState(message.time_s), AlarmBook()
    state.accept(message, message.time_s)
    state.now_s = message.time_s
    book.update(state)
    return [(alarm.what, alarm.todo) for alarm in book.in_order]


def lines(bench):
    """What `fitctl status` prints."""
    return [trouble.line for trouble in troubles(bench.telemetry())]


def of(bench, name, part):
    devices = bench.simulation.devices
    return devices.camera if part == "camera" else getattr(devices.loops[name], part)


def fail(bench, device, error=GONE, loop="right"):
    part, method = FAILING[device]
    bench.replace(of(bench, loop, part), method, lambda _old, *_: failing(error)())


def assert_alarms(found, expected):
    assert len(found) == len(expected), found
    for (what, todo), (begins, ends) in zip(sorted(found), sorted(expected), strict=True):
        assert what.startswith(begins), found
        assert ends in todo, found


# One of each kind: each takes a third of a second.
OFTEN_TESTED = {
    "star_lost",
    "fsm_edge",
    "siderostat_moves",
    "amplifier_fault",
    "servo_overrun",
    "piezo_limit",
    "dac_slow",
    "frame_missing",
    "disk_space",
}


def test_every_row_of_the_shipped_interlocks_has_its_case():
    assert OF_STRIKES.keys() == STRIKES.keys()


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(name, marks=[] if name in OFTEN_TESTED else pytest.mark.long)
        for name in OF_STRIKES
    ],
)
def test_a_tripped_interlock_is_one_alarm_and_what_it_asks_for_is_enough(name):
    bench = struck(name)
    bench.run(3.0)

    found = alarms(bench)

    assert_alarms(found, OF_STRIKES[name])
    told = [what for what, _ in found]
    assert sum(any(what.split(": ")[-1] in line for what in told) for line in lines(bench)) == len(
        told
    )
    asked = " ".join(todo for _, todo in found)
    bench.heal()
    bench.run(0.5)
    if "recover" in asked:
        assert bench.simulation.command(Recover()).accepted
    if "then reset" in asked:
        assert bench.simulation.command(Reset(name=asked.split()[-1])).accepted
    if (
        bench.loop.mode is Mode.SAFE and "recover" not in asked
    ):  # by the operator's stop, which is no alarm
        bench.run(12.0)
    assert bench.until(lambda: not alarms(bench), 60.0), alarms(bench)


@pytest.mark.parametrize("device", FAILING)
def test_a_device_that_fails_is_one_alarm_and_one_line_of_the_status(device):
    bench = Bench()
    fail(bench, device)
    assert bench.until(lambda: bench.loop.mode is Mode.SAFE, 5.0)
    bench.run(8.0)

    assert_alarms(
        alarms(bench), [("device at 127.0.0.1:1: expected", "look at the cable, then recover")]
    )
    (line,) = lines(bench)
    assert line == f"right is SAFE: {GONE}, then recover"


def test_an_alarm_stays_the_same_one_when_the_loop_is_turned_off():
    bench = struck("piezo_limit")
    bench.run(3.0)
    book = AlarmBook()
    for command in (None, Off()):
        if command is not None:
            assert bench.simulation.command(command).accepted
            bench.run(1.0)
        message = bench.telemetry()
        state = ConsoleState(message.time_s)
        state.accept(message, message.time_s)
        state.now_s = message.time_s
        book.update(state)

    (alarm,) = book.in_order
    assert alarm.over_s is None
    assert alarm.todo.endswith("then standby")


def test_a_recovery_that_fails_by_the_same_device_is_still_one_alarm():
    bench = Bench()
    fail(bench, "piezo")
    assert bench.until(lambda: bench.loop.mode is Mode.SAFE, 5.0)
    bench.replace(of(bench, "right", "piezo"), "open", lambda _old: failing(SILENT)())
    bench.simulation.command(Recover())
    bench.run(3.0)

    ((what, todo),) = alarms(bench)

    assert what == "right: recover failed: device at 127.0.0.1:1: expected a connection, got none"
    assert todo == "look at the cable, then recover"
    assert len(lines(bench)) == 1
    assert lines(bench)[0].startswith("right is SAFE: recover failed: ")


def test_a_fault_during_a_search_is_one_alarm():
    bench = Bench()
    light(0.0, bench)
    bench.simulation.command(Release())
    bench.simulation.command(Acquire())
    bench.run(0.5)
    fail(bench, "camera")
    bench.run(1.0)

    assert_alarms(alarms(bench), [("device at 127.0.0.1:1: expected", "then recover")])
    assert len(lines(bench)) == 1


def test_standby_that_fails_asks_for_standby_and_is_over_when_it_is_accepted_again():
    bench = Bench()
    bench.simulation.command(Stop())
    bench.run(2.0)
    assert bench.simulation.command(Off()).accepted
    bench.replace(of(bench, "right", "piezo"), "open", lambda _old: failing(SILENT)())
    bench.simulation.command(Standby())
    bench.run(2.0)

    assert_alarms(
        alarms(bench), [("right: standby failed: device at", "look at the cable, then standby")]
    )
    assert lines(bench)[0].startswith("right: standby failed: ")

    bench.heal()
    bench.simulation.command(Standby())
    bench.run(1.0)
    assert alarms(bench) == []
    assert lines(bench) == []


def test_a_design_that_cannot_be_made_is_an_alarm_until_another_command():
    bench = Bench()
    bench.replace(
        bench.supervisor._design_jobs,
        "_design",
        lambda _old, *_: failing(ConfigError("unstable"))(),
    )
    bench.simulation.command(SetController(name="eq20"))
    bench.run(0.5)

    assert_alarms(
        alarms(bench), [("right: controller failed: no design eq20", "choose another design")]
    )
    bench.simulation.command(Release())
    assert alarms(bench) == []


def test_a_search_that_ended_without_a_star_is_an_alarm():
    bench = Bench("loops.right.acquisition.search_again_s=2.0")
    light(0.0, bench)
    assert bench.until(lambda: bench.loop.mode is Mode.STANDBY, 60.0)
    bench.run(0.1)

    assert_alarms(
        alarms(bench), [("right: search failed: the star that was lost", "then acquire again")]
    )


def test_the_operators_stop_is_no_alarm_and_one_line_of_the_status():
    bench = Bench()
    bench.simulation.command(Stop())
    bench.run(5.0)

    assert alarms(bench) == []
    assert lines(bench) == ["right is SAFE: stopped by the operator; recover, or off"]


# ---------------------------------------------------------------- two loops on one camera


@pytest.fixture
def both():
    return Bench(rig=two_loops())


def test_a_camera_that_fails_is_one_alarm_of_both_loops(both):
    fail(both, "camera")
    both.run(1.0)

    assert [loop.mode for loop in both.supervisor.loops.values()] == [Mode.SAFE] * 2
    assert_alarms(alarms(both), [("device at 127.0.0.1:1: expected", "then recover")])
    (line,) = lines(both)
    assert line.startswith("right, left are SAFE: device at ")


def test_a_silent_camera_is_one_alarm_of_both_loops(both):
    STRIKES["frame_missing"](both)
    both.run(1.0)

    assert_alarms(alarms(both), [("interlock frame_missing: camera at ", "then recover")])


def test_a_full_disk_is_one_alarm_of_both_loops(both):
    STRIKES["disk_space"](both)
    both.run(1.0)

    assert_alarms(alarms(both), [("interlock disk_space: computer: ", "logging.folder")])
    assert len(lines(both)) == 1


def test_two_devices_that_fail_in_two_loops_are_two_alarms(both):
    fail(both, "piezo", GONE, "right")
    other = DeviceUnreachable("device", "127.0.0.1:2", "an answer", "nothing", "look at the cable")
    fail(both, "piezo", other, "left")
    both.run(8.0)

    assert_alarms(
        alarms(both), [(f"device at 127.0.0.1:{n}: expected", "then recover") for n in (1, 2)]
    )
    assert len(lines(both)) == 2


def test_a_device_that_keeps_both_loops_from_standby_is_one_alarm(both):
    both.simulation.command(Stop())
    both.run(2.0)
    assert both.simulation.command(Off()).accepted
    both.replace(of(both, "left", "piezo"), "open", lambda _old: failing(SILENT)())
    both.simulation.command(Standby())
    both.run(1.0)

    assert_alarms(alarms(both), [("right, left: standby failed: device at", "then standby")])
    assert len(lines(both)) == 1
