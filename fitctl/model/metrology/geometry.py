"""Where the collector's mirrors and photodiodes stand, and what a motion of their bench does to both lights.

docs/theory-testbed.md derives both. A bench turned by small angles psi carries its two mirrors along. Two
reflections are one rotation M, so the outgoing light turns by ``((1 - M) psi) x link``: not at all where psi
lies along the axis of M, the fold's, and by up to twice psi otherwise.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from fitctl.config import CollectorGeometry

Floats = NDArray[np.float64]
_SI = np.array([1e-3, 1e-3, 1e-3, *np.radians([1.0, 1.0, 1.0])])  # mm and degrees to m and rad


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
