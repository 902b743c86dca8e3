"""A night, estimated: air path, noise, gain and lines, with intervals and a test of fit.

Telemetry-based controllers of adaptive optics (Meimon et al., JOSA A 27, A122, 2010; Petit et al., SPIE 9148,
91480O, 2014; Sivo et al., Optics Express 22, 23565, 2014) estimate turbulence and lines from the rebuilt open
loop, one after the other. Here they are estimated together: a line that is left in the data makes the air
look five times as strong. A line is accepted only if it explains the data better than chance, by a
criterion that charges for the search over all frequencies.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import ValidationError
from scipy.ndimage import uniform_filter1d

from fitctl.config import AirPathModel, ConfigError
from fitctl.controllers.design.basis import Line
from fitctl.controllers.design.linear_loop.spectrum import air_of, seen_at_hz
from fitctl.learn.goodness_of_fit import FitTest, fit_test
from fitctl.learn.intervals import Z_95, Interval, of_logarithm
from fitctl.learn.opened import Opened
from fitctl.learn.whittle import (
    BROADEST,
    Guess,
    Likeliest,
    LineGuess,
    likeliest,
)

Floats = NDArray[np.float64]
MOST_LINES = 8
LEAST_LINE_HZ = 0.3
"""Slower motion counts as air or drift: minutes of frames cannot distinguish them from a line."""
_WIDTHS = (1, 3, 9, 27)  # in frequencies: over which a line may spread
_ABOUT_BINS = 3
_STRENGTH, _DAMPING, _STIFFNESS, _NOISE, _GAIN, _OVERSHOOT, _FIRST_LINE = range(7)


class LearntLine(NamedTuple):
    """A vibration that was found.

    Attributes
    ----------
    frequency_hz, half_width_hz : Interval
        The half width at half power; its lower end is 0 where the segments are too short to resolve it.
    rms_px : tuple of Interval
        For each axis.
    aliases_hz : tuple of float
        Faster lines that look the same on frames: only another frame rate distinguishes them.
    """

    frequency_hz: Interval
    half_width_hz: Interval
    rms_px: tuple[Interval, ...]
    aliases_hz: tuple[float, ...]

    @property
    def for_design(self) -> Line:
        """As a design counts with it: the axis where it is stronger, and a width that allows for its interval.

        One design serves both axes. It may miss a line that is narrower than its frequency is known.
        """
        half_width_hz = max(
            self.half_width_hz.value,
            (self.frequency_hz.high - self.frequency_hz.low) / 2,
        )
        return Line(
            frequency_hz=self.frequency_hz.value,
            damping=min(half_width_hz / self.frequency_hz.value, BROADEST),
            rms_px=max(rms.value for rms in self.rms_px),
        )


class Night(NamedTuple):
    """What a loop's own records show of its night.

    Attributes
    ----------
    gain_px, b1_s2, b2_s : Interval
        Eq. 8. They err together; their ratios below are known much better.
    strength : Interval
        k / b1, px/s²: the fast motion, which control is about.
    fast_pole : Interval
        b2 / b1, 1/s.
    noise_px : Interval
        One standard deviation of a frame, white.
    mirror_gain : Interval
        How far the mirror moves, in what the rig file says.
    overshoot : Interval
        At mid-exposure, how far the mirror is beyond its last step, as a part of it: its mount rings. Below
        zero it is short of it: commands come later than the rig file says, by so many frames.
    lines : tuple of LearntLine
        Strongest first.
    test : FitTest
    duration_s : float
        Of what was evaluated.
    """

    gain_px: Interval
    b1_s2: Interval
    b2_s: Interval
    strength: Interval
    fast_pole: Interval
    noise_px: Interval
    mirror_gain: Interval
    overshoot: Interval
    lines: tuple[LearntLine, ...]
    test: FitTest
    duration_s: float

    @property
    def air_path(self) -> AirPathModel:
        """The estimates as designs want them."""
        return AirPathModel(
            gain_px=self.gain_px.value, b1_s2=self.b1_s2.value, b2_s=self.b2_s.value
        )


def estimate(opened: Opened, expected: AirPathModel, noise_px: float) -> Night:
    """The likeliest night.

    Parameters
    ----------
    opened : Opened
    expected : AirPathModel
        Where the search begins,
    noise_px : float
        with the sensor's noise.

    Raises
    ------
    ConfigError
        If no air path explains the frames, such as those of a star that stands still.
    """
    # Lines first, with the mirror as the rig file has it: it would explain a line that the model lacks. Then
    # with the mirror free, lines that explained the mirror are no longer worth their price.
    first = Guess(air_of(expected), noise_px)
    found = likeliest(opened, first, free_mirror=False)
    found = _with_more_lines(opened, found, first, free_mirror=False)
    found = likeliest(opened, found.guess)
    found = _without_needless_lines(opened, found)
    found = _with_more_lines(opened, found, first, free_mirror=True)
    return _night(opened, found)


def guess_of(night: Night, places_hz: Iterable[tuple[LearntLine, float]]) -> Guess:
    """The spectrum of a night, with these of its lines, each at its place; one may be at several."""
    return Guess(
        air_of(night.air_path),
        night.noise_px.value,
        night.mirror_gain.value,
        night.overshoot.value,
        tuple(
            LineGuess(hz, line.half_width_hz.value, np.array([rms.value for rms in line.rms_px]))
            for line, hz in places_hz
        ),
    )


def estimate_with_aliases(opened: Opened, night: Night, at_hz: Mapping[LearntLine, float]) -> Night:
    """The likeliest night near another, with its lines where they are, some above half the frame rate.

    Frames show their tails otherwise than those of a slow line, for which air, mirror and noise make up.
    Raises as :func:`estimate` does.
    """
    return _night(opened, likeliest(opened, guess_of(night, at_hz.items())))


def _with_more_lines(
    opened: Opened, found: Likeliest, first: Guess, *, free_mirror: bool
) -> Likeliest:
    """One line after the other, as long as each is worth its price."""
    refused: list[float] = []
    while len(found.guess.lines) < MOST_LINES:
        line = _candidate(opened, found, refused)
        if line is None:
            break
        guess = found.guess._replace(lines=(*found.guess.lines, line))
        # Without this line, fast air may explain it best; a search that begins there may not come back.
        begins = (guess, guess._replace(air=first.air, noise_px=first.noise_px))
        more = min(
            (likeliest(opened, begin, free_mirror=free_mirror) for begin in begins),
            key=lambda end: end.cost,
        )
        newest = more.guess.lines[-1]
        if found.cost - more.cost < _price(opened):
            break
        if newest.half_width_hz > 0.98 * BROADEST * newest.frequency_hz:
            # No line, but something broad that the model lacks; the test of fit reports it.
            refused.append(line.frequency_hz)
            continue
        found = more
    return found


def _without_needless_lines(opened: Opened, found: Likeliest) -> Likeliest:
    """Take lines away, newest first, whose absence costs less than their price."""
    for number in reversed(range(len(found.guess.lines))):
        lines = found.guess.lines
        kept = lines[:number] + lines[number + 1 :]
        less = likeliest(opened, found.guess._replace(lines=kept))
        if less.cost - found.cost < _price(opened):
            found = less
    return found


def _price(opened: Opened) -> float:
    """By how much a line must lower the cost: the Bayesian information criterion.

    A line's frequency counts three times: it is known better the longer the record is, by its third power
    (Djuric, IEEE Trans. Signal Processing 44, 1744, 1996).
    """
    rows, axes = opened.disturbance.shape
    parameters = 3 + 1 + axes
    return 0.5 * parameters * math.log(rows * axes)


def _candidate(opened: Opened, found: Likeliest, refused: list[float]) -> LineGuess | None:
    """Where the data exceed the model most clearly, for a line of any width."""
    hz = opened.frequency_hz
    excess = opened.with_mirror(found.guess.gain, found.guess.overshoot) / found.density
    allowed = hz >= LEAST_LINE_HZ
    for refused_hz in refused:
        allowed &= np.abs(hz / refused_hz - 1) > 2 * BROADEST
    if not allowed.any():
        return None
    best, at, spread = -math.inf, 0, 1
    weight = opened.segments / opened.inflation
    for width in _WIDTHS:
        mean = np.maximum(uniform_filter1d(excess, width, axis=0), 1.0)
        clear = width * weight * (mean - 1 - np.log(mean)).sum(axis=1)
        clear[~allowed] = -math.inf
        top = int(clear.argmax())
        if clear[top] > best:
            best, at, spread = float(clear[top]), top, width
    about = np.abs(hz - hz[at]) <= (_ABOUT_BINS + spread / 2) * 2 * opened.resolution_hz[at]
    more = (excess - 1) * found.density
    # Rows of segments of several lengths lie between each other: mean over them, times the band.
    band_hz = float(np.ptp(hz[about])) if np.count_nonzero(about) > 1 else opened.resolution_hz[at]
    power = np.maximum(more[about].mean(axis=0) * band_hz, 0.0)
    return LineGuess(
        frequency_hz=float(hz[at]),
        half_width_hz=float(spread * opened.resolution_hz[at] / 2),
        rms_px=np.sqrt(np.maximum(power, 0.01 * power.max() + 1e-12)),
    )


def _night(opened: Opened, found: Likeliest) -> Night:
    guess, covariance = found.guess, found.covariance
    axes = opened.disturbance.shape[1]
    logs = np.log([*guess.air, guess.noise_px, guess.gain])

    def combined(**parts: float) -> Interval:
        """Of a product of powers of the first parameters."""
        weights = np.zeros(len(covariance))
        for name, part in parts.items():
            weights[_INDEX[name]] = part
        deviation = math.sqrt(weights @ covariance @ weights)
        return of_logarithm(float(weights[:_OVERSHOOT] @ logs), deviation)

    half = Z_95 * math.sqrt(covariance[_OVERSHOOT, _OVERSHOOT])
    lines = [
        _learnt(opened, line, covariance[at : at + 2 + axes, at : at + 2 + axes])
        for number, line in enumerate(guess.lines)
        for at in [_FIRST_LINE + number * (2 + axes)]
    ]
    lines.sort(key=lambda line: -max(rms.value for rms in line.rms_px))
    night = Night(
        gain_px=combined(strength=1, stiffness=-1),
        b1_s2=combined(stiffness=-1),
        b2_s=combined(damping=1, stiffness=-1),
        strength=combined(strength=1),
        fast_pole=combined(damping=1),
        noise_px=combined(noise=1),
        mirror_gain=combined(gain=1),
        overshoot=Interval(guess.overshoot, guess.overshoot - half, guess.overshoot + half),
        lines=tuple(lines),
        test=fit_test(opened, found.density, guess.gain, guess.overshoot),
        duration_s=opened.duration_s,
    )
    try:
        _ = night.air_path
    except ValidationError:
        msg = (
            f"learn: no air path explains these frames: gain {night.gain_px.value:.4g} px, b1 "
            f"{night.b1_s2.value:.4g} s², b2 {night.b2_s.value:.4g} s; expected a star that air moves, on "
            "frames with noise; look at the error with fitctl plot"
        )
        raise ConfigError(msg) from None
    return night


_INDEX = {
    "strength": _STRENGTH,
    "damping": _DAMPING,
    "stiffness": _STIFFNESS,
    "noise": _NOISE,
    "gain": _GAIN,
}


def _learnt(opened: Opened, line: LineGuess, covariance: Floats) -> LearntLine:
    deviations = np.sqrt(np.diag(covariance))
    half_hz = Z_95 * float(deviations[0])
    width = of_logarithm(math.log(line.half_width_hz), float(deviations[1]))
    if line.half_width_hz < opened.resolution_hz.min() / 2:
        # The segments show no more than that it is narrower than this.
        width = Interval(
            line.half_width_hz, 0.0, max(width.high, float(opened.resolution_hz.min()))
        )
    rate_hz = 1 / opened.period_s
    seen_hz = seen_at_hz(line.frequency_hz, rate_hz)
    return LearntLine(
        Interval(seen_hz, seen_hz - half_hz, seen_hz + half_hz),
        width,
        tuple(
            of_logarithm(math.log(rms), float(deviation))
            for rms, deviation in zip(line.rms_px, deviations[2:], strict=True)
        ),
        (rate_hz - seen_hz, rate_hz + seen_hz),
    )
