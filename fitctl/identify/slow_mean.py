"""The mean of what the air moves: how far it can be trusted when frames are not independent."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from fitctl.config import AirPathModel
from fitctl.model import air_path

Floats = NDArray[np.float64]
_NOISES = np.logspace(-4, 4, 65)  # variance of the white part over that of the slow part
_LAGS = 2000


class SlowMean(NamedTuple):
    """Mean and its standard deviation, each of shape (axes,)."""

    mean: Floats
    sd: Floats


def slow_mean(time_s: Floats, series: Floats, air: AirPathModel) -> SlowMean:
    """Mean of a motion with the spectrum of Eq. 8 and white noise, by generalized least squares.

    How much there is of both is found from the series themselves, by restricted maximum likelihood.

    Parameters
    ----------
    time_s : array, shape (n,)
    series : array, shape (n, axes)
        Alike in how much of each they have.
    air : AirPathModel
        Its time constants count; its gain does not.
    """
    lag_s = np.abs(time_s[:, None] - time_s)
    values, vectors = np.linalg.eigh(correlation(lag_s, air))
    ones, turned = vectors.sum(axis=0), vectors.T @ series
    frames, axes = series.shape
    best, found = -np.inf, None
    for noise in _NOISES:
        weight = 1.0 / (np.maximum(values, 0.0) + noise)
        information = float(np.sum(weight * ones**2))
        mean = (weight * ones) @ turned / information
        left = turned - ones[:, None] * mean
        degrees = axes * (frames - 1)
        variance = float(np.sum(weight[:, None] * left**2)) / degrees
        likelihood = -0.5 * (
            degrees * np.log(variance) - axes * (np.sum(np.log(weight)) - np.log(information))
        )
        if likelihood > best:
            best, found = likelihood, SlowMean(mean, np.full(axes, np.sqrt(variance / information)))
    assert found is not None  # noqa: S101  # one of many finite likelihoods is the largest
    return found


def correlation(lag_s: Floats, air: AirPathModel) -> Floats:
    """Of Eq. 8's motion with itself, some time later; 1 at once."""
    a, _, c = air_path.state_space(air)
    covariance = air_path.stationary_covariance(air)
    step_s = float(lag_s.max()) / _LAGS
    transition, _ = air_path.discretize(a, np.zeros((2, 2)), step_s)
    state, correlations = covariance @ c[0], []
    for _ in range(_LAGS + 1):
        correlations.append(c[0] @ state)
        state = transition @ state
    grid_s = step_s * np.arange(_LAGS + 1)
    return np.interp(lag_s, grid_s, np.array(correlations) / covariance[0, 0])
