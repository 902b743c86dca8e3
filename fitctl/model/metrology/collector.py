"""The collector bench in the plant: where the hexapod has it, what that does to photodiodes and starlight."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import Collector
from fitctl.model.hexapod_motion import at_rest
from fitctl.model.metrology.geometry import array_from_pose, star_from_pose
from fitctl.model.timeline import Part, Timeline

Floats = NDArray[np.float64]


class Course(Protocol):
    """Where the hexapod is over time, as :class:`fitctl.model.hexapod_motion.Trajectory`."""

    def pose_at(self, time_s: ArrayLike) -> Floats:
        """Poses, mm and degrees, shape (..., 6)."""
        ...


class CollectorPart(Part):
    """The collector bench of all runs, moved by the one hexapod.

    Parameters
    ----------
    timeline : Timeline
    collector : Collector

    Attributes
    ----------
    array_m : array, shape (block_steps, 2)
        The array's displacement across the link after each step, over and over again.
    star_rad : array, shape (block_steps, 2)
        How far the bench turns the starlight, likewise.
    """

    def __init__(self, timeline: Timeline, collector: Collector) -> None:
        super().__init__(timeline)
        self._array_from_pose = array_from_pose(collector.geometry)
        self._star_from_pose = star_from_pose(collector.geometry)
        self.array_m = np.empty((timeline.block_steps, 2))
        self.star_rad = np.empty((timeline.block_steps, 2))
        self._course: Course = at_rest(np.zeros(6))
        self._filled = 0  # steps for which both are there

    def follow(self, course: Course) -> None:
        """From the present time on, move as a course says; what it says of the past does not matter."""
        self._course = course
        self._filled = min(self._filled, self._timeline.steps)

    def pose(self, time_s: float) -> Floats:
        """Where the present course has the hexapod, in mm and degrees, shape (6,)."""
        return self._course.pose_at(time_s)

    def begin_block(self) -> None:
        """Nothing is random here."""

    def step(self, first: int, steps: int) -> None:
        """See that the steps are there; all up to the end of the block are made at once."""
        if first + steps <= self._filled:
            return
        start = max(first, self._filled)
        block = len(self.array_m)
        end = (start // block + 1) * block
        times_s = np.arange(start + 1, end + 1) * self._timeline.step_s
        poses = self._course.pose_at(times_s)
        rows = slice(start % block, start % block + end - start)
        self.array_m[rows] = poses @ self._array_from_pose.T
        self.star_rad[rows] = poses @ self._star_from_pose.T
        self._filled = end
