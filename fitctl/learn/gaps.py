"""Fills unknown frames of a series from the frames beside them.

Straight lines do not serve where a vibration shakes the loop: of a line at 6 Hz, with frames at 50 Hz, they
miss a quarter, and then the mirror's estimated gain is too large.
"""

from __future__ import annotations

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray
from scipy.sparse.linalg import spsolve

Floats = NDArray[np.float64]
_ORDER = 60
_ROUNDS = 4
_AT_ONCE = 4096  # windows that are copied; all of a night's would need 60 times its memory
_ENOUGH = 2  # known frames for each coefficient; with fewer, straight lines have to do


def filled(values: Floats, known: NDArray[np.bool_]) -> Floats:
    """The series, with likely values for its unknown frames.

    Models each column as an autoregressive process, and finds its coefficients and the unknown values in turn,
    both so that the squares of the prediction's errors are least (Janssen, Veldhuis and Vries 1986, IEEE Trans.
    ASSP 34, 317). Adds random errors of the same size, the same for the same series: without them, these frames
    would lack the camera's noise.

    Parameters
    ----------
    values : array, shape (frames, columns)
        What unknown frames hold does not count.
    known : array of bool, shape (frames,)
    """
    if known.all():
        return values
    draw = np.random.default_rng(0)
    return np.column_stack([_filled(column, known, draw) for column in values.T])


def _filled(column: Floats, known: NDArray[np.bool_], draw: np.random.Generator) -> Floats:
    at, unknown_at = np.flatnonzero(known), np.flatnonzero(~known)
    mean = column[at].mean()
    guess = np.where(known, column, 0.0) - mean
    guess[unknown_at] = np.interp(unknown_at, at, guess[at])
    if len(at) <= _ENOUGH * _ORDER:
        return np.asarray(guess + mean)
    for _ in range(_ROUNDS):
        of_window = _of_window(guess)
        normal = _normal(of_window, unknown_at, len(guess))
        guess[unknown_at] = 0.0  # what the known ones have of the errors
        by_known = _gradient(of_window, guess)[unknown_at]
        guess[unknown_at] = spsolve(normal, -by_known)
    error = np.concatenate(_errors(of_window, guess))
    # The errors of unknown frames were made least: only those of known ones show how large they are.
    variance = error @ error / (len(error) * np.mean(known))
    # Twice, because each error counts forwards and backwards.
    spread = np.sqrt(2 * variance / normal.diagonal())
    guess[unknown_at] += spread * draw.normal(size=len(unknown_at))
    return np.asarray(guess + mean)


def _of_window(series: Floats) -> Floats:
    """Factors of `_ORDER` frames and the one after them in the error of its prediction."""
    windows = np.lib.stride_tricks.sliding_window_view(series, _ORDER + 1)
    products = np.zeros((_ORDER + 1, _ORDER + 1))
    for first in range(0, len(windows), _AT_ONCE):
        some = windows[first : first + _AT_ONCE].copy()
        products += some.T @ some
    weights = np.linalg.lstsq(products[:-1, :-1], products[:-1, -1], rcond=None)[0]
    return np.append(-weights, 1.0)


def _errors(of_window: Floats, series: Floats) -> tuple[Floats, Floats]:
    """The prediction's errors in each window of a series, from frames before and from frames after."""
    forwards, backwards = of_window[::-1], of_window  # a convolution turns them round
    return np.convolve(series, forwards, "valid"), np.convolve(series, backwards, "valid")


def _gradient(of_window: Floats, series: Floats) -> Floats:
    """How each frame of a series changes half the sum of the squared errors."""
    forwards, backwards = _errors(of_window, series)
    return np.convolve(forwards, of_window) + np.convolve(backwards, of_window[::-1])


def _normal(of_window: Floats, unknown_at: NDArray[np.intp], frames: int) -> sp.csc_matrix:
    """How the unknown frames change each other's :func:`_gradient`: those in one window, by what it sums up."""
    # Of both directions, by the frames' places in the window: sums over all windows that hold both frames.
    both = np.outer(of_window, of_window) + np.outer(of_window[::-1], of_window[::-1])
    sums = np.zeros((_ORDER + 1, _ORDER + 2))
    for lag in range(_ORDER + 1):
        sums[lag, 1 : _ORDER + 2 - lag] = np.cumsum(np.diagonal(both, lag))
    last = np.searchsorted(unknown_at, unknown_at + _ORDER, side="right")
    rows, columns, values = [], [], []
    for apart in range(int((last - np.arange(len(unknown_at))).max())):
        one = np.flatnonzero(np.arange(len(unknown_at)) + apart < last)
        first_at, second_at = unknown_at[one], unknown_at[one + apart]
        lags = second_at - first_at
        # Windows begin from 0 to frames - _ORDER - 1: the first frame's places in those that hold both.
        least = np.maximum(0, first_at - (frames - _ORDER - 1))
        most = np.minimum(_ORDER - lags, first_at)
        value = sums[lags, most + 1] - sums[lags, least]
        rows += [one, one + apart] if apart else [one]
        columns += [one + apart, one] if apart else [one]
        values += [value, value] if apart else [value]
    shape = (len(unknown_at), len(unknown_at))
    entries = np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))
    return sp.csc_matrix(entries, shape=shape)
