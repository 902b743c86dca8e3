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
        errors = _prediction_errors(guess)
        of_unknown, of_known = errors[:, unknown_at], errors[:, at]
        normal = (of_unknown.T @ of_unknown).tocsc()
        guess[unknown_at] = spsolve(normal, -(of_unknown.T @ (of_known @ guess[at])))
    error = errors @ guess
    # The errors of unknown frames were made least: only those of known ones show how large they are.
    variance = error @ error / (len(error) * np.mean(known))
    # Twice, because each error counts forwards and backwards.
    spread = np.sqrt(2 * variance / normal.diagonal())
    guess[unknown_at] += spread * draw.normal(size=len(unknown_at))
    return np.asarray(guess + mean)


def _prediction_errors(series: Floats) -> sp.csc_matrix:
    """The matrix that turns a series into its prediction errors, from frames before and from frames after."""
    windows = np.lib.stride_tricks.sliding_window_view(series, _ORDER + 1)
    before, last = windows[:, :-1], windows[:, -1]
    weights = np.linalg.lstsq(before.T @ before, before.T @ last, rcond=None)[0]
    of_window = np.append(-weights, 1.0)
    shape = (len(windows), len(series))
    both = [
        sp.diags(list(each), range(_ORDER + 1), shape=shape)
        for each in (of_window, of_window[::-1])
    ]
    return sp.vstack(both).tocsc()
