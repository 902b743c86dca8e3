"""Courses of the collector over time, with which fitctl imitates the relative motion of two spacecraft.

A course is a displacement across the link from where the collector stands at its start, in azimuth and
elevation.
"""

from __future__ import annotations

import csv
import math
from array import array
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Collector, CollectorMotion, ConfigError
from fitctl.model.metrology.geometry import transverse_axes

Floats = NDArray[np.float64]
Displacement = tuple[float, float]

STEP_S = 0.05
"""A random velocity is drawn anew after this."""
_RANDOM_PEAK = 4.0  # times its RMS: a random velocity is held within


@dataclass(frozen=True)
class Course:
    """A displacement over time.

    Attributes
    ----------
    at : callable
        From a time in seconds to azimuth and elevation in mm; (0, 0) at the start.
    reach_mm : list of pair of float
        Places between which it stays.
    velocity_mm_s : float
        Its largest; a random velocity is held within four times its RMS.
    """

    at: Callable[[float], Displacement]
    reach_mm: list[Displacement]
    velocity_mm_s: float

    def __call__(self, time_s: float) -> Displacement:
        """Azimuth and elevation in mm at a time from the start."""
        return self.at(time_s)


def course_of(motion: CollectorMotion, seed: int) -> Course:
    """The course that a rig file asks for; a random one follows from its seed.

    Raises
    ------
    ConfigError
        If its file cannot be read.
    """
    angle = math.radians(motion.direction_deg)
    towards = math.cos(angle), math.sin(angle)

    def along(way_mm: Callable[[float], float], far_mm: float, velocity_mm_s: float) -> Course:
        ends: list[Displacement] = [(s * towards[0], s * towards[1]) for s in (-far_mm, far_mm)]
        return Course(
            lambda time_s: (towards[0] * (way := way_mm(time_s)), towards[1] * way),
            ends,
            velocity_mm_s,
        )

    far_mm = motion.range_mm
    match motion.kind:
        case "still":
            return along(lambda _: 0.0, 0.0, 0.0)
        case "drift":
            speed = motion.velocity_mm_s
            return along(lambda time_s: _back_and_forth(speed * time_s, far_mm), far_mm, speed)
        case "sine":
            rad_s, amplitude = 2 * math.pi * motion.frequency_hz, motion.amplitude_mm
            return along(
                lambda time_s: amplitude * math.sin(rad_s * time_s), amplitude, rad_s * amplitude
            )
        case "random":
            return along(_RandomVelocity(motion, seed), far_mm, _RANDOM_PEAK * motion.rms_mm_s)
        case "file":
            return _from_file(Path(motion.file))


def beyond(course: Course, collector: Collector) -> list[str]:
    """Why the collector cannot follow the course, wherever it stands at its start: one text each."""
    problems = []
    hexapod = collector.hexapod
    if course.velocity_mm_s > hexapod.velocity_limit_mm_s:
        problems.append(
            f"the motion reaches {course.velocity_mm_s:.3g} mm/s; collector.hexapod.velocity_limit_mm_s is "
            f"{hexapod.velocity_limit_mm_s:g}"
        )
    spans_mm = np.ptp(np.array(course.reach_mm) @ transverse_axes(collector.geometry), axis=0)
    travel = list(zip(type(hexapod.travel).model_fields, hexapod.travel.ends, strict=True))
    for span_mm, (axis, (low, high)) in zip(spans_mm.tolist(), travel[:3], strict=True):
        if span_mm > high - low:
            problems.append(
                f"the motion goes {span_mm:.4g} mm from end to end; collector.hexapod.travel.{axis} has "
                f"{high - low:g}"
            )
    return problems


def _back_and_forth(way_mm: float, range_mm: float) -> float:
    """A way that turns back at the range, either side of zero."""
    phase = (way_mm + range_mm) % (4 * range_mm)
    return (phase if phase <= 2 * range_mm else 4 * range_mm - phase) - range_mm


class _RandomVelocity:
    """Way by a velocity with an exponential correlation, drawn at times `STEP_S` apart."""

    def __init__(self, motion: CollectorMotion, seed: int) -> None:
        self._motion = motion
        self._random = np.random.default_rng([seed, 887])
        self._way_mm = array("d", [0.0])
        self._velocity_mm_s = motion.rms_mm_s * self._random.standard_normal()

    def __call__(self, time_s: float) -> float:
        """The way at a time; those before it are remembered, so that any may be asked for."""
        place = max(time_s, 0.0) / STEP_S
        index = int(place)
        while len(self._way_mm) <= index + 1:
            self._draw()
        before, after = self._way_mm[index : index + 2]
        return _back_and_forth(before + (after - before) * (place - index), self._motion.range_mm)

    def _draw(self) -> None:
        kept = math.exp(-STEP_S / self._motion.correlation_s)
        new = self._motion.rms_mm_s * math.sqrt(1 - kept**2) * self._random.standard_normal()
        most = _RANDOM_PEAK * self._motion.rms_mm_s
        self._velocity_mm_s = max(-most, min(most, kept * self._velocity_mm_s + new))
        self._way_mm.append(self._way_mm[-1] + self._velocity_mm_s * STEP_S)


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
    # It begins where the collector stands, at once: the first row is the start.
    times_s, places = table[:, 0] - table[0, 0], table[:, 1:] - table[0, 1:]
    steps = np.hypot(*np.diff(places, axis=0).T) / np.diff(times_s)

    def displacement(time_s: float) -> Displacement:
        az, el = (np.interp(time_s, times_s, column) for column in places.T)
        return float(az), float(el)

    return Course(displacement, [(az, el) for az, el in places.tolist()], float(steps.max()))
