"""The likeliest spectrum for the periodograms of a night, by Whittle's likelihood.

A periodogram is, at each frequency, the spectrum times an independent exponential number. So the likelihood
is a sum over frequencies (P. Whittle, Ark. Mat. 2, 423, 1953); as in Coronel et al., Sensors 21, 3054 (2021),
the spectrum is that of damped oscillators as frames sample them, aliases included.

The loop was closed when the data were recorded, but the likelihood is that of the open loop. The star's
motion follows from the measurements by taking away what the mirror did, and the mirror acts only on later
frames. So a change of variables between both has the determinant one, whatever the controller was. This is the
direct method of closed-loop identification (Forssell and Ljung, Automatica 35, 1215, 1999): it has no bias
if the model can express the disturbance: :mod:`fitctl.learn.goodness_of_fit` tests this. Therefore the mirror's
gain and overshoot are two more parameters, and need no experiment.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.controllers.design.linear_loop.spectrum import (
    Air,
    air_slopes,
    framed_line_slopes,
    white_px2_per_hz,
)
from fitctl.learn.opened import Opened

Floats = NDArray[np.float64]
BROADEST = 0.1
"""Half width of a line, as a part of its frequency: what is broader is no line."""
_NARROWEST = 0.02  # half width in half widths of a pure sine: too narrow for the segments to show
_FARTHEST = 25.0  # from where a line was first seen, in half widths of a pure sine
_MOST_LOG_GAIN, _MOST_OVERSHOOT = 1.0, 0.5
_MOST_STEPS, _LONGEST_STEP, _MOST_DAMPING = 100, 2.0, 1e6
_ENOUGH = 1e-3  # of the cost, which is a logarithm of a probability
_PROBE = 1e-2  # of a parameter, for the likelihood's curvature
# How far from where the search begins a logarithm is expected, one standard deviation: no more than a hint, so
# that what the periodograms do not show stays finite.
_FACTOR_20, _GAIN_HINT, _OVERSHOOT_HINT = 3.0, 0.3, 0.1
_AIR, _NOISE, _GAIN, _OVERSHOOT, _FIRST_LINE = slice(0, 3), 3, 4, 5, 6


class LineGuess(NamedTuple):
    """A line: frequency and half width in Hz, and RMS for each axis, shape (axes,), in px."""

    frequency_hz: float
    half_width_hz: float
    rms_px: Floats


class Guess(NamedTuple):
    """A spectrum: air path, noise of a frame in px, gain and overshoot of the mirror, lines."""

    air: Air
    noise_px: float
    gain: float = 1.0
    overshoot: float = 0.0
    lines: tuple[LineGuess, ...] = ()


@dataclass(frozen=True)
class Likeliest:
    """The end of a search.

    Attributes
    ----------
    guess : Guess
    cost : float
        Negative logarithm of the likelihood.
    density : array, shape (rows, axes)
        One-sided, px²/Hz.
    find_covariance : callable
        For :attr:`covariance`, shape (n, n), of the parameters: logarithms of strength, damping, stiffness,
        noise and gain; the overshoot; then for each line its frequency in Hz, and logarithms of its half width
        and of its RMS by axis.
    """

    guess: Guess
    cost: float
    density: Floats
    find_covariance: Callable[[], Floats] = field(repr=False)

    @functools.cached_property
    def covariance(self) -> Floats:
        """Only the last of many searches needs it, and it takes as long as the search."""
        return self.find_covariance()


def likeliest(opened: Opened, begin: Guess, *, free_mirror: bool = True) -> Likeliest:
    """Search from a first guess; the number of lines stays, and the mirror if it is not free."""
    problem = _Problem(opened, begin, free_mirror=free_mirror)
    values, cost = _lowest(problem)
    guess = problem.guess(values)
    density = problem.density(guess)[0]
    return Likeliest(guess, cost, density, functools.partial(problem.covariance, values))


def _lowest(problem: _Problem) -> tuple[Floats, float]:
    """Where the cost is lowest, by Fisher's scoring, damped as Levenberg and Marquardt do."""
    low, high = np.array(problem.bounds).T
    values, damping = np.clip(problem.begin, low, high), 1e-2
    cost, gradient = problem.cost(values)
    information = problem.information(values)
    for _ in range(_MOST_STEPS):
        # What is at a bound and would go beyond it stays.
        free = (low < high) & ((values > low) | (gradient < 0)) & ((values < high) | (gradient > 0))
        some = np.ix_(free, free)
        damped = information[some] + damping * np.diag(np.diag(information)[free])
        step = np.zeros_like(values)
        step[free] = -np.linalg.lstsq(damped, gradient[free], rcond=None)[0]
        tried = np.clip(values + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), low, high)
        lower, its_gradient = problem.cost(tried)
        if not lower < cost:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gained, damping = cost - lower, damping / 5
        values, cost, gradient = tried, lower, its_gradient
        if gained < _ENOUGH:
            break
        information = problem.information(values)
    return values, cost


class _Problem:
    """Parameters as one vector: logarithms, and frequencies of lines in half widths of a pure sine."""

    def __init__(self, opened: Opened, begin: Guess, *, free_mirror: bool = True) -> None:
        self.opened = opened
        self.axes = opened.disturbance.shape[1]
        self._weight = opened.segments[:, None] / opened.inflation
        self._resolution_hz = float(opened.resolution_hz.min())
        self._centres_hz = [line.frequency_hz for line in begin.lines]
        highest_hz = 0.5 / opened.period_s
        first = [*np.log(begin.air), math.log(begin.noise_px), math.log(begin.gain)]
        first.append(begin.overshoot)
        # The air must not become a resonance, or it would pass for a line.
        reach = [_FACTOR_20 * part for part in (2, 1, 1, 2)]
        self.bounds: list[tuple[float, float]] = [
            (value - far, value + far) for value, far in zip(first[:_GAIN], reach, strict=True)
        ]
        mirror = [(-_MOST_LOG_GAIN, _MOST_LOG_GAIN), (-_MOST_OVERSHOOT, _MOST_OVERSHOOT)]
        fixed = [(value, value) for value in first[_GAIN:_FIRST_LINE]]
        self.bounds += mirror if free_mirror else fixed
        hints = [_FACTOR_20] * 4 + [_GAIN_HINT, _OVERSHOOT_HINT]
        centre = [*first[:_GAIN], 0.0, 0.0]
        for line in begin.lines:
            width = math.log(max(line.half_width_hz, self._resolution_hz * _NARROWEST * 2))
            widest = math.log(BROADEST * line.frequency_hz)
            away = min(_FARTHEST, (highest_hz - line.frequency_hz) / self._resolution_hz)
            rms = np.log(np.maximum(line.rms_px, 1e-3 * begin.noise_px)).tolist()
            first += [0.0, min(width, widest), *rms]
            centre += [0.0, math.log(self._resolution_hz), *rms]
            self.bounds += [
                (-_FARTHEST, away),
                (math.log(_NARROWEST * self._resolution_hz), widest),
                *[(value - 8, value + 8) for value in rms],
            ]
            hints += [10.0, _FACTOR_20, *[_FACTOR_20] * self.axes]
        self.begin = np.array(first)
        self._centre, self._hints = np.array(centre), np.array(hints)
        self._last: tuple[Floats, tuple[Guess, Floats, list[Floats]]] | None = None

    def guess(self, values: Floats) -> Guess:
        """What a vector stands for."""
        lines = []
        for number, centre_hz in enumerate(self._centres_hz):
            at = _FIRST_LINE + number * (2 + self.axes)
            lines.append(
                LineGuess(
                    centre_hz + float(values[at]) * self._resolution_hz,
                    math.exp(values[at + 1]),
                    np.exp(values[at + 2 : at + 2 + self.axes]),
                )
            )
        return Guess(
            Air(*np.exp(values[_AIR]).tolist()),
            math.exp(values[_NOISE]),
            math.exp(values[_GAIN]),
            float(values[_OVERSHOOT]),
            tuple(lines),
        )

    def density(self, guess: Guess) -> tuple[Floats, list[Floats]]:
        """The spectrum, shape (rows, axes), and its derivatives by all parameters but the mirror's."""
        opened = self.opened
        hz, period_s = opened.frequency_hz, opened.period_s
        air, *by_air = (each[:, None] for each in air_slopes(guess.air, hz, period_s))
        white = white_px2_per_hz(guess.noise_px, period_s)
        total = air + white
        slopes = [2 * air, *by_air, np.full((len(hz), 1), 2 * white)]
        for line in guess.lines:
            width_hz = line.half_width_hz + opened.resolution_hz
            shapes = framed_line_slopes(line.frequency_hz, width_hz, hz, period_s)
            unit, by_hz, by_width = (each[:, None] for each in shapes)
            power = np.square(line.rms_px)
            total = total + unit * power
            slopes += [by_hz * power * self._resolution_hz, by_width * power * line.half_width_hz]
            slopes += [2 * unit * power * row for row in np.eye(self.axes)]
        return np.broadcast_to(total, opened.disturbance.shape), slopes

    def _density_at(self, values: Floats) -> tuple[Guess, Floats, list[Floats]]:
        """Of a vector, with its guess; the last is kept: cost and information of one follow each other."""
        if self._last is None or not np.array_equal(values, self._last[0]):
            guess = self.guess(values)
            self._last = values.copy(), (guess, *self.density(guess))
        return self._last[1]

    def cost(self, values: Floats) -> tuple[float, Floats]:
        """Negative logarithm of the likelihood, and its gradient."""
        opened = self.opened
        guess, total, slopes = self._density_at(values)
        inverse = 1 / total
        ratio = opened.with_mirror(guess.gain, guess.overshoot) * inverse
        away = (values - self._centre) / self._hints
        cost = np.sum(self._weight * (np.log(total) + ratio)) + 0.5 * away @ away
        pull = self._weight * (1 - ratio) * inverse
        gradient = [float(np.sum(pull * slope)) for slope in slopes]
        # Of the periodogram by the gain's logarithm, and by the overshoot.
        step = opened.step_response()
        left = opened.cross + (1 - guess.gain - guess.overshoot * step) * opened.mirror
        for index, by in ((_GAIN, -guess.gain), (_OVERSHOOT, -step.conj())):
            turned = 2 * (by * left).real
            gradient.insert(index, float(np.sum(self._weight * turned * inverse)))
        return float(cost), np.array(gradient) + away / self._hints

    def information(self, values: Floats) -> Floats:
        """Fisher's information, with what the mirror and the spectrum share."""
        opened = self.opened
        guess, total, slopes = self._density_at(values)
        weight = self._weight / total
        step = opened.step_response()
        left = opened.cross + (1 - guess.gain - guess.overshoot * step) * opened.mirror
        moves = (np.full_like(step, -guess.gain), -step)
        spectrum = np.array([np.broadcast_to(slope / total, total.shape) for slope in slopes])
        flat = spectrum.reshape(len(slopes), -1)
        everything = np.empty((len(values), len(values)))
        own = np.array([index for index in range(len(values)) if not _GAIN <= index < _FIRST_LINE])
        by_weight = flat * np.broadcast_to(self._weight, total.shape).ravel()
        everything[np.ix_(own, own)] = by_weight @ flat.T
        for index, move in zip((_GAIN, _OVERSHOOT), moves, strict=True):
            turned = 2 * (move.conj() * left).real * weight
            shared = -flat @ turned.ravel()
            everything[index, own] = everything[own, index] = shared
            for other, also in zip((_GAIN, _OVERSHOOT), moves, strict=True):
                both = 2 * (move.conj() * also).real * opened.mirror
                everything[index, other] = np.sum(both * weight)
        return np.asarray(everything + np.diag(1 / self._hints**2))

    def covariance(self, values: Floats) -> Floats:
        """Inverse of the likelihood's curvature; frequencies in Hz."""
        n = len(values)
        curvature = np.empty((n, n))
        for index in range(n):
            step = _PROBE * np.eye(n)[index]
            curvature[index] = (self.cost(values + step)[1] - self.cost(values - step)[1]) / (
                2 * _PROBE
            )
        curvature = (curvature + curvature.T) / 2
        # Where the search ended at a bound, a direction may look like a maximum: it is not known.
        powers, directions = np.linalg.eigh(curvature)
        known = np.maximum(powers, 1e-3)
        covariance = directions @ np.diag(1 / known) @ directions.T
        scale = np.ones(n)
        scale[_FIRST_LINE :: 2 + self.axes] = self._resolution_hz
        return np.asarray(covariance * np.outer(scale, scale))
