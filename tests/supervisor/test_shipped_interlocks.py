"""Each interlock of the shipped rig file: struck, it trips and acts; healed, it resets as the file says."""

import dataclasses
import timeit
from functools import partial

import numpy as np
import pytest

from fitctl.config import QUANTITIES, default_rig_path, load_rig
from fitctl.drivers.interface import DeviceFault, DeviceTimeout
from fitctl.logging.records import Event
from fitctl.model.drives import Drive
from fitctl.supervisor.machine import Machine, wall_minus_monotonic_s
from fitctl.supervisor.messages import (
    Experiment,
    Hold,
    Off,
    Recover,
    Reset,
    SetTarget,
    Standby,
    Stop,
)
from fitctl.supervisor.modes import Mode
from fitctl.supervisor.simulate import Simulation

ROWS = load_rig(default_rig_path()).interlocks
TRIPS_WITHIN_S = 20.0
RESETS_WITHIN_S = 12.0


class Bench:
    """An instrument that holds its star, and ways to strike it; :meth:`heal` takes them all back."""

    def __init__(self, *overrides):
        self.records = []
        rig = load_rig(default_rig_path(), overrides)
        self.simulation = Simulation(rig, 0, star_offset_px=(10.0, -6.0), record=self.take)
        self.supervisor, self.clock = self.simulation.supervisor, self.simulation.clock
        self.loop = self.supervisor.loops["right"]
        self.devices = self.simulation.devices.loops["right"]
        self.camera = self.simulation.devices.camera
        self.each_step = lambda: None
        self._healing = []
        self.simulation.acquire()
        assert self.until(lambda: self.loop.mode is Mode.VERNIER, 20.0)

    def take(self, record):
        if isinstance(record, Event):
            self.records.append(record)

    def until(self, reached, limit_s):
        end_s = self.clock.now_s() + limit_s
        while not reached() and self.clock.now_s() < end_s:
            self.each_step()
            self.supervisor.step()
        return reached()

    def run(self, duration_s):
        self.until(lambda: False, duration_s)

    def replace(self, owner, name, new):
        """Put `new`, which is given what was there, in its place."""
        old = getattr(owner, name)
        setattr(owner, name, partial(new, old))
        self._healing.append(partial(setattr, owner, name, old))

    def laws(self, law):
        """Move by `law` in every mode."""
        self.replace(self.loop, "_laws", lambda _: None)
        self.loop._laws = dict.fromkeys(Mode, law)

    def heal(self):
        self.each_step = lambda: None
        while self._healing:
            self._healing.pop()()

    @property
    def tripped(self):
        return {trip.name: trip for trip in self.loop.interlocks.tripped}

    def told(self, text):
        return [event for event in self.records if text in event.message]


# ---------------------------------------------------------------- ways to strike


def light(factor, bench):
    scene = bench.camera._scene
    before, scene._flux_dn = scene._flux_dn, scene._flux_dn * factor
    bench._healing.append(lambda: setattr(scene, "_flux_dn", before))


def mirror_at_its_edge(bench):
    edge_rad = np.array([0.95 * bench.loop.settings.fsm.range_rad, 0.0])
    move = bench.loop.stages.mirror_to
    bench.laws(lambda _seen: move(edge_rad, hysteresis_inverse=False))
    bench.replace(bench.loop.following, "judge", lambda *_: None)  # else it goes back to COARSE


def set_point_beyond_the_travel(bench):
    stages = bench.loop.stages
    bench.laws(lambda _seen: stages.siderostat_to(np.array([1.2 * stages.travel_rad, 0.0])))


def motors_beyond_the_travel(bench):
    stages, servo = bench.loop.stages, bench.loop.servo
    bench.laws(lambda _seen: servo.move_to(np.array([1.03 * stages.travel_rad, 0.0])))


def motors_run_away(rate_rad_s, bench):
    since_s = bench.clock.now_s()

    def exchange(ask, velocity_rad_s):
        reading = ask(velocity_rad_s)
        az_rad, el_rad = reading.position_rad
        away_rad = rate_rad_s * (reading.time_s - since_s)
        return reading._replace(position_rad=(az_rad + away_rad, el_rad))

    bench.replace(bench.devices.amplifiers, "exchange", exchange)


def motors_move_in_safe(bench):
    bench.simulation.command(Stop())
    motors_run_away(3.0, bench)


def motors_lag(bench):
    stuck_rad = bench.loop.servo.position_rad
    bench.replace(bench.devices.amplifiers, "exchange", lambda ask, _: ask((0.0, 0.0)))
    bench.laws(lambda _seen: bench.loop.stages.siderostat_to(stuck_rad + np.array([0.9, 0.0])))


def fail(owner, method, error, bench):
    def failing(*_):
        raise error

    bench.replace(getattr(bench.devices, owner), method, failing)


def slow_amplifiers(bench):
    """Each exchange takes two periods by the servo's clock, and no time for anybody else."""
    real, servo = bench.clock, bench.loop.servo

    class Slow:
        asked_s = 0.0

        def now_s(self):
            asked_s, self.asked_s = self.asked_s, 0.0
            return real.now_s() + asked_s

    def exchange(ask, velocity_rad_s):
        reading = ask(velocity_rad_s)
        servo._clock.asked_s = 2 * servo.period_s
        return reading._replace(time_s=reading.time_s + 2 * servo.period_s)

    bench.replace(servo, "_clock", lambda old: old)
    servo._clock = Slow()
    bench.replace(bench.devices.amplifiers, "exchange", exchange)


def servo_that_skips(bench):
    servo = bench.loop.servo

    def step():
        servo.late_s.extend([0.0] * 5)
        servo.skipped += 5

    bench.each_step = step
    bench._healing.append(lambda: setattr(bench, "each_step", lambda: servo.late_s.append(0.0)))


def write_slowly(bench):
    def write(old, volts):
        bench.clock.sleep_until(bench.clock.now_s() + 0.03)
        old(volts)

    bench.replace(bench.devices.dac, "write_v", write)


def stall(bench):
    def next_frame(old, timeout_s):
        bench.clock.sleep_until(bench.clock.now_s() + 0.6)
        return old(timeout_s)

    bench.replace(bench.camera, "next_frame", next_frame)


def no_frames(bench):
    go_on_to = bench.camera._go_on_to
    bench.replace(
        bench.camera, "next_frame", lambda _, timeout_s: go_on_to(bench.clock.now_s() + timeout_s)
    )


def late_frames(bench):
    def next_frame(old, timeout_s):
        frame = old(timeout_s)
        return frame and dataclasses.replace(frame, received_s=frame.received_s + 0.05)

    bench.replace(bench.camera, "next_frame", next_frame)


def every_second_frame(bench):
    def next_frame(old, timeout_s):
        old(timeout_s)
        return old(timeout_s)

    bench.replace(bench.camera, "next_frame", next_frame)


def computer(name, ill, well, bench):
    def say(value):
        bench.each_step = lambda: bench.supervisor.measured(name, value)

    say(ill)
    bench._healing.append(lambda: say(well))


LAX_SERVO = ["loops.right.siderostat.servo.following_error_limit_rad=100.0"]  # else it is first
STRIKES = {
    "star_lost": partial(light, 0.0),
    "flux_low": partial(light, 0.68),
    "fsm_edge": mirror_at_its_edge,
    "siderostat_limit": set_point_beyond_the_travel,
    "siderostat_beyond": motors_beyond_the_travel,
    "siderostat_rate": partial(motors_run_away, 150.0),
    "siderostat_moves": motors_move_in_safe,
    "following_error": motors_lag,
    "amplifier_fault": partial(
        fail, "amplifiers", "exchange", DeviceFault("siderostat", "can0", "no fault", "hot", "wait")
    ),
    "amplifier_slow": slow_amplifiers,
    "servo_overrun": servo_that_skips,
    "piezo_limit": lambda bench: bench.replace(bench.devices.piezo, "limit_v", lambda _: 100.0),
    "piezo_fault": partial(
        fail, "piezo", "limit_v", DeviceTimeout("piezo amplifier", "ttyUSB0", "150 V", "none")
    ),
    "dac_watchdog": stall,
    "dac_slow": write_slowly,
    "frame_missing": no_frames,
    "frame_age": late_frames,
    "frame_interval": every_second_frame,
    "loop_overrun": write_slowly,
    "disk_space": partial(computer, "disk_free_bytes", 1e6, 1e12),
    "recorder_behind": partial(computer, "recorder_backlog_fraction", 0.9, 0.0),
    "clock_step": partial(computer, "clock_step_s", 0.2, 0.0),
}


def struck(name):
    """A bench on which this row has tripped."""
    bench = Bench(*(LAX_SERVO if name == "siderostat_rate" else []))
    bench.run(1.0)
    assert not bench.tripped
    STRIKES[name](bench)
    assert bench.until(lambda: name in bench.tripped, TRIPS_WITHIN_S), bench.tripped
    return bench


def test_every_shipped_row_is_struck_here():
    assert set(STRIKES) == set(ROWS)


@pytest.mark.parametrize("name", STRIKES)
def test_a_shipped_row_trips_and_acts(name):
    bench = struck(name)
    trip, stages = bench.tripped[name], bench.loop.stages

    assert trip.action == ROWS[name].action
    assert trip.reset == ROWS[name].reset
    told = [event.severity for event in bench.told(trip.reason)]
    assert told.count("error" if trip.action == "safe" else "warning") == 1
    if trip.action == "safe":
        assert bench.loop.mode is Mode.SAFE
        assert bench.loop.last_change.reason == trip.reason
    elif trip.action == "hold":
        before = (*stages.stack_v, *stages.setpoint_rad)
        bench.run(0.5)
        assert (*stages.stack_v, *stages.setpoint_rad) == before


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.reset == "itself"])
def test_a_shipped_row_resets_itself_once_its_cause_is_gone(name):
    bench = struck(name)
    bench.run(0.5)
    assert name in bench.tripped
    bench.heal()

    assert bench.until(lambda: name not in bench.tripped, RESETS_WITHIN_S)
    assert bench.told(f"interlock {name} is over")


@pytest.mark.parametrize("name", [name for name, row in ROWS.items() if row.reset == "hand"])
def test_a_shipped_row_that_needs_a_hand_waits_for_it(name):
    bench = struck(name)
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


# ---------------------------------------------------------------- actions on a loop


def with_action(action, reset="hand", modes="['VERNIER']"):
    """The frame-age row with another action."""
    fields = {"action": action, "reset": reset, "modes": modes}
    return Bench(*(f"interlocks.frame_age.{key}={value}" for key, value in fields.items()))


def test_flattened_the_mirror_is_at_its_bias_and_the_siderostat_held_until_it_is_over():
    bench = with_action("flatten", "itself")
    bench.simulation.command(SetTarget(az_px=26.0, el_px=19.5))
    bench.run(3.0)
    away_v = np.abs(bench.loop.stages.stack_v - 5.0).max()
    late_frames(bench)
    assert bench.until(lambda: bench.tripped, 2.0)
    held_rad = bench.loop.stages.setpoint_rad.copy()
    bench.run(0.3)
    assert bench.loop.stages.at_bias()
    assert np.array_equal(bench.loop.stages.setpoint_rad, held_rad)

    bench.heal()
    assert bench.until(lambda: not bench.tripped, 2.0)
    assert np.abs(bench.loop.stages.stack_v - 5.0).max() < 0.5 * away_v  # it does not jump back
    bench.run(20.0)

    assert bench.loop.mode is Mode.VERNIER
    errors = [tick.error_az_px for tick in bench.simulation.ticks[-250:]]
    assert abs(np.mean(errors)) < 0.05


@pytest.mark.parametrize("action", ["hold", "flatten"])
def test_an_experiment_ends_when_its_stages_are_held(action):
    bench = with_action(action, modes="['EXPERIMENT']")
    drive = Drive(channel="fsm_az", shape="sine", amplitude=0.1, frequency_hz=1.0, duration_s=60.0)
    assert bench.simulation.command(Experiment(name="sine", drives=[drive])).accepted
    late_frames(bench)

    assert bench.until(lambda: bench.loop.mode is Mode.COARSE, 2.0)
    assert bench.loop.last_change.reason == bench.tripped["frame_age"].reason


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
    for command in (Hold(), Off()):
        assert bench.simulation.command(command).accepted
    bench.run(0.1)
    plant = bench.simulation.plants["right"].state
    plant.motor_rad[:] += 30.0
    plant.beam_motor_rad[:] += 30.0
    assert bench.simulation.command(Standby()).accepted
    rates = []
    bench.each_step = lambda: rates.append(
        bench.loop.measured.readings["siderostat_rate_fraction"][0]
    )
    bench.run(1.0)

    assert max(rates) < 0.1


def test_a_reset_is_refused_by_name():
    bench = Bench()
    reply = bench.simulation.command(Reset(name="moon"))

    assert not reply.accepted
    assert "there are star_lost" in reply.text


def test_hold_by_command_is_no_interlock():
    bench = Bench()
    bench.simulation.command(Hold())
    bench.run(3.0)

    assert not bench.tripped


# ---------------------------------------------------------------- who measures


def test_everything_that_a_row_may_be_about_is_measured(tmp_path):
    bench = Bench()
    servo_that_skips(bench)
    Machine(tmp_path, lambda: 0.0, bench.supervisor.measured).look()
    bench.run(2.0)

    assert set(bench.loop.measured.readings) == set(QUANTITIES)


def test_the_computer_is_measured_and_an_interrupted_look_at_the_clocks_does_not_count(tmp_path):
    measured = {}
    machine = Machine(tmp_path, lambda: 0.25, measured.__setitem__)
    machine.look()

    assert measured["disk_free_bytes"] > 0
    assert measured["recorder_backlog_fraction"] == 0.25
    assert abs(measured.get("clock_step_s", 0.0)) < 0.05
    assert wall_minus_monotonic_s(lambda: 100.0, iter([1.0, 1.1]).__next__) is None
    assert wall_minus_monotonic_s(lambda: 100.0, iter([1.0, 1.0]).__next__) == 99.0


def test_a_step_of_wall_time_is_seen(tmp_path, monkeypatch):
    measured = {}
    differences = iter([10.0, None, 12.5])
    monkeypatch.setattr(
        "fitctl.supervisor.machine.wall_minus_monotonic_s", lambda: next(differences)
    )
    machine = Machine(tmp_path, lambda: 0.0, measured.__setitem__)
    machine.look()
    assert "clock_step_s" not in measured
    machine.look()

    assert measured["clock_step_s"] == 2.5


def test_measuring_and_judging_costs_a_small_part_of_a_tick():
    bench = Bench()
    loop, frame = bench.loop, bench.camera.next_frame(0.04)
    seen = loop._sense(frame, loop.servo.look(), frame.received_s)

    def least_s(work):
        return min(timeit.repeat(work, number=100, repeat=20))

    assert least_s(lambda: loop._judge_interlocks(frame, seen)) < 0.3 * least_s(
        lambda: loop.tick(frame, 0)
    )
