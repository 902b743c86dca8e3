"""The collector's drive: it streams a course to the hexapod, which by itself only moves from pose to pose."""

from __future__ import annotations

import contextlib
import math
import threading
from collections import deque

import numpy as np

from fitctl.clock import Clock
from fitctl.config import Collector, CollectorMotion
from fitctl.drivers.endpoint import Endpoint
from fitctl.drivers.interface import (
    DeviceError,
    DeviceFault,
    DeviceRefused,
    Hexapod,
    Pose,
    beyond_travel,
)
from fitctl.model.collector_motion import Course, Displacement, course_of
from fitctl.model.metrology.geometry import transverse_axes

PERIOD_S = 0.05
"""Between two targets."""
_PERIODS_A_CHECK = 20
_FOLLOW_MM = 0.1  # from the course, beyond the way of a few periods
_FOLLOW_PERIODS = 4
_WAIT_S = 0.1


class CollectorDrive:
    """Streams a course to the hexapod, at a pace of its own.

    Once a second it checks that the hexapod follows. What goes wrong ends the course: the hexapod is stopped
    where it is, and `fault` has the error.

    Parameters
    ----------
    collector : Collector
    hexapod : Hexapod
        Opened and referenced by whoever starts the drive.
    clock : Clock
    seed : int
        Of a random course.

    Attributes
    ----------
    fault : Exception or None
        Why the last course ended by itself.
    """

    def __init__(self, collector: Collector, hexapod: Hexapod, clock: Clock, seed: int) -> None:
        self.period_s = PERIOD_S
        self.threaded = False
        self.fault: Exception | None = None
        self.late_s: deque[float] = deque(maxlen=1000)
        self.skipped = 0
        self._hexapod = hexapod
        self._clock = clock
        self._rig_motion = self._motion = collector.motion
        self._seed = seed
        self._course = course_of(collector.motion, seed)
        self._axes = transverse_axes(collector.geometry)
        self._ends = collector.hexapod.travel.ends
        self._velocity_mm_s = collector.hexapod.velocity_limit_mm_s
        self._endpoint = Endpoint("hexapod", collector.hexapod.endpoint)
        self._origin = Pose()
        self._started_s = 0.0
        self._sent_s = 0.0
        self._late = False  # a target, since the last check
        self._targets = 0
        self._running = threading.Event()
        self._turn = threading.Lock()  # held while a target is on its way

    @property
    def running(self) -> bool:
        """A course runs."""
        return self._running.is_set()

    def displacement_mm(self) -> Displacement:
        """Where the course has the collector now, azimuth and elevation from its start; (0, 0) without one."""
        return self._course(self._clock.now_s() - self._started_s) if self.running else (0.0, 0.0)

    @property
    def kind(self) -> str:
        """Of the motion that was begun last, at first of the rig file's."""
        return self._motion.kind

    def start(self, motion: CollectorMotion | None = None) -> None:
        """Begin a motion, by default the rig's, where the hexapod is, once its course is known to be allowed.

        Raises
        ------
        ConfigError
            The motion's file cannot be read. Nothing has moved.
        DeviceRefused
            The hexapod is not referenced, or a servo is off, or it moves, or the course goes farther or
            faster than `collector.hexapod` allows. Nothing has moved.
        DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        reading = self._hexapod.pose()
        if not reading.referenced:
            raise self._refused("a referenced hexapod", "one that is not", "reference it first")
        if not reading.servos_on:
            raise self._refused("all servos on", "one that is off", "reference it first")
        if reading.moving:
            raise self._refused("a hexapod at rest", "one that moves", "stop it first")
        motion = motion or self._rig_motion
        course = course_of(motion, self._seed)
        self._check(course, reading.pose)
        self.fault, self._motion, self._course = None, motion, course
        self._origin, self._started_s, self._targets = reading.pose, self._clock.now_s(), 0
        self._sent_s, self._late = self._started_s, False
        self._running.set()

    def stop(self) -> None:
        """Stop the hexapod where it is, at once; from any thread, also while a target is on its way.

        Raises
        ------
        DeviceFault, DeviceUnreachable, DeviceTimeout, DeviceProtocolError
        """
        before = self._targets
        self._running.clear()
        self._hexapod.stop()
        with self._turn:  # the target that was on its way may have reached it after the stop
            late = self._targets != before
        if late:
            self._hexapod.stop()

    def period(self) -> None:
        """Send the hexapod where the course is one period from now."""
        with self._turn:
            if not self.running:
                return
            now_s = self._clock.now_s()
            self._late = self._late or now_s - self._sent_s > _FOLLOW_PERIODS * PERIOD_S
            self._sent_s = now_s
            try:
                place = self._course(now_s - self._started_s + PERIOD_S)
                self._hexapod.move_to(self._pose(self._origin, place), self._velocity_mm_s)
                self._targets += 1
                if self._targets % _PERIODS_A_CHECK == 0:
                    self._check_follows()
            except Exception as error:  # else the thread would end, and the hexapod go on
                self._targets += 1
                self._fail(error)

    def wait(self) -> None:
        """Until a course runs, or for a while."""
        self._running.wait(_WAIT_S)

    def _fail(self, error: Exception) -> None:
        """End the course; a stop that was asked for meanwhile is no fault."""
        if self.running:
            self.fault = error
            self._running.clear()
        with contextlib.suppress(DeviceError):
            self._hexapod.stop()

    def _pose(self, origin: Pose, place: Displacement) -> Pose:
        x_mm, y_mm, z_mm = (np.array(place) @ self._axes).tolist()
        return origin._replace(
            x_mm=origin.x_mm + x_mm, y_mm=origin.y_mm + y_mm, z_mm=origin.z_mm + z_mm
        )

    def _check(self, course: Course, origin: Pose) -> None:
        if course.velocity_mm_s > self._velocity_mm_s:
            raise self._refused(
                f"a course of at most {self._velocity_mm_s:g} mm/s",
                f"{course.velocity_mm_s:.3g} mm/s",
                "slow collector.motion down",
            )
        for place in course.reach_mm:
            for name, value, low, high in beyond_travel(self._pose(origin, place), self._ends):
                raise self._refused(
                    f"a course with {name} within {low:g} and {high:g}",
                    f"{value:.4g}",
                    "shorten collector.motion, or move the hexapod towards zero first",
                )

    def _check_follows(self) -> None:
        reading = self._hexapod.pose()
        if reading.error or not reading.referenced:
            got = reading.error or "a hexapod that is no longer referenced"
            raise self._fault("a hexapod that follows its course", got)
        late, self._late = self._late, False
        if late:
            return  # this computer stood still, and the hexapod catches up
        place = self._course(reading.time_s - self._started_s)
        off_mm = math.dist(reading.pose[:3], self._pose(self._origin, place)[:3])
        limit_mm = _FOLLOW_MM + _FOLLOW_PERIODS * PERIOD_S * self._course.velocity_mm_s
        if off_mm > limit_mm:
            raise self._fault(
                f"a hexapod within {limit_mm:.2g} mm of its course", f"{off_mm:.3g} mm"
            )

    def _refused(self, expected: str, got: str, hint: str) -> DeviceRefused:
        return self._endpoint.error(DeviceRefused, expected, got, hint)

    def _fault(self, expected: str, got: str) -> DeviceFault:
        hint = "see what keeps the platform from moving, and start the course again"
        return self._endpoint.error(DeviceFault, expected, got, hint)
