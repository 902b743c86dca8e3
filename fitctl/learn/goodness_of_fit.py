"""Whether a model explains the spectrum that it was fitted to."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import kolmogorov

from fitctl.learn.opened import Opened

Floats = NDArray[np.float64]
AXES = ("az", "el")
SIGNIFICANT = 0.001
"""A model whose deviations would come by chance less often than this does not fit."""
ALLOWED_RATIO = 1.3
"""Of an octave's power to the model's, either way. A model of a real night is always a little wrong, and a long
record shows it: with a line of 0.05 px at 6 Hz, over wires, an octave had 0.81 to 1.16 times its power."""
ALLOWED_DISTANCE = 0.05
"""Of the cumulative periodogram from a straight line: what such a ratio in the fastest octaves makes of it."""
_BANDS_AN_OCTAVE = 1
_LEAST_BINS = 6  # of a band


class FitTest(NamedTuple):
    """Two tests of periodograms over the model, which should be exponential numbers of mean one.

    Attributes
    ----------
    cumulative : float
        Probability of a cumulative periodogram as far from a straight line (Kolmogorov and Smirnov; Bartlett),
        or 1 within `ALLOWED_DISTANCE`: notices what is wrong over wide bands of fast motion.
    band : float
        Probability of the worst of all octaves, their number allowed for, or 1 if all are within
        `ALLOWED_RATIO`: notices what is wrong where there are few frequencies, which is where the air is.
    worst : str
        The axis of that octave,
    low_hz, high_hz : float
        its ends,
    ratio : float
        and how much power it holds, in the model's.
    """

    cumulative: float
    band: float
    worst: str
    low_hz: float
    high_hz: float
    ratio: float

    @property
    def fits(self) -> bool:
        """Both tests find what chance would do."""
        return min(self.cumulative, self.band) >= SIGNIFICANT

    @property
    def text(self) -> str:
        """The verdict in words."""
        if self.fits:
            return f"the model fits (p = {min(self.cumulative, self.band):.2g})"
        why = "the cumulative spectrum deviates from a straight line"
        if self.band < SIGNIFICANT:
            why = (
                f"{self.worst} has {self.ratio:.2f} times the model's power from {self.low_hz:.2g} to "
                f"{self.high_hz:.2g} Hz"
            )
        return f"the model does not fit (p = {min(self.cumulative, self.band):.1g}): {why}"


def fit_test(opened: Opened, density: Floats, gain: float, overshoot: float) -> FitTest:
    """Test a model's density, shape (rows, axes), with a mirror that moves so."""
    ratios = opened.with_mirror(gain, overshoot) / density
    weight = opened.segments / opened.inflation
    cumulative = []
    for ratio in ratios.T:
        running = np.cumsum(opened.segments * ratio)
        straight = np.cumsum(opened.segments)
        distance = np.abs(running / running[-1] - straight / straight[-1]).max()
        by_chance = float(kolmogorov(distance * np.sqrt(weight.sum())))
        cumulative.append(1.0 if distance <= ALLOWED_DISTANCE else by_chance)
    found = []
    octaves = np.floor(np.log2(opened.frequency_hz) * _BANDS_AN_OCTAVE)
    for octave in np.unique(octaves):
        inside = octaves == octave
        if np.count_nonzero(inside) < _LEAST_BINS:
            continue
        count = float(weight[inside].sum())
        for axis, ratio in zip(AXES, ratios.T, strict=False):
            mean = float(np.average(ratio[inside], weights=weight[inside]))
            deviance = 2 * count * (mean - 1 - np.log(mean))
            ends = opened.frequency_hz[inside]
            by_chance = math.erfc(math.sqrt(deviance / 2))  # chi squared of one degree
            allowed = 1 / ALLOWED_RATIO <= mean <= ALLOWED_RATIO
            found.append((allowed, by_chance, axis, float(ends[0]), float(ends[-1]), mean))
    worst = min(found)
    allowed, by_chance = worst[:2]
    probability = 1.0 if allowed else min(1.0, by_chance * len(found))
    return FitTest(min(1.0, len(cumulative) * min(cumulative)), probability, *worst[2:])
