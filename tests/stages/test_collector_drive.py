"""Courses of the collector, and how they are streamed to a hexapod."""

import math

import numpy as np
import pytest

from fitctl.clock import VirtualClock
from fitctl.config import CollectorMotion, ConfigError, default_rig_path, load_rig
from fitctl.drivers.interface import HexapodReading, Pose
from fitctl.stages.collector import PERIOD_S, CollectorDrive, course_of

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
    """Is wherever it was sent."""

    def __init__(self, clock):
        self.clock = clock
        self.sent = []
        self.stopped = False

    def pose(self):
        where = self.sent[-1] if self.sent else Pose(y_mm=3.0, u_deg=0.5)
        return HexapodReading(self.clock.now_s(), where, moving=False, referenced=True, error="")

    def move_to(self, pose, velocity_mm_s):
        assert velocity_mm_s == RIG.collector.hexapod.velocity_limit_mm_s
        self.sent.append(pose)

    def stop(self):
        self.stopped = True


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


def test_a_stopped_course_sends_nothing_more():
    _, hexapod, drive = driven(kind="sine")
    drive.start()
    drive.period()
    drive.stop()
    drive.period()
    assert hexapod.stopped
    assert len(hexapod.sent) == 1
