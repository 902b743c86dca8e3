"""Vibration lines: damped oscillators, driven by random kicks, that move a star as the air does.

A line is kicked at the air path's nodes and swings freely between them. Kicks of one variance, at equal times,
have a white spectrum, so the motion has exactly the spectrum of an oscillator that white noise drives. Without
damping nothing kicks it, and it is a sine.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Line
from fitctl.model.compiled import compilable
from fitctl.model.image.pixel_noise import normals_of_frames, pixel_normals

Floats = NDArray[np.float64]
LEAST_HZ = 0.01
"""A line that drifts down stays here."""
FIELDS = 5
"""Numbers of a line: frequency in Hz, drift in Hz/s, damping, and az and el in px of its RMS."""


def line_table(lines: Sequence[Line]) -> Floats:
    """Numbers of lines for :func:`line_motion`, shape (lines, FIELDS)."""
    rows = []
    for line in lines:
        angle = math.radians(line.direction_deg)
        towards = math.cos(angle), math.sin(angle)
        rows.append(
            [
                line.frequency_hz,
                line.drift_hz_per_min / 60,
                line.damping,
                *(line.rms_px * part for part in towards),
            ]
        )
    return np.array(rows, dtype=float).reshape(-1, FIELDS)


def line_states(table: Floats, key: int) -> Floats:
    """Where lines begin, shape (lines, 2): displacement and rate, as :func:`line_motion` has them.

    From the stationary distribution; a sine has a random phase.
    """
    normals = pixel_normals(key, 0, 2 * len(table)).reshape(-1, 2)
    damping = table[:, 2, None]
    sine = math.sqrt(2) * normals / np.linalg.norm(normals, axis=1, keepdims=True)
    rate = (normals[:, 1:] + damping * normals[:, :1]) / np.sqrt(1 - damping**2)
    return np.where(damping > 0, np.hstack([normals[:, :1], -rate]), sine)


def line_kicks(key: int, first_node: int, nodes: int, lines: int) -> Floats:
    """Standard normals that kick lines at the end of each node, shape (nodes, lines)."""
    return normals_of_frames(key, first_node + 1, nodes, lines)


@compilable()
def line_motion(
    table: Floats,
    state: Floats,
    kicks: Floats,
    since_s: float,
    steps: int,
    step_s: float,
    motion_px: Floats,
) -> None:
    """Add the motion of lines over some nodes to `motion_px`; `state` goes on with it.

    Parameters
    ----------
    table : array, shape (lines, FIELDS)
        :func:`line_table`.
    state : array, shape (lines, 2)
        Real and imaginary part of a rotating pointer, whose real part is the displacement in units of its RMS.
    kicks : array, shape (nodes, lines)
        Standard normals.
    since_s : float
        Time of the first node since the lines had the frequencies of the table.
    steps : int
        From one node to the next.
    step_s : float
    motion_px : array, shape (nodes * steps, 2)
    """
    node_s = steps * step_s
    for line in range(table.shape[0]):
        frequency_hz, drift_hz_s, damping = table[line, 0], table[line, 1], table[line, 2]
        az_px, el_px = table[line, 3], table[line, 4]
        real, imaginary = state[line, 0], state[line, 1]
        rest = math.sqrt(1 - damping**2)
        if damping == 0 and since_s == 0:
            # A damped line before it leaves its amplitude of that instant, which nothing would change.
            to_rms = math.sqrt(2) / math.hypot(real, imaginary)
            real, imaginary = to_rms * real, to_rms * imaginary
        for node in range(kicks.shape[0]):
            hz = max(LEAST_HZ, frequency_hz + drift_hz_s * (since_s + node * node_s))
            rad_s = 2 * math.pi * hz
            decay = math.exp(-damping * rad_s * step_s)
            cosine = decay * math.cos(rest * rad_s * step_s)
            sine = decay * math.sin(rest * rad_s * step_s)
            for step in range(steps):
                real, imaginary = (
                    cosine * real - sine * imaginary,
                    sine * real + cosine * imaginary,
                )
                motion_px[node * steps + step, 0] += az_px * real
                motion_px[node * steps + step, 1] += el_px * real
            # A kick of the rate: the displacement does not jump.
            imaginary -= math.sqrt(4 * damping * rad_s * node_s) / rest * kicks[node, line]
        state[line, 0], state[line, 1] = real, imaginary
