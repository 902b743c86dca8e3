"""What the swarm requires of devices that are silent, of commands, and of what is recorded."""

from random import Random
from types import SimpleNamespace

import pytest
from samples.learner_reports import report

from benchmarks.swarm.commands import LEARNT_DESIGNS
from benchmarks.swarm.happenings import Order, Plan, Strike
from benchmarks.swarm.invariants import NO_EXCEPTION
from benchmarks.swarm.lines import FAULTS, WRONG
from benchmarks.swarm.past import put_back
from benchmarks.swarm.run import run_plan
from benchmarks.swarm.service import SENDERS
from fitctl.logging.records import ModeChange, RecorderStatus
from fitctl.loop.learning import Learning
from fitctl.loop.stellar import StellarLoop
from fitctl.messages.commands import (
    Experiment,
    MoveCollector,
    Off,
    RecorderReport,
    Release,
    Reply,
    SequenceControl,
    Standby,
    Status,
    Stop,
    TakeOver,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import standstill
from fitctl.service.admission import Admission
from fitctl.stages.collector import CollectorDrive
from fitctl.stages.journal import error_text
from fitctl.stages.servo import SiderostatServo
from fitctl.supervisor.piezo import PiezoWatch
from tests.benchmarks.watched import TESTBED, Rig
from tests.samples.log_samples import tick

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


# ------------------------------------------------------------ lease and rights


STATUS = RecorderStatus(time_s=0.0, path="", records=0, lost=0, bytes_written=0)


COMMANDS = (Release(), Stop(), Status(), TakeOver())


def test_the_rules_of_the_service_are_those_of_the_invariant(time, invariants):
    admission, random = Admission(30.0), Random(3)
    for _ in range(500):
        time.run_until(time.now_s() + random.expovariate(0.1))
        sender = SENDERS[random.choice(list(SENDERS))]
        command = random.choice(COMMANDS)
        refusal = admission.refusal(sender, command, time.now_s())
        invariants.admitted(sender, command, refusal)

    assert invariants.violations == []


@pytest.mark.parametrize(
    ("who", "command", "refusal"),
    [
        ("dora", Stop(), ""),  # who may only watch
        ("ben", Release(), ""),  # without the lease
        ("ada", Release(), "no"),  # with it
        ("ben", RecorderReport(status=STATUS), ""),  # which is for this machine's
    ],
)
def test_more_or_less_than_ones_rights_is_a_violation(invariants, who, command, refusal):
    invariants.admitted(SENDERS["ada"], Standby(), "")
    assert invariants.violations == []

    invariants.admitted(SENDERS[who], command, refusal)

    assert [one.invariant for one in invariants.violations] == ["lease and rights are kept"]


@pytest.mark.parametrize(
    ("wrong", "violated"), [("drops", []), ("saturated", ["a tick acts on the newest frame"])]
)
def test_a_tick_may_act_on_an_old_frame_where_newer_ones_are_lost(invariants, wrong, violated):
    line = invariants._lines["camera"]
    line.wrong[wrong] = 0.0
    invariants.record(tick(1, loop="right", mode="STANDBY", frame_age_s=2.0, mid_exposure_s=8.0))

    assert [one.invariant for one in invariants.violations] == violated


def test_a_frame_of_a_slow_camera_is_old_also_if_its_tick_ends_after_a_stall(time, invariants):
    line = invariants._lines["camera"]
    time.run_until(12.0)
    line.healed_s = 9.0
    old = tick(1, loop="right", mode="STANDBY", frame_age_s=0.2, mid_exposure_s=8.0)
    invariants.record(old)

    assert invariants.violations == []
