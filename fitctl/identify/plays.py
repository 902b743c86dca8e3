"""Models of parallel plays made from data: by Eq. 6 from a ramp, by least squares from any motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import lsq_linear

from fitctl.model.hysteresis import gains_from_slopes, play

Floats = NDArray[np.float64]
ELEMENTS = 13  # the paper: sufficient to reproduce the experiments
_LEAST_DENSITY = 0.3  # of the mean: breakpoints must not be missing where the loop hardly bends
_BEND_CHANGE = 0.3  # of the mean curvature, from one element to the next, one standard deviation
_LEAST_SLOPE = 0.05  # of the mean: a slope that is zero has no inverse


def model_from_ramp(volts: Floats, displacement_m: Floats) -> tuple[Floats, Floats]:
    """Eq. 6: half widths and gains from one rising full-scale ramp of each stack, relaxed before.

    Parameters
    ----------
    volts : array, shape (m,)
        Ascending; the ramp of all stacks.
    displacement_m : array, shape (..., m)
        Of one stack or of many.

    Returns
    -------
    half_widths_v : array, shape (n,)
    gains_m_per_v : array, shape (..., n)

    Notes
    -----
    The local slopes are those of the best piecewise linear curve, not differences of single readings.
    """
    risen_v = volts - volts[0]
    look_v = np.arange(ELEMENTS // 2 + 1) * risen_v[-1] / (ELEMENTS // 2 + 1)
    gains = gains_from_slopes(_ramp_slopes(risen_v, displacement_m, look_v))
    bend = np.abs(gains).reshape(-1, len(look_v)).mean(axis=0)
    half_widths_v = place_breakpoints(look_v, bend, float(risen_v[-1]))
    slopes = _ramp_slopes(risen_v, displacement_m, half_widths_v)
    return half_widths_v, gains_from_slopes(slopes)


def _ramp_slopes(risen_v: Floats, displacement_m: Floats, breakpoints_v: Floats) -> Floats:
    """Slopes s of Eq. 6 between breakpoints, shape (..., n)."""
    lengths = np.diff(breakpoints_v, append=np.inf)
    within = np.clip(risen_v[:, None] - breakpoints_v, 0.0, lengths)
    curves = displacement_m.reshape(-1, len(risen_v)).T
    constant = np.ones((len(risen_v), 1))
    solution, *_ = np.linalg.lstsq(np.hstack([within, constant]), curves, rcond=None)
    return np.asarray(
        solution[:-1].T.reshape(*displacement_m.shape[:-1], len(breakpoints_v)), float
    )


def place_breakpoints(at_v: Floats, bend: Floats, end_v: float, count: int = ELEMENTS) -> Floats:
    """Breakpoints from zero to below `end_v`, denser where the loop bends more.

    Parameters
    ----------
    at_v, bend : arrays, shape (m,)
        By how much the slope changes at each of some evenly spread voltages; the first, zero, where
        the curve begins, is not a bend.
    end_v : float
        The largest that could show.

    Notes
    -----
    Their density goes with the square root of curvature, which spreads the error of a piecewise linear
    curve evenly (de Boor, A Practical Guide to Splines, ch. III).
    """
    fine_v = np.linspace(0.0, end_v, 1001)
    # Between a number near the least that there is and zero, rounding makes less than zero.
    density = np.sqrt(np.maximum(0.0, np.interp(fine_v, at_v[1:], bend[1:])))
    density += max(float(density.mean()), np.finfo(float).tiny) * _LEAST_DENSITY
    share = np.append(0.0, np.cumsum((density[1:] + density[:-1]) / 2))
    # The last stands a little before the end: an element at the end would never move.
    return np.asarray(np.interp(np.arange(count) / (count - 0.75), share / share[-1], fine_v))


def trail(volts: Floats, half_widths_v: Floats) -> Floats:
    """Plays of relaxed stacks after each set of voltages: (m, stacks) to (m, stacks, n)."""
    state = np.zeros((volts.shape[1], len(half_widths_v)))
    states = np.empty((len(volts), *state.shape))
    for row, value in enumerate(volts):
        states[row] = state = play(state, value[:, None], half_widths_v)
    return states


class Fit(NamedTuple):
    """Constrained least squares.

    Attributes
    ----------
    gains : array, shape (stacks, n)
    covariance : array, shape (stacks * n, stacks * n)
        Of the gains; without regard to the constraint, so rather too large.
    excess : float
        RMS of the residual over what was expected.
    """

    gains: Floats
    covariance: Floats
    excess: float


def smoothness(half_widths_v: Floats, end_v: float, bend_m_per_v2: float) -> Floats:
    """Rows that ask neighbouring elements of one stack to bend alike, shape (n - 2, n).

    Elements so wide that a full swing hardly moves them are determined by little else. A row is the change of
    curvature over what is expected of it, so that it may stand below whitened measurements.

    Parameters
    ----------
    half_widths_v : array, shape (n,)
    end_v : float
        The largest half width that could move.
    bend_m_per_v2 : float
        Mean curvature of the stack's loop.
    """
    edges_v = (half_widths_v[1:] + np.append(half_widths_v[2:], end_v)) / 2
    shares_v = np.diff(edges_v, prepend=half_widths_v[1] / 2)
    bends = np.hstack([np.zeros((len(shares_v), 1)), np.diag(1 / shares_v)])
    return np.diff(bends, axis=0) / (_BEND_CHANGE * bend_m_per_v2)


def block_rows(of_stacks: list[Floats]) -> Floats:
    """Rows of each stack by itself, (p, n), as rows of all stacks together, shape (p * stacks, stacks, n)."""
    return np.concatenate(
        [
            rows[:, None, :] * np.eye(len(of_stacks))[stack, :, None]
            for stack, rows in enumerate(of_stacks)
        ]
    )


def fit_gains(plays: Floats, measured: Floats, prior: Floats) -> Fit:
    """Gains of many stacks from any rich motion; all their slopes come out positive.

    Parameters
    ----------
    plays : array, shape (m, stacks, n)
        What each element would add to each measurement with unit gain, over the measurement's noise.
    measured : array, shape (m,)
        Over its noise.
    prior : array, shape (p, stacks, n)
        Rows that should give zero, as `plays`.
    """
    stacks, n = plays.shape[1:]
    # Unknown are the slopes s = L k, because they are what must be positive: k = D s.
    to_gains = np.kron(np.eye(stacks), np.eye(n) - np.eye(n, k=-1))
    matrix = np.concatenate([plays, prior]).reshape(-1, stacks * n) @ to_gains
    scale = np.linalg.norm(matrix, axis=0)
    # The triangle of a QR has all that the rows say.
    orthogonal, triangle = np.linalg.qr(matrix / scale)
    projected = orthogonal[: len(plays)].T @ measured
    root = np.linalg.pinv(triangle) / scale[:, None]
    least = _LEAST_SLOPE * abs(float(np.mean(root @ projected)))
    bounds = (least * scale, np.inf)
    slopes = lsq_linear(triangle, projected, bounds, method="bvls").x / scale
    residual = measured - matrix[: len(plays)] @ slopes
    variance = residual @ residual / (len(plays) - len(slopes))
    root = to_gains @ root
    return Fit(
        gains_from_slopes(slopes.reshape(stacks, n)),
        variance * root @ root.T,
        float(np.sqrt(variance)),
    )
