"""What the swarm requires of siderostats, mirrors and hexapod: limits, and rest."""

from random import Random

import numpy as np
import pytest

from benchmarks.swarm.devices.hexapod import SwarmHexapod
from fitctl.drivers.interface import Pose
from fitctl.messages.commands import Experiment, Jog, Reply
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive
from tests.benchmarks.watched import TESTBED, TICK_S, Rig


@pytest.mark.parametrize(
    ("motor_rad", "zero_rad", "velocity_rad_s", "violated"),
    [
        (90.0, 0.0, 5.0, ["no siderostat is driven beyond its travel"]),
        (-90.0, 0.0, -5.0, ["no siderostat is driven beyond its travel"]),
        (90.0, 0.0, -5.0, []),  # on its way back
        (90.0, 0.0, 0.5, []),  # where it is held
        (70.0, 0.0, 5.0, []),
        (90.0, 40.0, 5.0, []),  # by the drive's count, within it
        (70.0, -40.0, 5.0, ["no siderostat is driven beyond its travel"]),
    ],
)
def test_no_motor_that_is_beyond_its_travel_is_driven_farther(
    motor_rad, zero_rad, velocity_rad_s, violated
):
    watched = Rig()
    watched.plant.loops["right"].state.motor_rad[0] = 0.0, motor_rad
    watched.amplifiers["right"].zero_rad = 0.0, zero_rad
    for rad_s in np.linspace(0.0, velocity_rad_s, 11):  # as fast as it may accelerate
        watched.invariants.motion.velocity("right", (0.0, rad_s))

    assert watched.go_on(0.1) == violated


def test_a_motor_beyond_its_travel_may_return_to_where_it_was_sent_back_from_and_no_farther():
    watched = Rig()
    motor_rad = watched.plant.loops["right"].state.motor_rad[0]
    send = watched.invariants.motion.velocity
    motor_rad[:] = 0.0, 82.0
    for rad_s in np.linspace(0.0, -5.0, 11):
        send("right", (0.0, rad_s))
    motor_rad[:] = 0.0, 81.0
    for rad_s in np.linspace(-5.0, 5.0, 21):  # a release: it is held where it was
        send("right", (0.0, rad_s))
    assert watched.go_on(0.1) == []

    motor_rad[:] = 0.0, 82.5
    send("right", (0.0, 5.0))
    assert watched.go_on(0.1) == ["no siderostat is driven beyond its travel"]


def test_a_velocity_changes_no_faster_than_a_motor_may_accelerate_but_for_a_stop():
    watched = Rig()
    siderostat = watched.rig.loops["right"].siderostat
    step_rad_s = siderostat.acceleration_limit_rad_s2 / siderostat.servo.rate_hz
    send = watched.invariants.motion.velocity
    for number in range(5):
        send("right", (number * step_rad_s, 0.0))
    send("right", (0.0, 0.0))
    assert watched.go_on(0.1) == []

    send("right", (0.0, 1.1 * step_rad_s))
    assert watched.go_on(0.1) == ["acceleration within its limit"]


def test_motors_that_turn_though_none_is_sent_a_velocity_are_noticed():
    watched = Rig(mode=Mode.SAFE)
    watched.amplifiers["right"].velocity_rad_s = 1.0, 0.0

    assert watched.go_on(1.5) == []
    assert watched.go_on(0.3) == ["motors stand still in OFF and SAFE"]


def test_a_drive_that_watches_nobody_turns_on_while_it_cannot_be_reached():
    watched = Rig(mode=Mode.SAFE)
    amplifiers = watched.amplifiers["right"]
    amplifiers.watches_nobody, amplifiers.velocity_rad_s = True, (1.0, 0.0)
    amplifiers.line.faults["deaf"] = 0.0

    assert watched.go_on(10.0) == []


MOVES = ["a siderostat at rest stays where it is"]
SLEWS = ["a siderostat whose loop is held stays where it is"]


def turn(watched, turned_rad=0.01):
    """Turn a motor that stood still."""
    watched.go_on(0.1)
    watched.plant.loops["right"].state.motor_rad[0, 0] += turned_rad


def test_a_siderostat_moves_in_standby_only_after_a_jog():
    watched = Rig(mode=Mode.STANDBY)
    watched.go_on(10.0)
    jog = Jog(az_sky_arcsec=10.0, el_sky_arcsec=0.0)
    watched.invariants.posted(jog, "ada")
    turn(watched)
    watched.go_on(1.0)
    watched.invariants.answered(jog, Reply(accepted=True))
    watched.go_on(2.0)
    turn(watched)
    assert watched.go_on(5.0) == []

    turn(watched, turned_rad=1e-4)  # no more than its encoder counts
    assert watched.go_on(0.1) == []
    turn(watched)
    assert watched.go_on(0.1) == MOVES


def test_in_standby_a_servo_may_go_back_to_where_it_was_after_a_fault():
    watched = Rig(mode=Mode.STANDBY)
    line = watched.lines["right siderostat"]
    watched.go_on(10.0)
    line.faults["slow"] = 10.0
    turn(watched)
    watched.go_on(0.1)
    line.heal()
    turn(watched)

    assert watched.go_on(0.1) == []


def test_motors_that_are_stuck_are_commanded_in_standby():
    watched = Rig(mode=Mode.STANDBY)
    watched.go_on(10.0)
    watched.lines["right siderostat"].wrong["stuck"] = 0.0
    turn(watched)

    assert watched.go_on(0.1) == []


def test_a_siderostat_slows_down_and_stands_still_while_an_interlock_holds_its_loop():
    watched = Rig(mode=Mode.ACQUISITION)
    turn(watched)
    assert watched.go_on(5.0) == []

    interlocks = watched.loops["right"].interlocks
    interlocks.holds = True
    turn(watched)  # as it slows down
    assert watched.go_on(3.0) == []

    turn(watched)
    assert watched.go_on(0.1) == SLEWS


def test_a_siderostat_that_was_held_may_move_as_soon_as_it_is_held_no_more():
    watched = Rig(mode=Mode.COARSE)
    interlocks = watched.loops["right"].interlocks
    for holds in (True, False, True):
        interlocks.holds = holds
        turn(watched)
        assert watched.go_on(1.0) == []


@pytest.mark.parametrize(
    ("pose", "velocity_mm_s", "violated"),
    [
        (Pose(), 1.0, []),
        (Pose(x_mm=1000.0), 1.0, ["the hexapod's poses within its travel"]),
        (Pose(), 1000.0, ["the hexapod's velocity within its limit"]),
    ],
)
def test_the_hexapod_is_sent_nothing_beyond_its_limits(pose, velocity_mm_s, violated):
    watched = Rig(TESTBED)
    hexapod = SwarmHexapod(
        watched.plant, watched.time, watched.rig, Random(1), watched.invariants.motion.pose
    )
    hexapod.line.connected = True
    watched.time.spawn(lambda: hexapod.move_to(pose, velocity_mm_s), "moves")

    assert watched.go_on(0.1) == violated


def swings(watched, seconds):
    """Write two voltages in turn, each within the slew."""
    low_v, high_v = np.full(3, 5.0), np.full(3, 5.2)
    for _ in range(round(seconds / TICK_S)):
        watched.go_on(TICK_S)
        watched.invariants.motion.volts("right", high_v, low_v)
        low_v, high_v = high_v, low_v
    return [one.invariant for one in watched.invariants.violations]


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.SAFE, Mode.STANDBY])
def test_a_mirror_that_swings_at_rest_is_noticed(mode):
    watched = Rig(mode=mode)

    assert swings(watched, 1.0) == []
    assert swings(watched, 0.5) == ["a mirror at rest stays where it is"]


@pytest.mark.parametrize("since_s", [0.0005, 0.02])
@pytest.mark.parametrize("mode", [Mode.SAFE, Mode.STANDBY, Mode.VERNIER])
def test_the_first_write_at_rest_is_within_the_slew_if_it_was_decided_there(since_s, mode):
    watched = Rig(mode=mode)
    watched.go_on(5.0)
    watched.loops["right"].mode_since_s = watched.time.now_s() - since_s
    watched.invariants.motion.volts("right", np.full(3, 7.0), np.full(3, 5.0))

    jumps = since_s > 0.001 and mode is not Mode.VERNIER
    assert watched.go_on(0.1) == ["the mirror rests no faster than its slew"] * jumps


@pytest.mark.parametrize(
    ("channel", "step_v", "moved", "jumps"),
    [
        ("siderostat_az", 1.0, False, True),
        ("siderostat_az", 0.36, False, False),
        ("siderostat_az", 1.0, True, False),
        ("fsm_az", 1.0, False, False),
    ],
)
def test_an_experiment_that_does_not_move_the_mirror_brings_it_to_its_bias_within_the_slew(
    channel, step_v, moved, jumps
):
    watched = Rig(mode=Mode.EXPERIMENT)
    drive = Drive(channel=channel, shape="sine", amplitude=1.0, frequency_hz=1.0, duration_s=60.0)
    asks = Experiment(loop="right", name="try", drives=[drive])
    watched.invariants.answered(asks, Reply(accepted=True))
    watched.go_on(5.0)
    if moved:  # by the D/A's own watchdog
        watched.invariants.motion.mirror_moved("right")
    watched.invariants.motion.volts("right", np.full(3, 5.0), np.full(3, 5.0 + step_v))

    assert watched.go_on(0.1) == ["the mirror rests no faster than its slew"] * jumps


@pytest.mark.parametrize(
    ("part", "violated"), [(0.99, []), (1.01, ["the mirror stays within its range"])]
)
@pytest.mark.parametrize("direction", [(1.0, 0.0), (0.5, -0.5)])
def test_a_mirror_that_points_stays_within_its_diamond(part, violated, direction):
    watched = Rig(mode=Mode.VERNIER)
    watched.go_on(5.0)
    fsm = watched.rig.stellar_loops["right"].fsm
    watched.loops["right"].mirror.command_rad = part * fsm.range_rad * np.array(direction)
    watched.invariants.motion.volts("right", np.full(3, 5.0), np.full(3, 5.0))

    assert watched.go_on(0.1) == violated


def test_a_mirror_may_go_back_to_its_bias_after_its_dac_has_moved_it():
    watched = Rig(mode=Mode.SAFE)
    watched.go_on(5.0)
    watched.invariants.motion.mirror_moved("right")

    assert swings(watched, 1.0) == []
