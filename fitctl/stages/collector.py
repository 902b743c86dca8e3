"""Courses of the collector over time, with which fitctl imitates the relative motion of two spacecraft.

A course is a displacement across the link. The hexapod only moves from pose to pose, so a course is streamed:
it gets a new target twenty times a second.
"""

from __future__ import annotations

import csv
import math
from collections import deque
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import Clock
from fitctl.config import Collector, CollectorMotion, ConfigError
from fitctl.drivers.interface import Hexapod
from fitctl.model.metrology.collector import transverse_axes

Floats = NDArray[np.float64]
PERIOD_S = 0.05
"""Between two targets."""
Course = Callable[[float], tuple[float, float]]
"""Displacement across the link at a time from the start: azimuth and elevation, mm."""


def course_of(motion: CollectorMotion, seed: int) -> Course:
    """The course that a rig file asks for; a random one follows from its seed.

    Raises
    ------
    ConfigError
        If its file cannot be read.
    """
    angle = math.radians(motion.direction_deg)
    towards = math.cos(angle), math.sin(angle)

    def along(way_mm: Callable[[float], float]) -> Course:
        return lambda time_s: (towards[0] * way_mm(time_s), towards[1] * way_mm(time_s))

    match motion.kind:
        case "still":
            return lambda _: (0.0, 0.0)
        case "drift":
            return along(
                lambda time_s: _back_and_forth(motion.velocity_mm_s * time_s, motion.range_mm)
            )
        case "sine":
            rad_s = 2 * math.pi * motion.frequency_hz
            return along(lambda time_s: motion.amplitude_mm * math.sin(rad_s * time_s))
        case "random":
            return along(_RandomVelocity(motion, seed))
        case "file":
            return _from_file(Path(motion.file))


def _back_and_forth(way_mm: float, range_mm: float) -> float:
    """A way that turns back at the range, either side of zero."""
    phase = (way_mm + range_mm) % (4 * range_mm)
    return (phase if phase <= 2 * range_mm else 4 * range_mm - phase) - range_mm


class _RandomVelocity:
    """Way by a velocity with an exponential correlation, drawn at times `PERIOD_S` apart."""

    def __init__(self, motion: CollectorMotion, seed: int) -> None:
        self._motion = motion
        self._random = np.random.default_rng([seed, 887])
        self._way_mm = [0.0]
        self._velocity_mm_s = motion.rms_mm_s * self._random.standard_normal()

    def __call__(self, time_s: float) -> float:
        """The way at a time; those before it are remembered, so that any may be asked for."""
        place = max(time_s, 0.0) / PERIOD_S
        index = int(place)
        while len(self._way_mm) <= index + 1:
            self._draw()
        before, after = self._way_mm[index : index + 2]
        return _back_and_forth(before + (after - before) * (place - index), self._motion.range_mm)

    def _draw(self) -> None:
        kept = math.exp(-PERIOD_S / self._motion.correlation_s)
        new = self._motion.rms_mm_s * math.sqrt(1 - kept**2) * self._random.standard_normal()
        self._velocity_mm_s = kept * self._velocity_mm_s + new
        self._way_mm.append(self._way_mm[-1] + self._velocity_mm_s * PERIOD_S)


def _from_file(path: Path) -> Course:
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = [
                (float(row["time_s"]), float(row["az_mm"]), float(row["el_mm"]))
                for row in csv.DictReader(file)
            ]
    except (OSError, KeyError, TypeError, ValueError) as error:
        msg = (
            f"collector.motion.file: {path} cannot be read: {error}; expected CSV with the columns "
            "time_s, az_mm and el_mm"
        )
        raise ConfigError(msg) from None
    table = np.array(rows).reshape(-1, 3)
    if len(table) < 2 or np.any(np.diff(table[:, 0]) <= 0) or not np.all(np.isfinite(table)):
        msg = f"collector.motion.file: {path} must have two rows or more, with times that ascend"
        raise ConfigError(msg)

    def displacement(time_s: float) -> tuple[float, float]:
        az, el = (np.interp(time_s, table[:, 0], column) for column in table[:, 1:].T)
        return float(az), float(el)

    return displacement


class CollectorDrive:
    """Streams a course to the hexapod, at a pace of its own.

    Parameters
    ----------
    collector : Collector
    hexapod : Hexapod
    clock : Clock
    seed : int
        Of a random course.
    """

    def __init__(self, collector: Collector, hexapod: Hexapod, clock: Clock, seed: int) -> None:
        self.period_s = PERIOD_S
        self.threaded = False
        self.late_s: deque[float] = deque(maxlen=1000)
        self.skipped = 0
        self._hexapod = hexapod
        self._clock = clock
        self._course = course_of(collector.motion, seed)
        self._axes = transverse_axes(collector.geometry)
        self._velocity_mm_s = collector.hexapod.velocity_limit_mm_s
        self._started_s: float | None = None

    def start(self) -> None:
        """Begin the course where the hexapod is."""
        self._origin = self._hexapod.pose().pose
        self._started_s = self._clock.now_s()

    def stop(self) -> None:
        """Stop the hexapod where it is; from any thread."""
        self._started_s = None
        self._hexapod.stop()

    def period(self) -> None:
        """Send the hexapod where the course is one period from now."""
        started_s = self._started_s
        if started_s is None:
            return
        az_mm, el_mm = self._course(self._clock.now_s() - started_s + PERIOD_S)
        x_mm, y_mm, z_mm = (np.array([az_mm, el_mm]) @ self._axes).tolist()
        origin = self._origin
        pose = origin._replace(
            x_mm=origin.x_mm + x_mm, y_mm=origin.y_mm + y_mm, z_mm=origin.z_mm + z_mm
        )
        self._hexapod.move_to(pose, self._velocity_mm_s)

    def wait(self) -> None:
        """There is work each period."""
