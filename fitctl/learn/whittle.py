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
    seen_at_hz,
    white_px2_per_hz,
)
from fitctl.learn.opened import Opened

Floats = NDArray[np.float64]
BROADEST = 0.1
"""Half width of a line, as a part of its frequency: what is broader is no line."""
_NARROWEST = 0.02  # half width in half widths of a pure sine: too narrow for the segments to show
_FARTHEST = 25.0  # from where a line was first seen, in half widths of a pure sine
_ALIAS_REACH = 0.8  # part of the way to 0 or to half the frame rate that an alias may move
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


class Near(NamedTuple):
    """How far a line may be from where it is expected, and how many times as broad, or as broad as that."""

    away_hz: float
    broader: float


ANYWHERE = Near(away_hz=math.inf, broader=1.0)
"""As far and as broad as the periodograms show."""


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


def likeliest(
    opened: Opened, begin: Guess, *, free_mirror: bool = True, near: Near = ANYWHERE
) -> Likeliest:
    """Search from a first guess; the number of lines stays, and the mirror if it is not free."""
    problem = _Problem(opened, begin, free_mirror=free_mirror, near=near)
    values, cost = _lowest(problem)
    guess = problem.guess(values)
    density = _Place(problem, values).density
    return Likeliest(guess, cost, density.T, functools.partial(problem.covariance, values))


def _lowest(problem: _Problem) -> tuple[Floats, float]:
    """Where the cost is lowest, by Fisher's scoring, damped as Levenberg and Marquardt do."""
    low, high = problem.low, problem.high
    values, damping = np.clip(problem.begin, low, high), 1e-2
    there = _Place(problem, values)
    cost, gradient, information = there.cost, there.gradient, there.information
    for _ in range(_MOST_STEPS):
        # What is at a bound and would go beyond it stays.
        free = (low < high) & ((values > low) | (gradient < 0)) & ((values < high) | (gradient > 0))
        some = np.ix_(free, free)
        damped = information[some] + damping * np.diag(np.diag(information)[free])
        step = np.zeros_like(values)
        step[free] = -np.linalg.solve(damped, gradient[free])
        tried = np.clip(values + np.clip(step, -_LONGEST_STEP, _LONGEST_STEP), low, high)
        there = _Place(problem, tried)
        if not there.cost < cost:
            damping *= 10
            if damping > _MOST_DAMPING:
                break
            continue
        gained, damping = cost - there.cost, damping / 5
        values, cost = tried, there.cost
        if gained < _ENOUGH:
            break
        gradient, information = there.gradient, there.information
    return values, cost


class _Problem:
    """Parameters as one vector: logarithms, and frequencies of lines in half widths of a pure sine.

    Arrays are of shape (axes, rows), as those of :class:`_Place` are.
    """

    def __init__(
        self,
        opened: Opened,
        begin: Guess,
        *,
        free_mirror: bool = True,
        near: Near = ANYWHERE,
    ) -> None:
        self.opened = opened
        self.axes = opened.disturbance.shape[1]
        self.weight = opened.segments / opened.inflation
        self.resolution_hz = float(opened.resolution_hz.min())
        self._centres_hz = [line.frequency_hz for line in begin.lines]
        first = [*np.log(begin.air), math.log(begin.noise_px), math.log(begin.gain)]
        first.append(begin.overshoot)
        # The air must not become a resonance, or it would pass for a line.
        reach = [_FACTOR_20 * part for part in (2, 1, 1, 2)]
        bounds = [
            (value - far, value + far) for value, far in zip(first[:_GAIN], reach, strict=True)
        ]
        mirror = [(-_MOST_LOG_GAIN, _MOST_LOG_GAIN), (-_MOST_OVERSHOOT, _MOST_OVERSHOOT)]
        fixed = [(value, value) for value in first[_GAIN:_FIRST_LINE]]
        bounds += mirror if free_mirror else fixed
        hints = [_FACTOR_20] * 4 + [_GAIN_HINT, _OVERSHOOT_HINT]
        centre = [*first[:_GAIN], 0.0, 0.0]
        for line in begin.lines:
            width = math.log(max(line.half_width_hz, self.resolution_hz * _NARROWEST * 2))
            seen_hz = seen_at_hz(line.frequency_hz, 1 / opened.period_s)
            broader_hz = max(near.broader * line.half_width_hz, near.away_hz)
            widest = math.log(min(BROADEST * seen_hz, broader_hz))
            farthest = min(_FARTHEST, near.away_hz / self.resolution_hz)
            to_end_hz = 0.5 / opened.period_s - seen_hz
            # The search may not move an alias past a multiple of half the frame rate.
            is_alias = line.frequency_hz > seen_hz
            most_hz = _ALIAS_REACH * min(seen_hz, to_end_hz) if is_alias else to_end_hz
            away = min(farthest, most_hz / self.resolution_hz)
            rms = np.log(np.maximum(line.rms_px, 1e-3 * begin.noise_px)).tolist()
            first += [0.0, min(width, widest), *rms]
            centre += [0.0, math.log(self.resolution_hz), *rms]
            bounds += [
                (-away if is_alias else -farthest, away),
                (math.log(_NARROWEST * self.resolution_hz), widest),
                *[(value - 8, value + 8) for value in rms],
            ]
            hints += [10.0, _FACTOR_20, *[_FACTOR_20] * self.axes]
        self.begin = np.array(first)
        self.low, self.high = np.transpose(bounds)
        self.centre, self.hints = np.array(centre), np.array(hints)
        self.any_mirror = opened.any_mirror

    def guess(self, values: Floats) -> Guess:
        """What a vector stands for."""
        lines = []
        for number, centre_hz in enumerate(self._centres_hz):
            at = _FIRST_LINE + number * (2 + self.axes)
            lines.append(
                LineGuess(
                    centre_hz + float(values[at]) * self.resolution_hz,
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

    def covariance(self, values: Floats) -> Floats:
        """Inverse of the likelihood's curvature; frequencies in Hz."""
        n = len(values)
        curvature = np.empty((n, n))
        for index in range(n):
            step = _PROBE * np.eye(n)[index]
            curvature[index] = (
                _Place(self, values + step).gradient - _Place(self, values - step).gradient
            ) / (2 * _PROBE)
        curvature = (curvature + curvature.T) / 2
        # Where the search ended at a bound, a direction may look like a maximum: it is not known.
        powers, directions = np.linalg.eigh(curvature)
        known = np.maximum(powers, 1e-3)
        covariance = directions @ np.diag(1 / known) @ directions.T
        scale = np.ones(n)
        scale[_FIRST_LINE :: 2 + self.axes] = self.resolution_hz
        return np.asarray(covariance * np.outer(scale, scale))


class _Place:
    """A vector of parameters; arrays of shape (axes, rows).

    Attributes
    ----------
    cost : float
        Negative logarithm of the likelihood.
    density : array
        The spectrum.
    """

    def __init__(self, problem: _Problem, values: Floats) -> None:
        self._problem = problem
        self._guess = guess = problem.guess(values)
        opened = problem.opened
        hz, period_s = opened.frequency_hz, opened.period_s
        self._air = air_slopes(guess.air, hz, period_s)
        self._white = white_px2_per_hz(guess.noise_px, period_s)
        self._lines = [
            framed_line_slopes(
                line.frequency_hz, line.half_width_hz + opened.resolution_hz, hz, period_s
            )
            for line in guess.lines
        ]
        self.density = np.repeat([self._air[0] + self._white], problem.axes, axis=0)
        for line, (unit, *_) in zip(guess.lines, self._lines, strict=True):
            self.density += np.square(line.rms_px)[:, None] * unit
        self._ratio = problem.any_mirror.periodograms(guess.gain, guess.overshoot) / self.density
        self._away = (values - problem.centre) / problem.hints
        likelihood = np.sum((np.log(self.density) + self._ratio) @ problem.weight)
        self.cost = float(likelihood + 0.5 * self._away @ self._away)

    @functools.cached_property
    def _own(self) -> Floats:
        """Of the spectrum, by its own parameters, in parts of it: shape (parameters, axes, rows)."""
        problem, axes = self._problem, self._problem.axes
        own = np.zeros((_GAIN + (2 + axes) * len(self._lines), axes, len(problem.weight)))
        total, by_damping, by_stiffness = self._air
        own[0], own[1], own[2], own[3] = 2 * total, by_damping, by_stiffness, 2 * self._white
        at = _GAIN
        for line, (unit, by_hz, by_width) in zip(self._guess.lines, self._lines, strict=True):
            power = np.square(line.rms_px)[:, None]
            own[at] = power * (by_hz * problem.resolution_hz)
            own[at + 1] = power * (by_width * line.half_width_hz)
            for axis in range(axes):
                own[at + 2 + axis, axis] = 2 * power[axis] * unit
            at += 2 + axes
        own /= self.density
        return own

    @functools.cached_property
    def _mirrors(self) -> Floats:
        """Of the periodograms, by the mirror's parameters, in parts of the spectrum: shape (2, axes, rows)."""
        slopes = self._problem.any_mirror.slopes(self._guess.gain, self._guess.overshoot)
        return slopes / self.density

    @property
    def gradient(self) -> Floats:
        """Of the cost."""
        weight = self._problem.weight
        pull = weight * (1 - self._ratio)
        own = self._own.reshape(len(self._own), -1) @ pull.ravel()
        mirrors = (self._mirrors @ weight).sum(axis=1)
        gradient = np.concatenate([own[:_GAIN], mirrors, own[_GAIN:]])
        return np.asarray(gradient + self._away / self._problem.hints)

    @property
    def information(self) -> Floats:
        """Fisher's, with what the mirror and the spectrum share."""
        problem = self._problem
        n = len(problem.begin)
        own = np.array([index for index in range(n) if not _GAIN <= index < _FIRST_LINE])
        mirrors = np.array([_GAIN, _OVERSHOOT])
        flat = self._own.reshape(len(own), -1)
        weighted = (self._own * problem.weight).reshape(len(own), -1)
        everything = np.empty((n, n))
        everything[np.ix_(own, own)] = weighted @ flat.T
        shared = -weighted @ self._mirrors.reshape(2, -1).T
        everything[np.ix_(own, mirrors)] = shared
        everything[np.ix_(mirrors, own)] = shared.T
        by_gain, by_both, by_overshoot = 2 * np.sum(
            problem.any_mirror.squares / self.density @ problem.weight, axis=-1
        )
        gain = self._guess.gain
        everything[np.ix_(mirrors, mirrors)] = [
            [gain**2 * by_gain, gain * by_both],
            [gain * by_both, by_overshoot],
        ]
        return everything + np.diag(1 / problem.hints**2)
