"""What the collector does in a run, computed before it: drive and hexapod know nothing of the loops."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.clock import VirtualClock
from fitctl.config import Rig
from fitctl.model.metrology.collector import CollectorPart
from fitctl.model.timeline import Part, Timeline
from fitctl.simulation.devices import SimulatedHexapod
from fitctl.simulation.statistics import motion_start_s
from fitctl.stages.collector import CollectorDrive

Floats = NDArray[np.float64]
_COMMANDS = 2  # to reference the hexapod, and to begin: each at a step of its own


class Course(NamedTuple):
    """What the collector does to the laser beam and to the starlight.

    Attributes
    ----------
    array_m, star_rad : arrays, shape (steps, 2)
        Displacement of the photodiodes, and turn of the starlight, after each step of the plant; the last for
        all steps after it.
    """

    array_m: Floats
    star_rad: Floats


STILL = Course(np.zeros((1, 2)), np.zeros((1, 2)))


class _Keeper(Part):
    """Keeps where a collector was at every step."""

    def __init__(self, timeline: Timeline, collector: CollectorPart, steps: int) -> None:
        super().__init__(timeline)
        self._collector = collector
        self.course = Course(np.zeros((steps, 2)), np.zeros((steps, 2)))

    def begin_block(self) -> None:
        """Nothing is random here."""

    def step(self, first: int, steps: int) -> None:
        """Copy what the collector has made."""
        row = first % len(self._collector.array_m)
        kept, made = slice(first, first + steps), slice(row, row + steps)
        self.course.array_m[kept] = self._collector.array_m[made]
        self.course.star_rad[kept] = self._collector.star_rad[made]


def collector_course(rig: Rig, seed: int, duration_s: float) -> Course:
    """The course of a run of `duration_s`: what :func:`fitctl.simulation.simulation.simulate_rig` has done.

    Raises
    ------
    Exception
        What ends the course in a simulated run: a DeviceError or a ConfigError.
    """
    truth, mocks = rig.mock_parts()
    motion_s = motion_start_s(rig)
    if rig.collector is None or mocks.hexapod is None or motion_s >= duration_s:
        return STILL
    begun_s = _begun_s(rig, motion_s)
    clock, timeline = VirtualClock(), Timeline(truth.step_s, truth.history_s)
    part = CollectorPart(timeline, rig.collector)
    end_s = duration_s + 2 * rig.camera.period_s
    keeper = _Keeper(timeline, part, math.ceil(end_s / truth.step_s) + 1)
    hexapod = SimulatedHexapod(part, clock, rig.collector.hexapod, mocks.hexapod)
    drive = CollectorDrive(rig.collector, hexapod, clock, seed)
    due_s = rig.camera.period_s + drive.period_s  # the drive's periods count from when devices open
    while due_s <= begun_s:
        due_s += drive.period_s
    clock.sleep_until(begun_s)
    hexapod.reference()
    drive.start()
    while due_s <= end_s:
        clock.sleep_until(due_s)
        drive.period()
        if drive.fault is not None:
            raise drive.fault
        due_s += drive.period_s
    timeline.advance(end_s)
    return keeper.course


def _begun_s(rig: Rig, motion_s: float) -> float:
    """When a simulated run begins the motion: some steps after the first that ends at its start or later."""
    camera = rig.true_camera
    first_s, frames = camera.period_s + camera.exposure_s / 2, 1
    while first_s + frames * camera.period_s + camera.frame_delay_s < motion_s:
        frames += 1
    return first_s + (frames + _COMMANDS) * camera.period_s + camera.frame_delay_s
