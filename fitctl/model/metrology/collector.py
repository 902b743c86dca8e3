"""The collector bench: how its displacement and rotation move the photodiodes and turn the starlight.

docs/theory.md derives both. A bench turned by small angles psi carries its two mirrors along. Two reflections
are one rotation M, so the outgoing light turns by ``((1 - M) psi) x link``: not at all where psi lies along the
axis of M, the fold's, and by up to twice psi otherwise.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from fitctl.config import Collector, CollectorGeometry
from fitctl.model.hexapod_motion import at_rest
from fitctl.model.timeline import Part, Timeline

Floats = NDArray[np.float64]
_SI = np.array([1e-3, 1e-3, 1e-3, *np.radians([1.0, 1.0, 1.0])])  # mm and degrees to m and rad


class Course(Protocol):
    """Where the hexapod is over time, as :class:`fitctl.model.hexapod_motion.Trajectory`."""

    def pose_at(self, time_s: ArrayLike) -> Floats:
        """Poses, mm and degrees, shape (..., 6)."""
        ...


def transverse_axes(geometry: CollectorGeometry) -> Floats:
    """Azimuth and elevation at the array, in the hexapod's axes, shape (2, 3)."""
    azimuth = np.array(geometry.link_azimuth)
    return np.array([azimuth, np.cross(geometry.link, azimuth)])


def fold(geometry: CollectorGeometry) -> Floats:
    """The rotation that both collector mirrors together are to the light, shape (3, 3)."""
    between = np.subtract(geometry.array_m, geometry.siderostat_m)
    between = between / np.linalg.norm(between)
    starlight, link = np.array(geometry.starlight), np.array(geometry.link)
    return reflection(link - between) @ reflection(between - starlight)


def reflection(normal: Floats) -> Floats:
    """The reflection at a mirror with this normal, of any length, shape (3, 3)."""
    unit = normal / np.linalg.norm(normal)
    return np.eye(3) - 2.0 * np.outer(unit, unit)


def star_turn(geometry: CollectorGeometry) -> Floats:
    """c, shape (2, 3): how far a rotation of the bench, in radians, turns the starlight on the sky."""
    link = np.array(geometry.link)
    turned = (np.eye(3) - fold(geometry)).T  # row k: what a rotation about axis k leaves
    return transverse_axes(geometry) @ np.cross(turned, link).T


def array_lever(geometry: CollectorGeometry) -> Floats:
    """How far a rotation of the bench, in radians, moves the array across the link: metres, shape (2, 3)."""
    arm_m = np.subtract(geometry.array_m, geometry.pivot_m)
    return transverse_axes(geometry) @ np.cross(np.eye(3), arm_m).T


def array_from_pose(geometry: CollectorGeometry) -> Floats:
    """From a pose in mm and degrees to the array's displacement across the link in metres, shape (2, 6)."""
    return np.hstack([transverse_axes(geometry), array_lever(geometry)]) * _SI


def star_from_pose(geometry: CollectorGeometry) -> Floats:
    """From a pose in mm and degrees to how far the starlight is turned, in radians on the sky, shape (2, 6)."""
    return np.hstack([np.zeros((2, 3)), star_turn(geometry)]) * _SI


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
