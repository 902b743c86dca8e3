"""The residual with its confidence, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating]

CONFIDENCE = 0.95
FIRST_BLOCK_S = 1.0
LEAST_BLOCKS = 10
LEAST_STAR_FRACTION = 0.98
_LEAST_INDEPENDENT = 2.0
_MOST_ALIKE = 0.99
_Z_ONE_SIDED = 1.645  # a correlation of blocks beyond this is none of chance

Word = Literal["met", "not met", "not known"]


class Estimate(NamedTuple):
    """An RMS with its 95 % confidence interval.

    Attributes
    ----------
    rms_px : float
        nan without data.
    low_px, high_px : float
        nan where there are too few independent blocks to tell.
    blocks : float
        Independent ones,
    block_s : float
        and how long each is.
    """

    rms_px: float
    low_px: float
    high_px: float
    blocks: float
    block_s: float

    @property
    def known(self) -> bool:
        """Whether there is an interval."""
        return not math.isnan(self.high_px)


class Verdict(NamedTuple):
    """Whether a requirement is met, and why it is said."""

    word: Word
    why: str


def rms_estimate(pieces: Sequence[Floats], period_s: float) -> Estimate:
    """RMS of one axis' error with an interval that knows that neighbouring frames are alike.

    Method of batch means: the mean squares of blocks, at first of `FIRST_BLOCK_S`, are doubled in length until
    neighbouring blocks no longer correlate, or too few would be left; then they count for fewer. Their spread
    tells the uncertainty of their mean, by Student's t on the logarithm, which keeps the interval positive.
    (Law, Simulation Modeling and Analysis, "batch means"; the doubling is Fishman's, 1978.)

    Parameters
    ----------
    pieces : sequence of array, shape (frames,)
        px; frames within a piece follow each other. What fills no block does not count for the interval.
    """
    from scipy.stats import t  # half a second of import

    pieces = [np.asarray(piece, dtype=float) ** 2 for piece in pieces if len(piece)]
    if not pieces:
        return Estimate(math.nan, math.nan, math.nan, 0, FIRST_BLOCK_S)
    rms_px = math.sqrt(np.concatenate(pieces).mean())
    block_s = FIRST_BLOCK_S
    means, alike = _block_means(pieces, block_s, period_s)
    while alike > _Z_ONE_SIDED / math.sqrt(max(1, len(means))):
        longer = _block_means(pieces, 2 * block_s, period_s)
        if len(longer[0]) < LEAST_BLOCKS:
            break
        block_s, (means, alike) = 2 * block_s, longer
    # What resemblance is left, though it may be chance, takes away from what the blocks tell.
    alike = min(max(alike, 0.0), _MOST_ALIKE)
    independent = len(means) * (1 - alike) / (1 + alike)
    if len(means) < LEAST_BLOCKS or independent < _LEAST_INDEPENDENT or not means.mean() > 0:
        return Estimate(rms_px, math.nan, math.nan, independent, block_s)
    spread = float(means.std(ddof=1) / means.mean()) / math.sqrt(independent)
    half = (
        float(t.ppf((1 + CONFIDENCE) / 2, independent - 1)) * spread / 2
    )  # ln RMS is half of ln square
    return Estimate(rms_px, rms_px * math.exp(-half), rms_px * math.exp(half), independent, block_s)


def _block_means(pieces: Sequence[Floats], block_s: float, period_s: float) -> tuple[Floats, float]:
    """Means of whole blocks, and by how much neighbours in one piece correlate."""
    frames = max(1, round(block_s / period_s))
    of_pieces = [
        piece[: len(piece) // frames * frames].reshape(-1, frames).mean(axis=1) for piece in pieces
    ]
    means = np.concatenate(of_pieces)
    if len(means) < LEAST_BLOCKS:
        return means, 0.0
    deviations = [one - means.mean() for one in of_pieces]
    variance = float(np.mean(np.concatenate(deviations) ** 2))
    products = np.concatenate([one[1:] * one[:-1] for one in deviations])
    return means, float(products.mean()) / variance if len(products) and variance > 0 else 0.0


def verdict(
    axes: dict[str, Estimate], requirement_px: float, judged_s: float, star_fraction: float
) -> Verdict:
    """Whether both axes stay within the requirement; never "met" without data that say so."""
    if judged_s <= 0:
        return Verdict("not known", "no time in VERNIER counts")
    above = [axis for axis, found in axes.items() if found.known and found.low_px > requirement_px]
    if above:
        return Verdict("not met", f"{' and '.join(above)}: all of the interval is above it")
    if star_fraction < LEAST_STAR_FRACTION:
        missing = 100 * (1 - star_fraction)
        return Verdict(
            "not known", f"the star is missing on {missing:.1f} % of the frames that count"
        )
    few = [axis for axis, found in axes.items() if not found.known]
    if few:
        return Verdict(
            "not known",
            f"{judged_s:.0f} s count, which is too little: an interval needs {LEAST_BLOCKS} blocks of "
            f"{FIRST_BLOCK_S:g} s or more that do not all resemble their neighbours",
        )
    if all(found.high_px <= requirement_px for found in axes.values()):
        return Verdict("met", "both axes: all of the interval is within it")
    return Verdict("not known", "the interval holds the requirement; more data would tell")


def night_verdict(words: Sequence[Word]) -> Word:
    """Of all loops together: as good as the worst."""
    for word in ("not met", "not known"):
        if word in words:
            return word
    return "met" if words else "not known"
