"""Dots of braille characters: a canvas of booleans, and what is drawn on it."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from fitctl.tui.look import Line, text

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


def layered(layers: Sequence[tuple[Dots, str]]) -> list[Line]:
    """Lines of several canvases over each other; a cell has the colour of the last layer that has a dot in it.

    Parameters
    ----------
    layers : sequence of (bool array, shape (4 rows, 2 columns)), and colour
        All of one shape, the lowest first.
    """
    codes = np.full((layers[0][0].shape[0] // 4, layers[0][0].shape[1] // 2), _BLANK)
    owner = np.zeros_like(codes)
    for number, (dots, _) in enumerate(layers):
        own = cells(dots)
        owner[own != _BLANK] = number
        codes |= own
    lines: list[Line] = []
    for row, owners in zip(codes.tolist(), owner.tolist(), strict=True):
        line: Line = []
        start = 0
        for x in range(1, len(row) + 1):
            if x == len(row) or owners[x] != owners[start]:
                line.append(text("".join(map(chr, row[start:x])), layers[owners[start]][1]))
                start = x
        lines.append(line)
    return lines


def meeting(one: Dots, other: Dots) -> Dots:
    """The dots of two canvases in those characters in which both have some."""
    both = (cells(one) != _BLANK) & (cells(other) != _BLANK)
    return (one | other) & both.repeat(4, axis=0).repeat(2, axis=1)


def scatter(dots: Dots, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Set dots at places from 0 to 1, shape (n,) each, y upwards; what lies outside is left out."""
    height, width = dots.shape
    with np.errstate(invalid="ignore"):
        inside = (x >= 0) & (x <= 1) & (y >= 0) & (y <= 1)
    column = np.rint(x[inside] * (width - 1)).astype(np.int64)
    row = np.rint((1 - y[inside]) * (height - 1)).astype(np.int64)
    dots[row, column] = True


def polyline(dots: Dots, x: NDArray[np.float64], y: NDArray[np.float64]) -> None:
    """Join places from 0 to 1, shape (n,) each, by straight lines; not-a-number leaves a gap."""
    if len(x) < 2:
        scatter(dots, x, y)
        return
    steps = 2 * max(dots.shape)
    between = np.linspace(0.0, 1.0, steps)
    length = np.hypot(np.diff(x), np.diff(y))
    for index in np.flatnonzero(np.isfinite(length)):
        part = between[:: max(1, int(1 / max(float(length[index]), 1 / steps)))]
        ends = np.append(part, 1.0)
        scatter(
            dots,
            x[index] + ends * (x[index + 1] - x[index]),
            y[index] + ends * (y[index + 1] - y[index]),
        )


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
    filled = bottom >= 0
    joined = filled[1:] & filled[:-1]
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
