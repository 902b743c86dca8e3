"""What the swarm requires of devices that are silent, and of stages that are to stand still."""

from random import Random
from types import SimpleNamespace

import numpy as np
import pytest
from samples.learner_reports import report

from benchmarks.swarm.commands import LEARNT_DESIGNS
from benchmarks.swarm.devices.hexapod import SwarmHexapod
from benchmarks.swarm.instrument import RIGS as FOLDER
from benchmarks.swarm.invariants import NO_EXCEPTION, Invariants
from benchmarks.swarm.lines import FAULTS, WRONG, Line
from benchmarks.swarm.past import put_back
from benchmarks.swarm.plan import Order, Plan, Strike
from benchmarks.swarm.rigs import devices_of
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.threads import VirtualTime
from fitctl.config import load_rig
from fitctl.drivers.interface import Pose
from fitctl.logging.records import ModeChange
from fitctl.loop.learning import Learning
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import (
    Experiment,
    Jog,
    MoveCollector,
    Off,
    Release,
    Reply,
    SequenceControl,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import standstill
from fitctl.model.plant import Plant
from fitctl.stages.collector import CollectorDrive
from fitctl.stages.journal import error_text
from fitctl.stages.servo import SiderostatServo
from fitctl.supervisor.piezo import PiezoWatch

TESTBED = "fit-testbed.toml"
TICK_S = 0.1


def named(device):
    """As a device's errors name it."""
    kind = device.rpartition(" ")[2]
    return "piezo amplifier" if kind == "piezo" else kind


class Rig:
    """Invariants over stand-ins of a supervisor, of amplifiers and of lines that are all connected."""

    def __init__(self, rig="fit-mock.toml", mode=Mode.VERNIER):
        self.rig = load_rig(FOLDER / rig)
        self.time = VirtualTime()
        self.lines = {
            name: Line(named(name), "", self.time, Random(1), 0.001, 0.1)
            for name in devices_of(rig)
        }
        for line in self.lines.values():
            line.connected = True
        self.amplifiers = {
            name: SimpleNamespace(
                zero_rad=(0.0, 0.0),
                powered=mode not in {Mode.OFF, Mode.SAFE},
                watches_nobody=False,
                fault="",
                velocity_rad_s=(0.0, 0.0),
                master_timeout_s=0.5,
                line=self.lines[f"{name} siderostat"],
            )
            for name in self.rig.loops
        }
        self.plant = Plant(self.rig, [1], history_s=20.0)
        self.jobs = SimpleNamespace(busy=False)
        self.servo = SimpleNamespace(_wanted_rad=(0.0, 0.0), position_rad=(0.0, 0.0))
        self.loops = {
            name: SimpleNamespace(
                mode=mode,
                mode_since_s=0.0,
                servo=self.servo,
                mirror=SimpleNamespace(command_rad=np.zeros(2)),
            )
            for name in self.rig.loops
        }
        self.invariants = Invariants(self.rig, self.time, self.amplifiers, self.lines, self.plant)
        self.supervisor = SimpleNamespace(
            loops=self.loops,
            stellar_loops=self.loops,
            _device_jobs=self.jobs,
            piezos={},
            sequences=SimpleNamespace(),
        )
        self.invariants.watch(self.supervisor)

    def go_on(self, seconds):
        """Tick for a while; return what was violated until now."""
        for _ in range(round(seconds / TICK_S)):
            self.time.run_until(self.time.now_s() + TICK_S)
            self.invariants._ticks.update(list(self.loops))  # each has recorded one
            self.invariants.tick()
        return [one.invariant for one in self.invariants.violations]


SAFE = ["a loop without one of its devices is SAFE in time"]
SILENT = [
    ("fit-mock.toml", "right siderostat", 3.0),
    ("fit-mock.toml", "right D/A", 3.0),
    ("fit-mock.toml", "right piezo", 8.0),
    ("fit-mock.toml", "camera", 3.0),
    (TESTBED, "metrology photodiodes", 3.0),
]


@pytest.mark.parametrize(("rig", "device", "within_s"), SILENT)
def test_a_loop_whose_device_is_silent_must_be_safe_in_time(rig, device, within_s):
    watched = Rig(rig)
    watched.lines[device].faults["mute"] = 0.0

    assert watched.go_on(within_s) == []
    assert watched.go_on(0.3) == SAFE


@pytest.mark.parametrize("fault", [fault for fault in FAULTS if fault != "slow"])
def test_each_fault_of_a_line_that_leaves_no_answer_counts(fault):
    watched = Rig()
    watched.lines["right D/A"].faults[fault] = 0.0

    assert watched.go_on(4.0) == SAFE


def test_a_line_that_is_not_connected_is_silent():
    watched = Rig()
    watched.lines["right siderostat"].connected = False

    assert watched.go_on(4.0) == SAFE


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.SAFE])
def test_a_loop_that_is_safe_needs_no_device(mode):
    watched = Rig(mode=mode)
    watched.lines["right D/A"].faults["deaf"] = 0.0

    assert watched.go_on(20.0) == []


def test_time_in_which_devices_are_opened_or_the_machine_stalls_does_not_count():
    watched = Rig()
    watched.lines["right D/A"].faults["deaf"] = 0.0
    watched.go_on(1.0)
    watched.jobs.busy = True
    assert watched.go_on(10.0) == []
    watched.jobs.busy = False
    watched.invariants.stalled(*watched.time.stall(4.0))
    watched.time.run_until(watched.time.now_s() + 4.0)

    assert watched.go_on(1.5) == []
    assert watched.go_on(1.0) == SAFE


def test_a_pause_of_the_silence_between_two_ticks_counts():
    watched = Rig()
    line = watched.lines["right D/A"]
    for fault in ("deaf", "mute"):
        line.faults[fault] = 0.0
        watched.go_on(2.0)
        line.heal(fault)
    assert watched.go_on(1.0) == []

    line.faults["deaf"] = 0.0
    watched.go_on(2.0)
    line.faults["refuses"] = 0.0
    line.heal("deaf")
    assert watched.go_on(1.5) == SAFE


def test_a_loop_whose_amplifiers_have_tripped_must_be_safe_in_time():
    watched = Rig()
    watched.amplifiers["right"].fault = "overcurrent"

    assert watched.go_on(3.0) == []
    assert watched.go_on(0.3) == SAFE


@pytest.mark.parametrize("wrong", WRONG["piezo"])
def test_a_loop_whose_piezo_amplifier_is_wrong_must_be_safe_in_time(wrong):
    watched = Rig()
    watched.lines["right piezo"].wrong[wrong] = 0.0
    assert watched.go_on(7.0) == []
    watched.lines["right piezo"].heal(wrong)
    watched.lines["right piezo"].wrong[wrong] = 0.0

    assert watched.go_on(8.0) == []
    assert watched.go_on(0.3) == SAFE


def test_an_image_that_is_wrong_demands_no_safe():
    watched = Rig()
    watched.lines["camera"].wrong["saturated"] = 0.0

    assert watched.go_on(20.0) == []


def test_a_slow_line_is_not_silent():
    watched = Rig()
    watched.lines["right D/A"].faults["slow"] = 1000.0

    assert watched.go_on(10.0) == []


# ------------------------------------------------------------ travel


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


# ------------------------------------------------------------ rest


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


MOVES = ["a siderostat that nobody moves stands still in STANDBY"]


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


@pytest.mark.parametrize(
    ("wrong", "violated"), [("trip", ["an axis that is not stuck is not called so"]), ("stuck", [])]
)
def test_an_axis_may_be_called_stuck_only_if_it_is(wrong, violated):
    watched = Rig()
    line = watched.lines["right siderostat"]
    line.wrong[wrong] = 0.0
    line.heal()
    change = ModeChange(
        time_s=0.0,
        loop="right",
        source="VERNIER",
        target="SAFE",
        target_number=int(Mode.SAFE),
        trigger="FAULT",
        reason="expected following error below 1 rad",
    )
    watched.invariants.record(change)
    assert watched.go_on(2.0) == violated
    watched.invariants.violations.clear()
    watched.invariants.record(change)

    assert watched.go_on(0.1) == ["an axis that is not stuck is not called so"]


# ------------------------------------------------------------ the collector


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


@pytest.mark.parametrize("stop", [Stop(loop="left"), MoveCollector(action="stop")])
def test_a_platform_that_moves_on_after_a_stop_is_noticed(stop):
    watched = Rig(TESTBED, mode=Mode.SAFE)
    watched.invariants.hexapod = SimpleNamespace(moves=True, line=watched.lines["hexapod"])
    assert watched.go_on(5.0) == []
    watched.invariants.answered(stop, Reply(accepted=True))

    assert watched.go_on(2.9) == []
    assert watched.go_on(0.4) == ["a stop stops the collector"]


@pytest.mark.parametrize(
    "after", [MoveCollector(action="start"), MoveCollector(action="reference")]
)
def test_a_platform_that_is_started_again_may_move(after):
    watched = Rig(TESTBED, mode=Mode.SAFE)
    watched.invariants.hexapod = SimpleNamespace(moves=True, line=watched.lines["hexapod"])
    watched.invariants.answered(Stop(), Reply(accepted=True))
    watched.invariants.answered(after, Reply(accepted=True))

    assert watched.go_on(5.0) == []


# ------------------------------------------------------------ whole runs with a defect


def run(*happenings, rig="fit-mock.toml", duration_s=12.0):
    plan = Plan(seed=1, rig=rig, settings=[], duration_s=duration_s, happenings=list(happenings))
    return {one.invariant for one in run_plan(plan).violations}


@pytest.mark.long
def test_a_piezo_amplifier_that_is_silent_and_ignored_is_found(monkeypatch):
    happenings = (
        Order(at_s=0.1, who="ada", command=Standby()),
        Strike(at_s=2.0, device="right piezo", fault="mute", lasts_s=9.5),
    )
    assert run(*happenings) == set()
    monkeypatch.setattr(PiezoWatch, "evaluate", lambda *_: None)

    assert set(SAFE) <= run(*happenings)


@pytest.mark.long
def test_a_collector_that_goes_on_after_a_stop_is_found(monkeypatch):
    happenings = (
        Order(at_s=0.1, who="ada", command=MoveCollector(action="reference")),
        Order(at_s=7.0, who="ada", command=MoveCollector(action="start")),
        Order(at_s=8.5, who="ada", command=Release()),
        Order(at_s=9.0, who="ada", command=Stop()),
    )
    assert run(*happenings, rig=TESTBED, duration_s=14.0) == set()
    monkeypatch.setattr(CollectorDrive, "stop", lambda _: None)

    assert "a stop stops the collector" in run(*happenings, rig=TESTBED, duration_s=14.0)


@pytest.mark.long
def test_a_collector_that_goes_on_when_a_loop_loses_its_camera_is_found():
    happenings = (
        Order(at_s=0.1, who="ada", command=Standby()),
        Order(at_s=4.0, who="ada", command=MoveCollector(action="reference")),
        Order(at_s=12.0, who="ada", command=MoveCollector(action="start")),
        Strike(at_s=13.5, device="camera", fault="mute", lasts_s=8.0),
    )
    assert run(*happenings, rig=TESTBED, duration_s=20.0) == set()
    with put_back("collector-in-safe"):
        assert "a stop stops the collector" in run(*happenings, rig=TESTBED, duration_s=20.0)


@pytest.mark.long
def test_an_experiment_that_does_not_end_is_found(monkeypatch):
    happenings = (
        Order(at_s=0.1, who="ada", command=None),
        Order(at_s=1.0, who="ada", command=None),
        Order(at_s=9.0, who="ada", command=Experiment(name="rest", drives=standstill(2.0))),
    )
    assert run(*happenings, duration_s=14.0) == set()
    monkeypatch.setattr(StellarLoop, "_run_experiment", lambda *_: None)

    assert run(*happenings, duration_s=14.0) == {"an experiment ends"}


@pytest.mark.long
def test_a_learnt_design_that_comes_by_itself_at_rest_is_found(monkeypatch):
    happenings = (
        Order(at_s=0.1, who="ada", command=Standby()),
        Order(at_s=2.0, who="ada", command=report(design_json=LEARNT_DESIGNS[0])),
    )
    assert run(*happenings, duration_s=25.0) == set()
    monkeypatch.setattr(Learning, "wants_change", lambda *_: True)

    assert run(*happenings, duration_s=25.0) == {
        "a learnt design comes by itself only while the star is held"
    }


@pytest.mark.long
def test_a_stop_stops_a_collector_whose_start_waits_for_the_same_step():
    happenings = (
        Order(at_s=0.1, who="ada", command=MoveCollector(action="reference")),
        Order(at_s=7.0, who="ada", command=Stop()),
        Order(at_s=12.0, who="ada", command=MoveCollector(action="start")),
        Order(at_s=12.002, who="ada", command=Stop()),
    )
    assert run(*happenings, rig=TESTBED, duration_s=18.0) == set()


# ------------------------------------------------------------ what is stuck, and what rests


STUCK = ["a loop whose motors are stuck is SAFE in time"]


def test_a_loop_whose_motors_are_stuck_far_from_where_they_are_sent_must_be_safe_in_time():
    watched = Rig()
    watched.lines["right siderostat"].wrong["stuck"] = 0.0
    watched.servo._wanted_rad = (0.0, -6.0)  # a tenth of a second at full speed

    assert watched.go_on(3.0) == []
    assert watched.go_on(0.3) == STUCK


@pytest.mark.parametrize(
    ("wrong", "mode", "wanted_rad"),
    [
        ({"stuck": 0.0}, Mode.VERNIER, 0.9),  # nearer than what the servo must notice
        ({"stuck": 0.0}, Mode.SAFE, 6.0),
        ({}, Mode.VERNIER, 6.0),
    ],
)
def test_motors_that_do_not_move_and_need_not_are_no_violation(wrong, mode, wanted_rad):
    watched = Rig(mode=mode)
    watched.lines["right siderostat"].wrong |= wrong
    watched.servo._wanted_rad = (0.0, wanted_rad)

    assert watched.go_on(8.0) == []


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


def fault(reason):
    """The right loop goes to SAFE."""
    return ModeChange(
        time_s=0.0,
        loop="right",
        source="VERNIER",
        target="SAFE",
        target_number=0,
        trigger="FAULT",
        reason=reason,
    )


NO_CAUSE = ["without a fault nothing fails"]


@pytest.mark.parametrize(
    ("rig", "struck", "reason", "violated"),
    [
        ("two-stars.toml", "right D/A", "D/A at 127.0.0.1:1: no answer", []),
        ("two-stars.toml", "right piezo", "D/A at 127.0.0.1:1: no answer", NO_CAUSE),
        ("two-stars.toml", "left D/A", "D/A at 127.0.0.1:1: no answer", NO_CAUSE),
        ("two-stars.toml", "left D/A", "interlock flux_low: too dim", []),
        (TESTBED, "metrology siderostat", "siderostat right at can0: no answer", NO_CAUSE),
    ],
)
def test_what_fails_has_its_cause_in_its_own_devices(rig, struck, reason, violated):
    watched = Rig(rig)
    watched.go_on(60.0)
    watched.invariants.violations.clear()
    watched.invariants.struck(struck)
    watched.go_on(1.0)
    watched.invariants.record(fault(reason))

    found = [one.invariant for one in watched.invariants.violations]
    assert [one for one in found if one.startswith("without")] == violated


def test_the_left_star_of_the_testbed_may_fail_with_its_link():
    watched = Rig(TESTBED)
    watched.go_on(60.0)
    watched.invariants.struck("metrology siderostat")

    reason = "siderostat metrology at can0: no answer"
    assert watched.invariants._has_cause("left", reason)
    assert not watched.invariants._has_cause("right", reason)


@pytest.mark.parametrize("ticks", [0, 2])
def test_a_step_that_does_not_record_one_tick_is_noticed(ticks):
    watched = Rig("two-stars.toml")
    watched.go_on(0.1)
    watched.invariants._ticks.update({"right": 1, "left": ticks})
    watched.invariants.tick()

    (violation,) = watched.invariants.violations
    assert violation.detail == f"left: {ticks} in VERNIER"


@pytest.mark.parametrize(
    ("command", "violated"),
    [
        (Stop(), ["a command that is accepted is carried out"]),
        (Release(loop="right"), ["a command that is accepted is carried out"]),
        (Release(), []),  # another loop may have been released
        (Off(loop="right"), ["a command that is accepted is carried out"]),
        (Standby(loop="right"), []),  # it begins to open devices
    ],
)
def test_a_loop_is_where_a_command_has_sent_it(command, violated):
    watched = Rig(mode=Mode.VERNIER)
    watched.invariants.answered(command, Reply(accepted=True))

    assert [one.invariant for one in watched.invariants.violations] == violated


def test_only_what_was_admitted_may_be_passed_on_and_once():
    watched = Rig()
    command = Standby()
    watched.invariants.posted(command, "ada")
    watched.invariants.obeyed(command, "ada")
    assert watched.go_on(0.1) == []

    watched.invariants.obeyed(command, "ada")
    assert watched.go_on(0.1) == ["lease and rights are kept"]


@pytest.mark.parametrize(
    ("run", "state", "violated"),
    [
        ("first", "running", ["a sequence that is ordered to end does so"]),
        ("first", "stopped", []),
        ("second", "running", []),
    ],
)
def test_a_sequence_that_is_ordered_to_end_must(run, state, violated):
    watched = Rig()
    sequences = watched.supervisor.sequences
    sequences.status = lambda: SimpleNamespace(run="first", state="running")
    watched.invariants.answered(SequenceControl(action="end"), Reply(accepted=True))
    assert watched.go_on(14.0) == []

    sequences.status = lambda: SimpleNamespace(run=run, state=state)
    assert watched.go_on(3.0) == violated


def test_a_mirror_may_go_back_to_its_bias_after_its_dac_has_moved_it():
    watched = Rig(mode=Mode.SAFE)
    watched.go_on(5.0)
    watched.invariants.motion.mirror_moved("right")

    assert swings(watched, 1.0) == []


def test_amplifiers_that_keep_power_after_an_orderly_end_are_noticed():
    watched = Rig()
    watched.go_on(3.0)
    watched.invariants.closed(reached=set())  # Ensemble whose link is broken
    assert watched.go_on(0.1) == []

    watched.invariants.closed(reached={"right"})
    assert watched.go_on(0.1) == ["an orderly end disables the amplifiers"]


def test_a_mistake_in_fitctl_that_looks_like_a_fault_is_a_violation():
    watched = Rig()
    watched.invariants.record(fault(error_text(KeyError("reading"))))

    assert watched.go_on(0.1) == [NO_EXCEPTION]


@pytest.mark.long
def test_a_mistake_on_the_servos_thread_is_found_though_it_ends_in_safe(monkeypatch):
    happenings = (
        Order(at_s=0.1, who="ada", command=None),
        Order(at_s=1.0, who="ada", command=None),
        Strike(at_s=6.0, device="right siderostat", fault="slow", lasts_s=0.1, size=2.0),
    )
    assert run(*happenings, duration_s=8.0) == set()

    def mistaken(self, _reading, now_s):
        if now_s > 7.0:
            raise KeyError(now_s)

    monkeypatch.setattr(SiderostatServo, "_servo_by", mistaken)

    assert NO_EXCEPTION in run(*happenings, duration_s=8.0)
