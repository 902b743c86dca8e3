"""Structural modes of the fast steering mirror's mount (Figs. 5-6): flat below 100 Hz, coupled above."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm

from fitctl.config import Structure

Complexes = NDArray[np.complex128]
Floats = NDArray[np.float64]


def mode_shapes(structure: Structure) -> Floats:
    """Orthonormal mode directions, shape (modes, 2), turned from the axes by atan(cross_axis).

    Because they are orthonormal, the static mirror is exactly uncoupled, as measured below 100 Hz.
    """
    angle = np.arctan(structure.cross_axis)
    return np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])


def mode_matrices(structure: Structure, step_s: float) -> tuple[Floats, Floats]:
    """Exact zero-order-hold step of each mode: x+ = A x + B u, x = (position, velocity).

    Returns
    -------
    transition : array, shape (modes, 2, 2)
    gain : array, shape (modes, 2)
    """
    transitions, gains = [], []
    for frequency_hz in structure.mode_hz:
        omega = 2 * np.pi * frequency_hz
        block = np.zeros((3, 3))
        block[0, 1] = 1.0
        block[1] = [-(omega**2), -2 * structure.damping * omega, omega**2]
        step = expm(block * step_s)
        transitions.append(step[:2, :2])
        gains.append(step[:2, 2])
    return np.array(transitions), np.array(gains)


def frequency_response(structure: Structure, frequency_hz: Floats) -> Complexes:
    """Mirror motion over commanded motion, shape (frequencies, 2, 2), complex; columns are inputs."""
    shapes = mode_shapes(structure)
    s = 2j * np.pi * np.asarray(frequency_hz)
    response = np.array((1 - structure.participation) * np.eye(2)[None], complex)
    for shape, mode_hz in zip(shapes, structure.mode_hz, strict=True):
        omega = 2 * np.pi * mode_hz
        gain = omega**2 / (s**2 + 2 * structure.damping * omega * s + omega**2)
        response = response + structure.participation * gain[:, None, None] * np.outer(shape, shape)
    return response
