"""Dots of braille characters: a canvas of booleans, and what is drawn on it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Dots = NDArray[np.bool_]

_BLANK = 0x2800
_WEIGHTS = np.array([[1, 8], [2, 16], [4, 32], [64, 128]])  # Unicode 2800: dots 1-8


def empty(rows: int, columns: int) -> Dots:
    """A canvas without dots: four dots a row, two a column."""
    return np.zeros((rows * 4, columns * 2), dtype=np.bool_)


def cells(dots: Dots) -> NDArray[np.int64]:
    """Code points of the characters that show `dots`; shape (rows, columns)."""
    rows, columns = dots.shape[0] // 4, dots.shape[1] // 2
    blocks = dots.reshape(rows, 4, columns, 2)
    return _BLANK + np.einsum("rycx,yx->rc", blocks.astype(np.int64), _WEIGHTS)


def envelope(
    dots: Dots,
    times_s: NDArray[np.float64],
    values: NDArray[np.float64],
    *,
    now_s: float,
    span_s: float,
    limit: float,
) -> None:
    """Draw a trace: in each column of dots, everything between its least and its greatest value.

    No peak is lost, however many samples share a column. Columns stand for fixed times, so that the
    trace moves left without shimmering. Values beyond ``±limit`` are drawn on the edge; not-a-number
    leaves a gap.

    Parameters
    ----------
    dots : bool array, shape (height, width)
        Drawn on in place.
    times_s, values : float arrays, shape (n,)
        Ascending times.
    """
    height, width = dots.shape
    bin_s = span_s / width
    column = np.floor(times_s / bin_s).astype(np.int64) - (int(np.floor(now_s / bin_s)) - width + 1)
    good = (column >= 0) & (column < width) & np.isfinite(values)
    if not good.any():
        return
    place = np.clip((1 - values[good] / limit) / 2 * (height - 1), 0, height - 1)
    row = np.rint(place).astype(np.int64)
    top = np.full(width, height)
    bottom = np.full(width, -1)
    np.minimum.at(top, column[good], row)
    np.maximum.at(bottom, column[good], row)
    seen = bottom >= 0
    joined = seen[1:] & seen[:-1]
    # A step between neighbouring columns is drawn as part of the later one.
    reach_up = np.where(joined, np.minimum(top[1:], bottom[:-1]), top[1:])
    reach_down = np.where(joined, np.maximum(bottom[1:], top[:-1]), bottom[1:])
    top[1:], bottom[1:] = reach_up, reach_down
    y = np.arange(height)[:, np.newaxis]
    dots |= (y >= top) & (y <= bottom)


def guide(dots: Dots, value: float, limit: float, every: int) -> None:
    """Draw a dotted horizontal line at `value`, one dot in `every`."""
    if abs(value) <= limit:
        dots[round((1 - value / limit) / 2 * (dots.shape[0] - 1)), ::every] = True


def diamond(rows: int, columns: int) -> Dots:
    """The outline ``|x| + |y| = 1`` over the whole canvas, with its centre marked."""
    dots = empty(rows, columns)
    height, width = dots.shape
    x = np.linspace(-1, 1, 8 * max(height, width))
    for sign in (-1, 1):
        y = sign * (1 - np.abs(x))
        dots[
            np.rint((1 - y) / 2 * (height - 1)).astype(int),
            np.rint((x + 1) / 2 * (width - 1)).astype(int),
        ] = True
    return dots
