"""Courses of the collector, and how they are streamed to a hexapod."""

import math
import threading
import time

import numpy as np
import pytest
from instruments.c887_settings import MOCK, device

from fitctl.clock import MonotonicClock, VirtualClock
from fitctl.config import CollectorMotion, ConfigError, default_rig_path, load_rig
from fitctl.drivers.c887.driver import C887Hexapod
from fitctl.drivers.interface import (
    DeviceFault,
    DeviceRefused,
    DeviceTimeout,
    HexapodReading,
    Pose,
)
from fitctl.mocks.c887.server import C887ControllerMock
from fitctl.model.collector_motion import course_of
from fitctl.stages.collector import PERIOD_S, CollectorDrive
from fitctl.stages.periodic import PeriodicThread

RIG = load_rig(default_rig_path().parent / "fit-testbed.toml")


def motion(**changes) -> CollectorMotion:
    return RIG.collector.motion.model_copy(update={"direction_deg": 0.0} | changes)


def ways(course, until_s, every_s=0.1):
    return np.array([course(time_s) for time_s in np.arange(0.0, until_s, every_s)])


def test_a_still_collector_stays_where_it_is():
    assert not np.any(ways(course_of(motion(kind="still"), 1), 10.0))


def test_a_drift_turns_back_at_its_range():
    way = ways(course_of(motion(kind="drift", velocity_mm_s=0.1, range_mm=2.0), 1), 200.0)[:, 0]
    assert way[0] == 0.0
    assert (way.min(), way.max()) == pytest.approx((-2.0, 2.0), abs=0.011)
    assert np.abs(np.diff(way)).max() == pytest.approx(0.01)


def test_a_sine_begins_at_rest_place_and_has_its_amplitude():
    way = ways(course_of(motion(kind="sine", amplitude_mm=1.0, frequency_hz=0.05), 1), 20.0)[:, 0]
    assert way[0] == 0.0
    assert (way.min(), way.max()) == pytest.approx((-1.0, 1.0), abs=1e-3)


def test_a_direction_is_from_azimuth_towards_elevation():
    az_mm, el_mm = course_of(motion(kind="drift", direction_deg=30.0), 1)(10.0)
    assert math.degrees(math.atan2(el_mm, az_mm)) == pytest.approx(30.0)


@pytest.mark.long
def test_a_random_velocity_has_its_rms_and_correlation():
    settings = motion(kind="random", rms_mm_s=0.2, correlation_s=5.0, range_mm=1e6)
    way = ways(course_of(settings, 3), 4000.0, PERIOD_S)[:, 0]
    velocity = np.diff(way) / PERIOD_S
    # 4000 s are some 400 independent stretches: 5 % of the RMS, one standard deviation.
    assert np.sqrt(np.mean(velocity**2)) == pytest.approx(0.2, rel=0.2)
    after = round(5.0 / PERIOD_S)
    kept = np.mean(velocity[after:] * velocity[:-after]) / np.mean(velocity**2)
    assert kept == pytest.approx(math.exp(-1), abs=0.2)


def test_a_random_course_is_its_seeds():
    one, again, other = (course_of(motion(kind="random"), seed) for seed in (4, 4, 5))
    assert one(30.0) == again(30.0) != other(30.0)
    assert again(10.0) == one(10.0), "whatever was asked for before"


def test_a_file_is_interpolated(tmp_path):
    path = tmp_path / "course.csv"
    path.write_text("time_s,az_mm,el_mm\n0,0,0\n10,1,-2\n", encoding="utf-8")
    course = course_of(motion(kind="file", file=str(path)), 1)
    assert course(5.0) == pytest.approx((0.5, -1.0))
    assert course(99.0) == pytest.approx((1.0, -2.0)), "it stays at the end"


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("time_s,az_mm\n0,1\n", "cannot be read"),
        ("time_s,az_mm,el_mm\n0,1,x\n", "cannot be read"),
        ("time_s,az_mm,el_mm\n0,1,2\n", "two rows or more"),
        ("time_s,az_mm,el_mm\n0,1,2\n0,2,3\n", "times that ascend"),
        ("time_s,az_mm,el_mm\n0,1,2\n1,nan,3\n", "must have"),
    ],
)
def test_a_file_that_is_no_course_is_refused_by_its_name(tmp_path, text, why):
    path = tmp_path / "course.csv"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=f"collector.motion.file: .*course.csv .*{why}"):
        course_of(motion(kind="file", file=str(path)), 1)
    with pytest.raises(ConfigError, match="cannot be read"):
        course_of(motion(kind="file", file=str(tmp_path / "none.csv")), 1)


class Hexapod:
    """Is wherever it was sent, unless it is `stuck`; `reading` is what a test changes in its readings."""

    def __init__(self, clock):
        self.clock = clock
        self.sent = []
        self.stops = 0
        self.stuck = False
        self.reading = {}
        self.before_move = lambda: None

    @property
    def stopped(self):
        return self.stops > 0

    def pose(self):
        where = self.sent[-1] if self.sent and not self.stuck else Pose(y_mm=3.0, u_deg=0.5)
        well = HexapodReading(
            self.clock.now_s(), where, moving=False, referenced=True, servos_on=True, error=""
        )
        return well._replace(**self.reading)

    def move_to(self, pose, velocity_mm_s):
        assert velocity_mm_s == RIG.collector.hexapod.velocity_limit_mm_s
        self.before_move()
        self.sent.append(pose)

    def stop(self):
        self.stops += 1


def driven(**changes):
    clock = VirtualClock()
    hexapod = Hexapod(clock)
    collector = RIG.collector.model_copy(update={"motion": motion(**changes)})
    return clock, hexapod, CollectorDrive(collector, hexapod, clock, seed=1)


def test_a_course_begins_where_the_hexapod_is_and_turns_nothing():
    clock, hexapod, drive = driven(kind="drift", velocity_mm_s=0.1, direction_deg=90.0)
    drive.period()
    assert not hexapod.sent, "nothing moves before it is started"
    clock.sleep_until(5.0)
    drive.start()
    for _ in range(3):
        drive.period()
        clock.sleep_until(clock.now_s() + PERIOD_S)
    # Elevation is the hexapod's Z.
    expected = [Pose(y_mm=3.0, z_mm=0.1 * PERIOD_S * n, u_deg=0.5) for n in (1, 2, 3)]
    assert np.array(hexapod.sent) == pytest.approx(np.array(expected))


def test_its_displacement_is_that_of_the_course_that_runs():
    clock, _, drive = driven(kind="drift", velocity_mm_s=0.1)
    assert drive.displacement_mm() == (0.0, 0.0)
    drive.start()
    clock.sleep_until(clock.now_s() + 5.0)
    assert drive.displacement_mm() == pytest.approx((0.5, 0.0))
    drive.stop()
    assert drive.displacement_mm() == (0.0, 0.0)


def test_a_stopped_course_sends_nothing_more():
    _, hexapod, drive = driven(kind="sine")
    drive.start()
    drive.period()
    drive.stop()
    drive.period()
    assert hexapod.stopped
    assert len(hexapod.sent) == 1


def test_a_file_begins_where_the_collector_stands(tmp_path):
    path = tmp_path / "course.csv"
    path.write_text("time_s,az_mm,el_mm\n5,3,1\n15,4,1\n", encoding="utf-8")
    course = course_of(motion(kind="file", file=str(path)), 1)
    assert course(0.0) == (0.0, 0.0)
    assert course(5.0) == pytest.approx((0.5, 0.0))


@pytest.mark.parametrize("kind", ["still", "drift", "sine", "random", "file"])
def test_a_course_stays_within_the_reach_and_velocity_that_it_states(tmp_path, kind):
    path = tmp_path / "course.csv"
    path.write_text("time_s,az_mm,el_mm\n0,0,0\n3,1,-2\n5,-1,1\n", encoding="utf-8")
    course = course_of(motion(kind=kind, file=str(path), direction_deg=30.0, range_mm=2.0), 1)
    places = ways(course, 120.0, PERIOD_S)
    reach = np.array(course.reach_mm)
    assert np.all(places >= reach.min(axis=0) - 1e-9)
    assert np.all(places <= reach.max(axis=0) + 1e-9)
    steps = np.hypot(*np.diff(places, axis=0).T) / PERIOD_S
    assert steps.max() <= course.velocity_mm_s * (1 + 1e-6) + 1e-9


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        ({"kind": "drift", "velocity_mm_s": 8.1}, "at most 8 mm/s, got 8.1 mm/s"),
        ({"kind": "sine", "amplitude_mm": 5.0, "frequency_hz": 0.5}, "at most 8 mm/s"),
        ({"kind": "random", "rms_mm_s": 2.5}, "at most 8 mm/s"),
        ({"kind": "drift", "range_mm": 48.0}, "y_mm within -50 and 50, got 51"),
        ({"kind": "sine", "amplitude_mm": 25.1, "direction_deg": 90.0}, "z_mm within -25 and 25"),
    ],
)
def test_a_course_beyond_travel_or_velocity_is_refused_before_anything_moves(changes, why):
    _, hexapod, drive = driven(**changes)
    with pytest.raises(DeviceRefused, match=why):
        drive.start()
    drive.period()
    assert not drive.running
    assert not hexapod.sent


@pytest.mark.parametrize(
    ("reading", "why"),
    [
        ({"referenced": False}, "a referenced hexapod.*reference it first"),
        ({"servos_on": False}, "all servos on.*reference it first"),
        ({"moving": True}, "stop it first"),
    ],
)
def test_a_hexapod_that_is_not_ready_is_not_moved(reading, why):
    _, hexapod, drive = driven(kind="sine")
    hexapod.reading = reading
    with pytest.raises(DeviceRefused, match=why):
        drive.start()
    drive.period()
    assert not hexapod.sent


def run(clock, drive, periods):
    drive.start()
    run_on(clock, drive, periods)


def run_on(clock, drive, periods):
    for _ in range(periods):
        drive.period()
        clock.sleep_until(clock.now_s() + PERIOD_S)


def test_a_hexapod_that_follows_is_left_alone():
    clock, hexapod, drive = driven(kind="sine", amplitude_mm=1.0, frequency_hz=0.5)
    run(clock, drive, 200)
    assert drive.running
    assert drive.fault is None
    assert drive.displacement_mm() == pytest.approx((0.0, 0.0), abs=1e-9)
    assert not hexapod.stopped


@pytest.mark.parametrize(
    ("reading", "why"),
    [
        ({"error": "error 1024, an axis did not follow"}, "error 1024"),
        ({"referenced": False}, "no longer referenced"),
        ({"pose": Pose(y_mm=9.0, u_deg=0.5)}, "mm of its course"),
    ],
)
def test_a_hexapod_that_does_not_follow_ends_the_course_and_is_stopped(reading, why):
    clock, hexapod, drive = driven(kind="sine", amplitude_mm=1.0, frequency_hz=0.05)
    drive.start()
    hexapod.reading = reading
    run_on(clock, drive, 25)
    assert isinstance(drive.fault, DeviceFault)
    assert why in str(drive.fault)
    assert not drive.running
    assert hexapod.stopped
    assert len(hexapod.sent) == 20, "found within a second, and nothing was sent after it"


def test_a_stuck_hexapod_is_noticed():
    clock, hexapod, drive = driven(kind="drift", velocity_mm_s=1.0)
    hexapod.stuck = True
    run(clock, drive, 60)
    assert isinstance(drive.fault, DeviceFault)


def test_a_hexapod_that_waited_for_this_computer_follows():
    clock, hexapod, drive = driven(kind="drift", velocity_mm_s=1.0)
    run(clock, drive, 19)
    hexapod.stuck = True
    clock.sleep_until(clock.now_s() + 0.5)
    drive.period()
    assert drive.running

    run_on(clock, drive, 20)
    assert isinstance(drive.fault, DeviceFault), "at the next check, should it still be behind"


def test_a_target_that_cannot_be_sent_ends_the_course():
    _, hexapod, drive = driven(kind="sine")

    def fail():
        raise DeviceTimeout("hexapod", "here", "an answer", "none", "look")

    drive.start()
    hexapod.before_move = fail
    drive.period()
    assert isinstance(drive.fault, DeviceTimeout)
    assert hexapod.stopped
    hexapod.before_move = lambda: None
    drive.start()
    assert drive.running
    assert drive.fault is None, "and it can be started again"


def test_a_stop_while_a_target_is_on_its_way_stops_it_after_the_target():
    _, hexapod, drive = driven(kind="sine")
    on_its_way, let_go = threading.Event(), threading.Event()

    def slowly():
        on_its_way.set()
        assert let_go.wait(5)

    hexapod.before_move = slowly
    drive.start()
    sender = threading.Thread(target=drive.period)
    sender.start()
    assert on_its_way.wait(5)
    stopper = threading.Thread(target=drive.stop)
    stopper.start()
    while not hexapod.stops:
        time.sleep(0.001)
    assert not hexapod.sent, "the first stop went out while the target was still on its way"
    let_go.set()
    sender.join(5)
    stopper.join(5)
    assert (len(hexapod.sent), hexapod.stops) == (1, 2)
    assert drive.fault is None
    drive.period()
    assert len(hexapod.sent) == 1


def test_it_streams_to_the_mock_from_a_thread_of_its_own_and_stops(in_loop):
    async def made():
        mock = C887ControllerMock(MOCK)
        return mock, await mock.start()

    mock, ends = in_loop(made())
    hexapod = C887Hexapod(device(f"socket://127.0.0.1:{ends.tcp_port}"))
    hexapod.open()
    settings = motion(kind="drift", velocity_mm_s=2.0)
    collector = RIG.collector.model_copy(update={"motion": settings})
    clock = MonotonicClock()
    drive = CollectorDrive(collector, hexapod, clock, seed=1)
    thread = PeriodicThread(drive, clock)
    thread.start()
    try:
        drive.start()
        time.sleep(1.5)
        going_mm = hexapod.pose().pose.y_mm
        drive.stop()
        stopped = hexapod.pose()
        time.sleep(0.3)
        assert drive.fault is None
        assert going_mm > 1.0
        assert not stopped.moving
        assert hexapod.pose().pose == stopped.pose, "it stays where it was stopped"
    finally:
        thread.stop()
        hexapod.close()
        in_loop(mock.stop())
