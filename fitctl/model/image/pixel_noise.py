"""Pixel noise as a function of frame and pixel, so that a part of a frame can be had without the rest.

A hash of a run's key, the frame's number and the pixel's index picks one of 65536 normal quantiles. The
simulation makes whole frames with it, the batch only the windows that it looks at, and both get the same.
"""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]
_TABLE_BITS = 16
GOLDEN = np.uint64(0x9E3779B97F4A7C15)
QUANTILE_SHIFT = np.uint64(64 - _TABLE_BITS)  # from a hash to the index of its quantile
_FACTOR1, _FACTOR2 = np.uint64(0xBF58476D1CE4E5B9), np.uint64(0x94D049BB133111EB)
_SHIFT1, _SHIFT2, _SHIFT3 = np.uint64(30), np.uint64(27), np.uint64(31)


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
    """Standard normals of one frame, shape (pixels,)."""
    return normals_of_frames(key, number, 1, pixels)[0]


def normals_of_frames(key: int, first: int, frames: int, pixels: int) -> Floats:
    """Standard normals of frames with consecutive numbers, shape (frames, pixels).

    The hash is SplitMix64's (Steele, Lea and Flood, OOPSLA 2014): of the frame's number with the run's
    key, then of the pixel's index with the result.
    """
    # Arrays, because they wrap at 64 bits without a warning.
    numbers = np.arange(first, first + frames, dtype=np.uint64)[:, None]
    frame = mix(np.array([key], np.uint64) + numbers * GOLDEN)
    index = np.arange(1, pixels + 1, dtype=np.uint64)
    return quantiles()[mix(frame + index * GOLDEN) >> QUANTILE_SHIFT]


@compilable(inline=True)
def mix(word: Any) -> Any:
    """SplitMix64's finalizer, of one 64-bit word or an array of them."""
    word = (word ^ (word >> _SHIFT1)) * _FACTOR1
    word = (word ^ (word >> _SHIFT2)) * _FACTOR2
    return word ^ (word >> _SHIFT3)
