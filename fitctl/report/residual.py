"""The residual with its confidence, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

CONFIDENCE = 0.95
WIDEST = 3.0
"""No interval is reported whose ends differ by more than this: so short a record may not hold all there is."""
LEAST_MEASURED_FRACTION = 0.98
BATCHES = 10
_LEAST_FRAMES = 2 * BATCHES
_AT_REST_BINS = 4  # the lowest frequencies, which show what noise there is at none

Word = Literal["met", "not met", "not known"]


class Estimate(NamedTuple):
    """An RMS with its 95 % confidence interval.

    Attributes
    ----------
    rms : float
        In the unit of the values; nan without data.
    low, high : float
        nan where the record is too short for an interval.
    independent : float
        So many independent values would leave the RMS as uncertain; nan without data.
    """

    rms: float
    low: float
    high: float
    independent: float

    @property
    def known(self) -> bool:
        """Whether there is an interval."""
        return not math.isnan(self.high)


class Verdict(NamedTuple):
    """Whether a requirement is met, and why."""

    word: Word
    why: str


def rms_estimate(error: Floats) -> Estimate:
    """RMS about zero of one axis' error, with an interval that knows that neighbouring frames are alike.

    Two methods say how uncertain the mean square is, and the wider one counts, by Student's t on the logarithm,
    which keeps the interval positive: :func:`_by_spectrum`, which sees slow motion but takes it for Gaussian
    and steady, and :func:`_by_batches`, which takes nothing for granted but sees nothing slower than a batch.

    Parameters
    ----------
    error : array, shape (frames,)
        Of any unit; evenly sampled; pieces of a record end to end.
    """
    from scipy.fft import prev_fast_len

    # Student's t; scipy.stats has it too, and takes half a second to import.
    from scipy.special import stdtrit

    error = np.asarray(error, dtype=float)
    if len(error) == 0:
        return Estimate(math.nan, math.nan, math.nan, math.nan)
    rms = math.sqrt(np.mean(error**2))
    # To transform other lengths takes ten times the room.
    whole = error[: prev_fast_len(len(error), real=True)]
    if len(error) < _LEAST_FRAMES or whole.min() == whole.max():
        return Estimate(rms, math.nan, math.nan, math.nan)
    found = (_by_spectrum(whole), _by_batches(error))
    independent = 2 / max(variance for variance, _ in found)
    # ln RMS is half of ln square.
    half = max(stdtrit(freedom, (1 + CONFIDENCE) / 2) * math.sqrt(v) / 2 for v, freedom in found)
    if 2 * half > math.log(WIDEST):
        return Estimate(rms, math.nan, math.nan, independent)
    factor = math.exp(half)
    return Estimate(rms, rms / factor, rms * factor, independent)


def _by_spectrum(error: Floats) -> tuple[float, float]:
    """Relative variance of the mean square, and the degrees of freedom with which it is known.

    Each frequency of the periodogram is an independent chi-square of two degrees of freedom, so that half its
    square estimates its variance, and five times the sum of the fourth powers over 24 the variance of that.
    (Bendat and Piersol, Random Data, section 8.2: the mean square's error goes with the integral of the squared
    spectrum; the degrees are Satterthwaite's.) At frequency zero nothing distinguishes noise from a
    steady offset: its noise is that of the lowest frequencies, and adds with what is there as in a product.

    The degrees of freedom are halved. From one record alone slow motion looks quicker than it is, and by as
    much did trials fall short (tests/report/test_residual.py, docs/measurements.md).
    """
    from scipy.fft import rfft

    power = np.abs(rfft(error) / len(error)) ** 2
    at_rest, moving = float(power[0]), 2 * power[1:]
    noise_at_rest = float(moving[:_AT_REST_BINS].mean()) / 2
    squares = float(np.sum(moving**2)) / 2
    variance = (squares + 4 * at_rest * noise_at_rest) / (at_rest + float(moving.sum())) ** 2
    freedom = 2 * squares**2 / (5 * float(np.sum(moving**4)) / 24)
    return variance, max(1.0, freedom / 2)


def _by_batches(error: Floats) -> tuple[float, float]:
    """The same from the spread of the mean squares of a few long batches."""
    length = len(error) // BATCHES
    means = np.mean(error[: BATCHES * length].reshape(BATCHES, length) ** 2, axis=1)
    return float(means.var(ddof=1) / means.mean() ** 2) / BATCHES, BATCHES - 1.0


def verdict(
    axes: dict[str, Estimate],
    requirement: float,
    evaluated_s: float,
    measured_fraction: float,
    *,
    mode: str = "VERNIER",
    of: str = "star",
) -> Verdict:
    """Whether both axes stay within the requirement; never "met" without data that say so.

    `mode` is the mode in which a loop is evaluated, and `of` is what the loop holds: for the text.
    """
    if evaluated_s <= 0:
        return Verdict("not known", f"no time in {mode} can be evaluated")
    above = [axis for axis, found in axes.items() if found.known and found.low > requirement]
    if above:
        return Verdict("not met", f"the whole interval of {' and '.join(above)} is above it")
    if measured_fraction < LEAST_MEASURED_FRACTION:
        missing = 100 * (1 - measured_fraction)
        return Verdict(
            "not known", f"the {of} is missing on {missing:.1f} % of the evaluated frames"
        )
    few = [axis for axis, found in axes.items() if not found.known]
    if few:
        return Verdict(
            "not known",
            f"too short to judge: the {evaluated_s:.3g} s evaluated have too few independent values of the "
            f"error in {' and '.join(few)} for an interval",
        )
    if all(found.high <= requirement for found in axes.values()):
        return Verdict("met", "the whole intervals of both axes are within it")
    return Verdict("not known", "the interval contains the requirement; more data are needed")


def night_verdict(words: Sequence[Word]) -> Word:
    """Of all loops together: as good as the worst."""
    for word in ("not met", "not known"):
        if word in words:
            return word
    return "met" if words else "not known"
