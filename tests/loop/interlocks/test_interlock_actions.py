"""What an interlock does to a loop, and who measures what it judges."""

import threading
import timeit

import numpy as np
import pytest
from instruments.served import until
from instruments.simulated import AS_SHIPPED
from interlock_bench import Bench, late_frames, servo_that_skips, struck

from fitctl.config import QUANTITIES
from fitctl.daemon.machine import Machine, wall_minus_monotonic_s
from fitctl.messages.commands import (
    Acquire,
    Experiment,
    Off,
    Recover,
    Release,
    Reset,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.messages.modes import Mode
from fitctl.model.drives import Drive

MACHINE = "fitctl.daemon.machine"


def with_action(action, reset="hand", modes="['VERNIER']"):
    """The frame-age row with another action; the mirror takes over as shipped, near its bias."""
    fields = {"action": action, "reset": reset, "modes": modes}
    row = (f"interlocks.frame_age.{key}={value}" for key, value in fields.items())
    return Bench(AS_SHIPPED, *row)


@pytest.mark.long
def test_flattened_the_mirror_is_at_its_bias_and_the_siderostat_held_until_it_is_over():
    bench = with_action("flatten", "itself")
    bench.simulation.command(SetTarget(az_px=26.0, el_px=19.5))
    bench.run(3.0)
    away_v = np.abs(bench.loop.mirror.stack_v - 5.0).max()
    late_frames(bench)
    assert bench.until(lambda: bench.tripped, 2.0)
    held_rad = bench.loop.siderostat.setpoint_rad.copy()
    bench.run(0.3)
    assert bench.loop.tick_record().held
    assert bench.loop.mirror.at_bias()
    assert np.array_equal(bench.loop.siderostat.setpoint_rad, held_rad)

    bench.heal()
    assert bench.until(lambda: not bench.tripped, 2.0)
    assert np.abs(bench.loop.mirror.stack_v - 5.0).max() < 0.5 * away_v  # it does not jump back
    bench.run(20.0)

    assert bench.loop.mode is Mode.VERNIER
    assert not bench.loop.tick_record().held
    errors = [tick.error_az_px for tick in bench.simulation.ticks[-250:]]
    assert abs(np.mean(errors)) < 0.05


@pytest.mark.parametrize("action", ["freeze", "flatten"])
def test_a_siderostat_on_its_way_to_a_search_stops_and_goes_on_after_the_reset(action):
    row = {"quantity": "'siderostat_travel_fraction'", "high": 0.2, "for_s": 0.0,
           "modes": "['ACQUISITION']", "action": f"'{action}'", "reset": "'hand'"}  # fmt: skip
    bench = Bench("interlocks.far={" + ", ".join(f"{k}={v}" for k, v in row.items()) + "}")
    servo, siderostat = bench.loop.servo, bench.loop.siderostat
    asked = Acquire(
        expected_az_sky_arcsec=900.0, expected_el_sky_arcsec=0.0, search_radius_sky_arcsec=20.0
    )
    assert bench.simulation.command(Release()).accepted
    assert bench.simulation.command(asked).accepted
    assert bench.until(lambda: bench.tripped, 2.0)
    stopped_rad = servo.position_rad
    bench.run(bench.loop.search._slew_limit_s + 3.0)
    assert bench.loop.tick_record().held
    assert np.abs(servo.position_rad - stopped_rad).max() < 0.02 * siderostat.travel_rad
    assert bench.loop.mode is Mode.ACQUISITION

    bench.loop.interlocks._rules["far"].high = 1.0
    assert bench.simulation.command(Reset(name="far")).accepted

    assert bench.until(lambda: bench.loop.mode is Mode.STANDBY, 10.0)
    assert "no star within 20 arcsec" in bench.loop.last_change.reason
    assert np.abs(servo.position_rad).max() > 0.7 * siderostat.travel_rad


@pytest.mark.parametrize("action", ["freeze", "flatten"])
def test_an_experiment_ends_when_its_stages_are_held(action):
    bench = with_action(action, modes="['EXPERIMENT']")
    drive = Drive(channel="fsm_az", shape="sine", amplitude=0.1, frequency_hz=1.0, duration_s=60.0)
    assert bench.simulation.command(Experiment(name="sine", drives=[drive])).accepted
    late_frames(bench)

    assert bench.until(lambda: bench.loop.mode is Mode.COARSE, 2.0)
    assert bench.loop.last_change.reason == bench.tripped["frame_age"].reason


def test_the_siderostat_of_an_experiment_that_an_interlock_ends_stays_and_goes_back_after_it():
    bench = with_action("freeze", modes="['EXPERIMENT', 'COARSE', 'VERNIER']")
    loop, held_rad = bench.loop, bench.loop.siderostat.setpoint_rad.copy()
    square = {"shape": "square", "amplitude": 5.0, "frequency_hz": 0.05, "duration_s": 60.0}
    drive = Drive(channel="siderostat_az", **square)
    assert bench.simulation.command(Experiment(name="step", drives=[drive])).accepted
    bench.run(1.0)
    late_frames(bench)
    assert bench.until(lambda: loop.mode is Mode.COARSE, 2.0)
    stopped_rad = loop.servo.position_rad
    assert np.abs(stopped_rad - held_rad).max() > 0.5
    bench.run(0.5)
    assert loop.servo.position_rad == pytest.approx(stopped_rad, abs=0.02)

    bench.heal()
    bench.run(0.5)
    assert bench.simulation.command(Reset(name="frame_age")).accepted
    bench.run(0.5)
    assert np.abs(loop.servo.position_rad - held_rad).max() < 0.5


@pytest.mark.parametrize("action", ["freeze", "flatten"])
def test_no_experiment_begins_while_the_stages_are_held(action):
    bench = with_action(action)
    late_frames(bench)
    assert bench.until(lambda: bench.tripped, 2.0)
    drive = Drive(channel="fsm_az", shape="sine", amplitude=0.1, frequency_hz=1.0, duration_s=60.0)

    reply = bench.simulation.command(Experiment(name="sine", drives=[drive]))

    assert not reply.accepted
    assert "an interlock keeps the stages where they are: frame_age" in reply.text


def test_a_stop_of_a_loop_that_is_safe_leaves_the_fault_as_its_reason():
    bench = struck("frame_missing")
    assert bench.until(lambda: bench.loop.mode is Mode.SAFE, 2.0)
    change = bench.loop.last_change
    assert change.trigger == "FAULT"

    assert bench.simulation.command(Stop()).accepted
    bench.run(0.1)

    assert bench.loop.mode is Mode.SAFE
    assert bench.loop.last_change is change


def test_what_is_tripped_and_safe_stays_in_force_until_it_is_reset():
    bench = struck("frame_missing")
    bench.heal()
    bench.run(0.5)
    bench.loop.mode = Mode.STANDBY  # as if somebody had found a way round

    bench.run(0.1)

    assert bench.loop.mode is Mode.SAFE


def test_recover_opens_a_silent_camera_anew_and_needs_no_reset():
    bench = struck("frame_missing")
    opened = []

    def come_back(open_it):
        bench.heal()
        opened.append("camera")
        return open_it()

    bench.replace(bench.camera, "open", come_back)
    assert bench.simulation.command(Recover()).accepted
    bench.run(1.0)

    assert opened == ["camera"]
    assert bench.loop.mode is Mode.STANDBY
    assert not bench.tripped


def test_encoders_that_count_anew_after_opening_are_no_runaway():
    bench = Bench()
    for command in (Release(), Off()):
        assert bench.simulation.command(command).accepted
    bench.run(0.1)
    plant = bench.simulation.plants["right"].state
    plant.motor_rad[:] += 30.0
    plant.beam_motor_rad[:] += 30.0
    assert bench.simulation.command(Standby()).accepted
    rates = []
    bench.each_step = lambda: rates.append(
        bench.loop.quantities.readings["siderostat_rate_fraction"][0]
    )
    bench.run(1.0)

    assert max(rates) < 0.1


def test_a_reset_is_refused_by_name():
    bench = Bench()
    reply = bench.simulation.command(Reset(name="moon"))

    assert not reply.accepted
    assert "this loop has star_lost" in reply.text


def test_hold_by_command_is_no_interlock():
    bench = Bench()
    bench.simulation.command(Release())
    bench.run(3.0)

    assert not bench.tripped


# ---------------------------------------------------------------- who measures


def test_everything_that_a_row_may_be_about_is_measured(tmp_path):
    bench = Bench()
    servo_that_skips(bench)
    Machine(
        tmp_path, lambda: 0.0, bench.supervisor.report_quantity, bench.supervisor.report_event
    ).look()
    until(lambda: any(row.name == "disk_free_bytes" for row in bench.supervisor._quantities))
    bench.run(2.0)

    of_metrology = {"beam", "photodiodes"}
    assert set(bench.loop.quantities.readings) == {
        name for name, quantity in QUANTITIES.items() if quantity.part not in of_metrology
    }


def test_the_computer_is_measured_and_an_interrupted_look_at_the_clocks_does_not_count(tmp_path):
    measured = {}
    machine = Machine(tmp_path, lambda: 0.25, measured.__setitem__, print)
    machine.look()
    until(lambda: "disk_free_bytes" in measured)

    assert measured["disk_free_bytes"] > 0
    assert measured["recorder_backlog_fraction"] == 0.25
    assert abs(measured.get("clock_step_s", 0.0)) < 0.05
    assert wall_minus_monotonic_s(lambda: 100.0, iter([1.0, 1.1]).__next__) is None
    assert wall_minus_monotonic_s(lambda: 100.0, iter([1.0, 1.0]).__next__) == 99.0


def test_a_step_of_wall_time_is_seen(tmp_path, monkeypatch):
    measured = {}
    differences = iter([10.0, None, 12.5])
    monkeypatch.setattr("fitctl.daemon.machine.wall_minus_monotonic_s", lambda: next(differences))
    machine = Machine(tmp_path, lambda: 0.0, measured.__setitem__, print)
    machine.look()
    assert "clock_step_s" not in measured
    machine.look()

    assert measured["clock_step_s"] == 2.5


def test_a_disk_that_does_not_answer_holds_nobody_and_is_told_of_once(tmp_path, monkeypatch):
    asked, answers = [], threading.Event()

    def silent(folder):
        asked.append(folder)
        assert answers.wait(60.0)
        return 7e9

    monkeypatch.setattr(f"{MACHINE}.free_bytes", silent)
    monkeypatch.setattr(f"{MACHINE}._LATE_S", 0.0)
    measured, told = {}, []
    machine = Machine(
        tmp_path, lambda: len(told), measured.__setitem__, lambda *row: told.append(row)
    )
    for _ in range(5):
        machine.look()  # and comes back

    assert len(told) == 1
    assert told[0][:2] == ("warning", "computer")
    assert "has not reported its free space" in told[0][2]
    assert measured["recorder_backlog_fraction"] == 1  # of after it: what needs no disk goes on

    answers.set()
    until(lambda: len(told) == 2)
    assert "reports its free space again" in told[1][2]
    assert measured["disk_free_bytes"] == 7e9
    assert asked.count(tmp_path) == 1


def test_a_disk_that_is_gone_is_told_of_once_and_asked_again(tmp_path, monkeypatch):
    answers = iter([OSError(5, "Input/output error")] * 2)
    monkeypatch.setattr(f"{MACHINE}.free_bytes", lambda _: raised(next(answers, None)))
    told = []
    machine = Machine(tmp_path, lambda: 0.0, lambda *_: None, lambda *row: told.append(row))

    def looked_again():
        machine.look()
        return len(told) == 2

    until(looked_again)
    assert [row[0] for row in told] == ["warning", "info"]
    assert "does not report its free space: Input/output error" in told[0][2]


def raised(error):
    """The error, or room on the disk where there is none."""
    if error is not None:
        raise error
    return 7e9


@pytest.mark.long
def test_measuring_and_judging_costs_a_small_part_of_a_tick():
    bench = Bench()
    loop, frame = bench.loop, bench.camera.next_frame(0.04)

    def tick():
        loop.sense(frame, 0, 0)
        loop.decide()
        loop.send()
        loop.confirm()
        loop.tick_record()

    def evaluate():
        loop.quantities.record_observation(loop.observation)
        loop.quantities.record_stages(loop.observation, loop.siderostat, loop.mirror)
        loop._evaluate_interlocks(loop.observation.now_s)

    def least_s(work):
        return min(timeit.repeat(work, number=100, repeat=20))

    tick()
    assert least_s(evaluate) < 0.3 * least_s(tick)
