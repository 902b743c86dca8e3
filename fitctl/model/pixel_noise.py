"""Pixel noise as a function of frame and pixel, so that a part of a frame can be had without the rest.

A hash of a run's key, the frame's number and the pixel's index picks one of 65536 normal quantiles. The
simulation makes whole frames with it, the batch only the windows that it looks at, and both get the same.
"""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Floats = NDArray[np.float64]
_TABLE_BITS = 16
_GOLDEN = 0x9E3779B97F4A7C15
_WORD = 2**64 - 1


@functools.cache
def quantiles() -> Floats:
    """Normal quantiles at the middles of 65536 equal probabilities, scaled to unit variance.

    The farthest is 4.32 standard deviations out: noise alone never passes that.
    """
    middles = (np.arange(2**_TABLE_BITS) + 0.5) / 2**_TABLE_BITS
    values = ndtri(middles)
    values /= values.std()
    values.flags.writeable = False
    return values


def noise_key(seeds: np.random.SeedSequence) -> int:
    """A run's key, 64 bit."""
    return int(seeds.generate_state(1, np.uint64)[0])


def pixel_normals(key: int, number: int, pixels: int) -> Floats:
    """Standard normals of one frame, shape (pixels,).

    The hash is SplitMix64's (Steele, Lea and Flood, OOPSLA 2014): of the frame's number with the run's
    key, then of the pixel's index with the result.
    """
    frame = _mix(np.array([(key + number * _GOLDEN) & _WORD], np.uint64))
    index = np.arange(1, pixels + 1, dtype=np.uint64)
    bits = _mix(frame + index * np.uint64(_GOLDEN))
    return quantiles()[bits >> np.uint64(64 - _TABLE_BITS)]


def _mix(word: NDArray[np.uint64]) -> NDArray[np.uint64]:
    word = (word ^ (word >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    word = (word ^ (word >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return word ^ (word >> np.uint64(31))
