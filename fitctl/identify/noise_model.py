"""Eq. 8 as a camera observes it: the exact likelihood of centroids.

The centroid is the air path at the frame's time plus white noise. The exposure's own average is left
out: at 10 ms it takes 0.1 % off a motion of 3 Hz, where the air path has all but ended.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_discrete_are
from scipy.signal import lfilter

from fitctl.config import AirPathModel
from fitctl.model import air_path

Floats = NDArray[np.float64]
_C = np.array([[1.0, 0.0]])


class _Innovations(NamedTuple):
    """The steady-state Kalman filter of air path and centroid noise, as what it leaves over.

    Attributes
    ----------
    numerator, denominator : arrays, shape (3,)
        From centroids to innovations.
    innovation_px2 : float
        Variance of the innovations.
    start : array, shape (2, 3)
        Numerators of the innovations' response to each state at the first frame.
    start_covariance : array, shape (2, 2)
        Of the state's prediction for the first frame from all that was before it.
    """

    numerator: Floats
    denominator: Floats
    innovation_px2: float
    start: Floats
    start_covariance: Floats

    def __call__(self, series: Floats) -> Floats:
        """Innovations of series that begin at rest; time is the first axis."""
        return np.asarray(lfilter(self.numerator, self.denominator, series, axis=0))


def _innovations(air: AirPathModel, noise_px: float, period_s: float) -> _Innovations:
    """From Eq. 8 with white centroid noise, sampled at the frame period."""
    a, _, _ = air_path.state_space(air)
    stationary = air_path.stationary_covariance(air)
    # What a step adds is what it forgets. Van Loan's method would lose all figures where a search tries a
    # pole that is much faster than the frames.
    transition = expm(a * period_s)
    added = stationary - transition @ stationary @ transition.T
    covariance = (added + added.T) / 2
    predicted = solve_discrete_are(transition.T, _C.T, covariance, [[noise_px**2]])
    innovation_px2 = float(predicted[0, 0] + noise_px**2)
    closed = transition - transition @ predicted @ _C.T @ _C / innovation_px2
    denominator = _characteristic(closed)
    first, second = _C[0], closed[0]
    return _Innovations(
        numerator=_characteristic(transition),
        denominator=denominator,
        innovation_px2=innovation_px2,
        start=np.column_stack([first, second + denominator[1] * first, np.zeros(2)]),
        start_covariance=stationary - predicted,
    )


def negative_log_likelihood(
    air: AirPathModel, noise_px: float, series_px: Floats, period_s: float
) -> float:
    """Exact, of independent series with unknown means, shape (frames, series).

    The mean is integrated out (restricted likelihood), so that removing it from a minute of slow motion
    costs no bias. The past before the first frame is one more unknown, of known covariance.
    """
    white = _innovations(air, noise_px, period_s)
    frames, count = series_px.shape
    impulse = np.zeros(frames)
    impulse[0] = 1.0
    unknowns = np.column_stack(
        [
            *(lfilter(numerator, white.denominator, impulse) for numerator in white.start),
            white(np.ones(frames)),
        ]
    )
    innovations = white(series_px)
    prior = np.zeros((3, 3))
    prior[:2, :2] = np.linalg.inv(white.start_covariance)
    information = unknowns.T @ unknowns / white.innovation_px2 + prior
    projected = unknowns.T @ innovations / white.innovation_px2
    square = np.sum(innovations**2) / white.innovation_px2 - np.sum(
        projected * np.linalg.solve(information, projected)
    )
    determinants = (
        frames * np.log(white.innovation_px2)
        + np.linalg.slogdet(information)[1]
        + np.linalg.slogdet(white.start_covariance)[1]
    )
    return float(0.5 * (square + count * determinants))


def _characteristic(matrix: Floats) -> Floats:
    """Coefficients of det(1 - matrix z^-1), shape (3,)."""
    return np.array([1.0, -np.trace(matrix), np.linalg.det(matrix)])
