"""What moves a star, as one linear system: air path and lines of vibrations, at a moment and during a hold."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, expm, solve_continuous_lyapunov

from fitctl.controllers.design.basis import Basis, Line
from fitctl.model.air_path import discretize, state_space

Floats = NDArray[np.float64]
_NODES = 8  # of Gauss-Legendre: exact to rounding for anything smooth over one period


class Disturbance(NamedTuple):
    """x' = a x + w, of which the camera sees ``seen @ x``, in pixels.

    Attributes
    ----------
    a, noise : arrays, shape (n, n)
        `noise` is the intensity of the white noise w. The first two states are the air path.
    seen : array, shape (n,)
    """

    a: Floats
    noise: Floats
    seen: Floats

    def over(self, time_s: float) -> tuple[Floats, Floats]:
        """Transition matrix and the covariance of what comes new, over a time."""
        return discretize(self.a, self.noise, time_s)

    @property
    def covariance(self) -> Floats:
        """Of the states, stationary."""
        return np.asarray(solve_continuous_lyapunov(self.a, -self.noise))


def disturbance(basis: Basis) -> Disturbance:
    """The air path of a basis, its lines, and its guard if it has one."""
    a, b, c = state_space(basis.air_path)
    lines = basis.lines if basis.guard is None else (*basis.lines, basis.guard)
    parts = [(a, b @ b.T, c[0]), *map(_line, lines)]
    blocks, noises, outputs = zip(*parts, strict=True)
    return Disturbance(block_diag(*blocks), block_diag(*noises), np.concatenate(outputs))


def _line(line: Line) -> tuple[Floats, Floats, Floats]:
    """A damped oscillator under white noise; its states are the motion, and its rate over omega.

    The rate is scaled so that both states are of one size.
    """
    omega_rad_s = 2 * math.pi * line.frequency_hz
    a = omega_rad_s * np.array([[0.0, 1.0], [-1.0, -2 * line.damping]])
    # Its variance is q / (4 zeta omega): Lyapunov's equation of this A.
    intensity = 4 * line.damping * omega_rad_s * line.rms_px**2
    return a, np.diag([0.0, intensity]), np.array([1.0, 0.0])


def line_px2_per_hz(own_hz: float, half_width_hz: float | Floats, frequency_hz: Floats) -> Floats:
    """One-sided power spectral density of a line of 1 px RMS, in continuous time.

    Parameters
    ----------
    own_hz : float
        Of the oscillator.
    half_width_hz : float or array
        At half power: ``damping * own_hz``; an array has the shape of `frequency_hz`.
    frequency_hz : array
    """
    own, width = 2 * math.pi * own_hz, 4 * math.pi * half_width_hz
    omega2 = (2 * math.pi * frequency_hz) ** 2
    return np.asarray(4 * width * own**2 / ((own**2 - omega2) ** 2 + width**2 * omega2))


class Hold(NamedTuple):
    """The time for which a command acts, as nodes of a quadrature.

    Attributes
    ----------
    part, weight : arrays, shape (nodes,)
        Place within the hold, from 0 to 1, and weight, of sum 1.
    star : array, shape (nodes, n)
        The star's own motion there is this of the disturbance's state at mid-exposure,
    new_px2 : array, shape (nodes,)
        and besides something new of this variance.
    """

    part: Floats
    weight: Floats
    star: Floats
    new_px2: Floats


def hold(moving: Disturbance, period_s: float, delay_s: float) -> Hold:
    """The time from `delay_s` after mid-exposure to one period later."""
    a, seen = moving.a, moving.seen
    node, weight = np.polynomial.legendre.leggauss(_NODES)
    part = (node + 1) / 2
    times_s = delay_s + part * period_s
    return Hold(
        part=part,
        weight=weight / 2,
        star=np.array([seen @ expm(a * time_s) for time_s in times_s]),
        new_px2=np.array([seen @ moving.over(time_s)[1] @ seen for time_s in times_s]),
    )


def holds(moving: Disturbance, writes: int, period_s: float, delay_s: float) -> list[Hold]:
    """The same time in equal parts, one for each write of the D/A."""
    part_s = period_s / writes
    return [hold(moving, part_s, delay_s + write * part_s) for write in range(writes)]
