"""What moves a star, as one linear system: air path and lines of vibrations, at a moment and during a hold."""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

from fitctl.config import AirPathModel
from fitctl.controllers.design.basis import Basis, Line
from fitctl.model.air_path import discretize, state_space

Floats = NDArray[np.float64]
# Of Gauss-Legendre: exact to rounding for anything smooth over one period.
_NODE, _WEIGHT = np.polynomial.legendre.leggauss(8)
_REMEMBERED = 256  # of what parts are, and do in a time


class Oscillator(NamedTuple):
    """One part of a disturbance: x' = a x + w, of which the camera sees ``seen @ x``, in pixels.

    Attributes
    ----------
    a, noise, covariance : arrays, shape (2, 2)
        `noise` is the intensity of the white noise w, `covariance` the stationary one of the states.
    seen : array, shape (2,)
    """

    a: Floats
    noise: Floats
    covariance: Floats
    seen: Floats


class Disturbance(NamedTuple):
    """All that moves a star: parts that nothing couples, each with two states.

    Attributes
    ----------
    parts : tuple of AirPathModel or Line
        The air path first.
    """

    parts: tuple[AirPathModel | Line, ...]

    @property
    def a(self) -> Floats:
        """Of x' = a x + w, shape (n, n)."""
        return blocks(*(_oscillator(part).a for part in self.parts))

    @property
    def seen(self) -> Floats:
        """The camera sees ``seen @ x``, shape (n,)."""
        return np.concatenate([_oscillator(part).seen for part in self.parts])

    @property
    def covariance(self) -> Floats:
        """Of the states, stationary, shape (n, n)."""
        return blocks(*(_oscillator(part).covariance for part in self.parts))

    def over(self, time_s: float) -> tuple[Floats, Floats]:
        """Transition matrix and the covariance of what comes new, over a time, shapes (n, n)."""
        transitions, noises = zip(*(_over(part, time_s) for part in self.parts), strict=True)
        return blocks(*transitions), blocks(*noises)

    def later(self, times_s: tuple[float, ...]) -> Floats:
        """What of the states now is the star's own motion after these times, shape (times, n)."""
        return np.hstack([_later(part, times_s) for part in self.parts])

    def new_px2(self, later: Floats) -> Floats:
        """Variance of what comes new until then, shape (times,); `later` is of :meth:`later`."""
        everything, seen = self.covariance, self.seen
        known = ((later @ everything) * later).sum(axis=1)
        return np.asarray(seen @ everything @ seen - known)


def disturbance(basis: Basis) -> Disturbance:
    """The air path of a basis, its lines, and its guard if it has one."""
    guard = () if basis.guard is None else (basis.guard,)
    return Disturbance((basis.air_path, *basis.lines, *guard))


def blocks(*parts: Floats) -> Floats:
    """Square matrices along a diagonal; scipy's takes five times as long."""
    made = np.zeros((sum(map(len, parts)),) * 2)
    first = 0
    for part in parts:
        made[first : first + len(part), first : first + len(part)] = part
        first += len(part)
    return made


# A search for a design tries hundreds of guards beside the same air path and lines.
@functools.lru_cache(_REMEMBERED)
def _oscillator(part: AirPathModel | Line) -> Oscillator:
    if isinstance(part, Line):
        a, noise, seen = _line(part)
    else:
        a, b, c = state_space(part)
        noise, seen = b @ b.T, c[0]
    return Oscillator(a, noise, np.asarray(solve_continuous_lyapunov(a, -noise)), seen)


@functools.lru_cache(_REMEMBERED)
def _over(part: AirPathModel | Line, time_s: float) -> tuple[Floats, Floats]:
    own = _oscillator(part)
    return discretize(own.a, own.noise, time_s)


@functools.lru_cache(_REMEMBERED)
def _later(part: AirPathModel | Line, times_s: tuple[float, ...]) -> Floats:
    own = _oscillator(part)
    return np.asarray(own.seen @ expm(np.array(times_s)[:, None, None] * own.a))


def _line(line: Line) -> tuple[Floats, Floats, Floats]:
    """A damped oscillator under white noise; its states are the motion, and its rate over omega.

    The rate is scaled so that both states are of one size.
    """
    omega_rad_s = 2 * math.pi * line.frequency_hz
    a = omega_rad_s * np.array([[0.0, 1.0], [-1.0, -2 * line.damping]])
    # Its variance is q / (4 zeta omega): Lyapunov's equation of this A.
    intensity = 4 * line.damping * omega_rad_s * line.rms_px**2
    return a, np.diag([0.0, intensity]), np.array([1.0, 0.0])


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
    return Hold(part, _WEIGHT / 2, moving.later(tuple((delay_s + part * period_s).tolist())))


def holds(moving: Disturbance, writes: int, period_s: float, delay_s: float) -> list[Hold]:
    """The same time in equal parts, one for each write of the D/A."""
    part_s = period_s / writes
    return [hold(moving, part_s, delay_s + write * part_s) for write in range(writes)]
