"""The siderostat's servo: what it commands, and when it calls a fault."""

import sys
from functools import partial

import numpy as np
import pytest

from fitctl.clock import MonotonicClock, VirtualClock
from fitctl.config import default_rig_path, load_rig
from fitctl.drivers.interface import DeviceFault, DeviceIdentity, DeviceTimeout, ServoReading
from fitctl.stages.periodic import PeriodicThread
from fitctl.stages.servo import SiderostatServo


class Amplifiers:
    """Ideal motors, 2 ms a period, read at its end; attributes make them misbehave."""

    def __init__(self, clock):
        self.clock = clock
        self.position_rad = (0.0, 0.0)
        self.commands = []
        self.enabled = self.silent = self.stuck = False
        self.fault = ""
        self.surprise = None
        self.readings_until_heard = 0
        self.period_s, self.late_s = 0.002, 0.0

    def open(self):
        return DeviceIdentity("test", "motors", "", "")

    def enable(self):
        self.enabled = True

    def disable(self):
        self.enabled = False

    def reset_fault(self):
        self.fault = ""

    def exchange(self, velocity_rad_s):
        self.commands.append(velocity_rad_s)
        self.clock.sleep_until(self.clock.now_s() + self.period_s)
        if not self.stuck:
            self.position_rad = tuple(
                rad + rad_s * self.period_s
                for rad, rad_s in zip(self.position_rad, velocity_rad_s, strict=True)
            )
        if self.surprise is not None:
            raise self.surprise
        self.readings_until_heard -= 1
        if self.silent or self.readings_until_heard > 0:
            return None
        read_s = self.clock.now_s() - self.late_s
        return ServoReading(read_s, self.position_rad, self.enabled, self.fault)

    def close(self):
        self.enabled = False


@pytest.fixture
def amplifiers():
    return Amplifiers(VirtualClock())


@pytest.fixture
def servo(amplifiers):
    rig = load_rig(default_rig_path())
    servo = SiderostatServo("right", rig.loops["right"], amplifiers, amplifiers.clock, 0.02)
    servo.open()
    return servo


def run(servo, periods):
    for _ in range(periods):
        servo.period()


def test_enabling_moves_nothing(servo, amplifiers):
    amplifiers.position_rad = (3.0, -2.0)
    run(servo, 50)
    servo.hold(servo.position_rad)
    run(servo, 50)

    assert np.all(np.array(amplifiers.commands) == 0)


def test_a_set_point_is_reached_and_held(servo, amplifiers):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([0.5, -0.25]))
    run(servo, 100)

    assert amplifiers.position_rad == pytest.approx([0.5, -0.25], abs=2e-3)


def test_velocity_and_acceleration_stay_within_the_rigs_limits(servo, amplifiers):
    servo.hold(servo.position_rad)
    for step in range(100):
        servo.move_to(np.array([step * 1.0, 0.0]))
        run(servo, 10)

    commands = np.array(amplifiers.commands)
    assert np.abs(commands).max() <= 60.0
    assert np.abs(np.diff(commands, axis=0)).max() <= 6000.0 * 0.002 + 1e-9


def test_stop_means_velocity_zero_in_the_very_next_period(servo, amplifiers):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([1.0, 1.0]))
    run(servo, 5)
    assert amplifiers.commands[-1] != (0.0, 0.0)

    servo.stop()
    servo.period()

    assert amplifiers.commands[-1] == (0.0, 0.0)


def test_a_set_point_after_a_stop_does_nothing_until_hold(servo, amplifiers):
    servo.hold(servo.position_rad)
    servo.stop()
    servo.move_to(np.array([1.0, 1.0]))
    run(servo, 20)

    assert np.all(np.array(amplifiers.commands[1:]) == 0)


def test_a_missing_reading_is_bridged_and_many_are_a_fault(servo, amplifiers):
    servo.hold(servo.position_rad)
    amplifiers.silent = True
    run(servo, 10)
    assert servo.fault is None

    run(servo, 200)

    assert isinstance(servo.fault, DeviceTimeout)
    assert servo.drain_timing().missed_readings > 100


def test_motors_that_cannot_be_seen_are_told_to_stand_still(servo, amplifiers):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([0.9, 0.0]))
    run(servo, 5)
    amplifiers.silent = True
    run(servo, 5)  # 1 / gain_per_s is 7.4 ms
    assert amplifiers.commands[-1] == (0.0, 0.0)

    amplifiers.silent = False
    run(servo, 100)

    assert servo.fault is None
    assert amplifiers.position_rad[0] == pytest.approx(0.9, abs=2e-3)


@pytest.mark.parametrize("stood_still_s", [0.2, 0.4])
def test_motors_that_turned_on_while_this_computer_stood_still_are_no_following_error(
    servo, amplifiers, stood_still_s
):
    """A drive goes on at its last velocity until it misses the heartbeat."""
    servo.hold(servo.position_rad)
    servo.move_to(np.array([6.0, 0.0]))
    run(servo, 20)
    velocity_rad_s = amplifiers.commands[-1][0]
    assert velocity_rad_s > 50.0
    amplifiers.clock.sleep_until(amplifiers.clock.now_s() + stood_still_s)
    amplifiers.position_rad = (amplifiers.position_rad[0] + velocity_rad_s * stood_still_s, 0.0)
    run(servo, 1)
    assert amplifiers.commands[-1] == (0.0, 0.0)

    run(servo, 200)

    assert servo.fault is None
    assert servo.read_state().following_rad < 0.8
    assert amplifiers.position_rad[0] == pytest.approx(6.0, abs=2e-3)


def test_a_drive_may_answer_late_after_this_computer_stood_still(servo, amplifiers):
    """A drive that stood still with it, as a mock on the same computer, has to catch up."""
    servo.hold(servo.position_rad)
    run(servo, 20)
    amplifiers.clock.sleep_until(amplifiers.clock.now_s() + 0.3)
    amplifiers.silent = True
    run(servo, 20)  # 40 ms
    amplifiers.silent = False
    run(servo, 20)

    assert servo.fault is None


def test_late_readings_of_motors_that_turned_on_are_no_following_error(servo, amplifiers):
    """A busy computer: commands and readings come late, one after the other, for 100 ms."""
    servo.hold(servo.position_rad)
    servo.move_to(np.array([6.0, 0.0]))
    run(servo, 20)
    assert amplifiers.commands[-1][0] > 50.0
    amplifiers.clock.sleep_until(amplifiers.clock.now_s() + 0.03)
    amplifiers.position_rad = (amplifiers.position_rad[0] + 1.7, 0.0)
    amplifiers.late_s = 0.02
    run(servo, 50)
    assert servo.fault is None
    assert set(amplifiers.commands[-49:]) == {(0.0, 0.0)}

    amplifiers.late_s = 0.0
    run(servo, 200)

    assert servo.fault is None
    assert amplifiers.position_rad[0] == pytest.approx(6.0, abs=2e-3)


@pytest.mark.parametrize(("late_s", "period_s"), [(0.1, 0.002), (0.2, 0.5)])
def test_readings_too_old_to_servo_by_are_no_readings(servo, amplifiers, late_s, period_s):
    """Late on a wire that is asked again meanwhile, or on one whose every answer is waited for."""
    servo.hold(servo.position_rad)
    amplifiers.late_s, amplifiers.period_s = late_s, period_s
    servo.period()
    servo.move_to(np.array([3.0, 0.0]))
    commanded = len(amplifiers.commands)
    run(servo, int(0.3 / period_s) + 1)

    assert isinstance(servo.fault, DeviceTimeout)
    assert "within 0.25 s, at most 7 ms old" in str(servo.fault)
    assert set(amplifiers.commands[commanded:]) == {(0.0, 0.0)}


def test_an_amplifier_fault_is_named(servo, amplifiers):
    amplifiers.fault = "azimuth: over-current (2310h)"
    servo.period()

    assert isinstance(servo.fault, DeviceFault)
    assert "over-current" in str(servo.fault)


def test_an_axis_that_disables_itself_is_a_fault(servo, amplifiers):
    amplifiers.enabled = False
    servo.period()

    assert "disabled itself" in str(servo.fault)


def test_a_stuck_axis_shows_as_following_error(servo, amplifiers):
    servo.hold(servo.position_rad)
    amplifiers.stuck = True
    servo.move_to(np.array([3.0, 0.0]))
    run(servo, 60)

    assert "following error" in str(servo.fault)


@pytest.mark.parametrize("trouble", ["fault", "stuck", "surprise"])
def test_after_any_fault_the_motors_keep_being_told_to_stand_still(servo, amplifiers, trouble):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([3.0, 0.0]))
    run(servo, 10)
    assert amplifiers.commands[-1] != (0.0, 0.0)
    if trouble == "fault":
        amplifiers.fault = "over-current"
    elif trouble == "stuck":
        amplifiers.stuck = True
    else:
        amplifiers.surprise = ValueError("nobody thought of this")
    run(servo, 80)
    assert servo.fault is not None
    amplifiers.surprise = None

    servo.move_to(np.array([9.0, 9.0]))
    run(servo, 10)

    assert len(amplifiers.commands) > 50
    assert np.all(np.array(amplifiers.commands[-10:]) == 0)


def test_opening_again_clears_the_fault(servo, amplifiers):
    amplifiers.fault = "over-current"
    servo.period()
    servo.open()
    servo.period()

    assert servo.fault is None
    assert servo.enabled


def test_nothing_is_powered_before_its_position_has_been_read(amplifiers):
    rig = load_rig(default_rig_path())
    amplifiers.position_rad = (0.8, -0.4)
    amplifiers.readings_until_heard = 30
    servo = SiderostatServo("right", rig.loops["right"], amplifiers, amplifiers.clock, 0.02)
    servo.open()
    servo.hold(servo.position_rad)
    run(servo, 100)

    assert np.all(np.array(amplifiers.commands) == 0)


def test_a_drive_that_never_says_where_it_is_is_not_powered(amplifiers):
    rig = load_rig(default_rig_path())
    amplifiers.silent = True
    servo = SiderostatServo("right", rig.loops["right"], amplifiers, amplifiers.clock, 0.02)

    with pytest.raises(DeviceTimeout):
        servo.open()

    assert not amplifiers.enabled


def test_encoders_that_jumped_while_nobody_looked_are_noticed(servo, amplifiers):
    run(servo, 5)
    servo.close()
    amplifiers.position_rad = (40.0, 0.0)
    servo.open()

    assert servo.encoders_jumped


def test_encoders_that_jumped_are_noticed_though_opening_fails_after_that(servo, amplifiers):
    run(servo, 5)
    servo.close()
    amplifiers.position_rad = (40.0, 0.0)
    enable, amplifiers.enable = amplifiers.enable, lambda: 1 / 0
    with pytest.raises(ZeroDivisionError):
        servo.open()
    amplifiers.enable = enable
    servo.open()

    assert servo.encoders_jumped


@pytest.mark.parametrize(
    ("found_rad", "jumped"),
    [
        (100.0, False),  # 60 rad/s for up to 2 s
        (-100.0, True),  # the other way
        (200.0, True),  # faster than it was commanded
        (0.0, True),  # power came back
    ],
)
def test_motors_that_turned_on_unwatched_are_not_encoders_that_jumped(
    servo, amplifiers, found_rad, jumped
):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([5.0, 0.0]))
    run(servo, 30)
    amplifiers.surprise = DeviceTimeout("amplifiers", "here", "an answer", "none")
    run(servo, 1)
    assert servo.fault is not None
    amplifiers.surprise = None
    amplifiers.clock.sleep_until(amplifiers.clock.now_s() + 2.0)
    amplifiers.position_rad = (found_rad, 0.0)
    servo.open()

    assert servo.encoders_jumped == jumped
    assert (servo.turned_on_rad > 90.0) != jumped
    assert servo.position_rad == pytest.approx([found_rad, 0.0])


def test_motors_that_turned_on_at_a_command_whose_answer_never_came_are_no_encoders_that_jumped(
    servo, amplifiers
):
    servo.hold(servo.position_rad)
    run(servo, 5)
    servo.move_to(np.array([5.0, 0.0]))
    amplifiers.silent = True
    while servo.fault is None:
        run(servo, 1)
    turned_rad = max(rad_s for rad_s, _ in amplifiers.commands) * 2.0
    amplifiers.silent = False
    amplifiers.clock.sleep_until(amplifiers.clock.now_s() + 2.0)
    amplifiers.position_rad = (turned_rad, 0.0)
    servo.open()

    assert turned_rad > 10.0
    assert not servo.encoders_jumped
    assert servo.turned_on_rad == pytest.approx(turned_rad)


def test_encoders_that_jumped_are_noticed_though_they_could_not_be_read_at_once(servo, amplifiers):
    run(servo, 5)
    servo.close()
    amplifiers.position_rad = (40.0, 0.0)
    amplifiers.silent = True
    with pytest.raises(DeviceTimeout):
        servo.open()
    amplifiers.silent = False
    servo.open()

    assert servo.encoders_jumped


def test_a_reversal_at_full_speed_is_no_following_error(servo, amplifiers):
    servo.hold(servo.position_rad)
    for target in (1.0, 2.0, 0.0, 2.0, 0.0):
        servo.move_to(np.array([target, -target]))
        run(servo, 15)

    assert servo.fault is None


def test_a_disable_that_fails_shows_as_a_fault(servo, amplifiers, monkeypatch):
    def refuse():
        raise DeviceFault("siderostat", "x", "disabled", "still enabled")

    monkeypatch.setattr(amplifiers, "disable", refuse)
    servo.disable()
    servo.period()

    assert servo.fault is not None
    assert servo.enabled


def test_position_at_a_past_time_is_interpolated(servo, amplifiers):
    servo.hold(servo.position_rad)
    servo.move_to(np.array([0.5, 0.0]))
    run(servo, 12)
    before, after = servo._history[-3], servo._history[-2]
    middle_s = (before.time_s + after.time_s) / 2

    position = servo.position_at(middle_s)

    assert position[0] == pytest.approx((before.position_rad[0] + after.position_rad[0]) / 2)


def test_the_thread_keeps_its_rate_and_ends(amplifiers):
    from fitctl.clock import MonotonicClock

    rig = load_rig(default_rig_path())
    clock = MonotonicClock()
    amplifiers.clock = VirtualClock()
    servo = SiderostatServo("right", rig.loops["right"], amplifiers, clock, 0.02)
    thread = PeriodicThread(servo, clock)
    thread.start()
    servo.open()
    begun_s = clock.now_s()
    clock.sleep_until(begun_s + 0.5)
    periods = len(servo.drain_timing().late_s)
    gone_s = clock.now_s() - begun_s
    servo.close()
    thread.stop()

    # A missed deadline is skipped, so there may be fewer periods than time for them, never more.
    assert 0.3 * gone_s / 0.002 < periods <= gone_s / 0.002 + 20


def test_a_thread_that_dies_says_why_and_keeps_nobody_waiting(amplifiers, monkeypatch):
    clock = MonotonicClock()
    monkeypatch.setattr("threading.excepthook", lambda _: None)  # which prints
    servo = SiderostatServo(
        "right", load_rig(default_rig_path()).loops["right"], amplifiers, clock, 0.02
    )
    thread = PeriodicThread(servo, clock)
    monkeypatch.setattr(servo, "wait", lambda: 1 / 0)
    thread.start()
    thread._thread.join(5.0)

    assert isinstance(thread.error, ZeroDivisionError)
    servo.close()


class Interruption:
    """Calls `action` before one bytecode instruction of a function: where another thread may come in."""

    def __init__(self, code, instruction, action):
        self._code, self._left, self._action = code, instruction, action
        self.happened = False
        self._tracer = sys.gettrace()  # such as a measurement of coverage

    def __enter__(self):
        sys.settrace(self._enter_function)
        return self

    def __exit__(self, *_error):
        sys.settrace(self._tracer)

    def _enter_function(self, frame, _event, _argument):
        if frame.f_code is not self._code or self.happened:
            return None
        frame.f_trace_opcodes = True
        return self._instruction

    def _instruction(self, _frame, event, _argument):
        if event == "opcode":
            if self._left == 0:
                sys.settrace(None)
                self.happened = True
                self._action()
            self._left -= 1
        return self._instruction


def test_a_set_point_is_never_lost_whenever_within_a_period_it_comes(servo, amplifiers):
    servo.hold(servo.position_rad)
    instruction, happened = 0, True
    while happened:
        first, second = ([0.2, 0.0], [0.0, 0.2]) if instruction % 2 else ([0.0, 0.0], [0.2, 0.2])
        servo.move_to(np.array(first))
        give = partial(servo.move_to, np.array(second))
        with Interruption(servo._velocity_rad_s.__code__, instruction, give) as interruption:
            servo.period()
        happened = interruption.happened
        if happened:
            run(servo, 60)
            assert amplifiers.position_rad == pytest.approx(second, abs=2e-3), instruction
        instruction += 1

    assert instruction > 20
