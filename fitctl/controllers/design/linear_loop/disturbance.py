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
# Of Gauss-Legendre: exact to rounding for anything smooth over one period.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(8)


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

    def later(self, times_s: Floats) -> Floats:
        """What of the states now is the star's own motion after these times, shape (times, n)."""
        first = np.arange(0, len(self.a), 2)
        pair = np.add.outer(first, np.arange(2))
        oscillators = self.a[pair[:, :, None], pair[:, None, :]]  # nothing couples them
        each = expm(times_s[:, None, None, None] * oscillators)
        return np.asarray(
            np.einsum("oi,toij->toj", self.seen[pair], each).reshape(len(times_s), -1)
        )

    def new_px2(self, later: Floats) -> Floats:
        """Variance of what comes new until then, shape (times,); `later` is of :meth:`later`."""
        everything = self.covariance
        known = np.einsum("ti,ij,tj->t", later, everything, later)
        return np.asarray(self.seen @ everything @ self.seen - known)

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
        The star's own motion there is this of the disturbance's state at mid-exposure, and something new.
    """

    part: Floats
    weight: Floats
    star: Floats


def hold(moving: Disturbance, period_s: float, delay_s: float) -> Hold:
    """The time from `delay_s` after mid-exposure to one period later."""
    part = (_NODE + 1) / 2
    return Hold(part, _WEIGHT / 2, moving.later(delay_s + part * period_s))


def holds(moving: Disturbance, writes: int, period_s: float, delay_s: float) -> list[Hold]:
    """The same time in equal parts, one for each write of the D/A."""
    part_s = period_s / writes
    return [hold(moving, part_s, delay_s + write * part_s) for write in range(writes)]
