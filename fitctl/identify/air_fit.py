"""Fitting Eq. 8 and a white noise floor to centroids: maximum likelihood, with intervals that cover."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from fitctl.config import AirPathModel
from fitctl.identify.errors import IdentifyError
from fitctl.identify.noise_model import negative_log_likelihood
from fitctl.learn.intervals import Z_95, Interval
from fitctl.model.air_path import rms_px

Floats = NDArray[np.float64]

_PARAMETERS = ("gain_px", "b1_s2", "b2_s", "noise_px")
_LARGEST_CHANGE = 3.0  # of a logarithm from where the search begins: a factor of 20
# Directions in the logarithms: strength gain / b1 above the poles, where the fast pole is (b2 / b1), where
# the slow one is, and the noise. Gain, b1 and b2 by themselves are known almost only together.
_DIRECTIONS = np.array(
    [[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [1.0, 1.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]]
)
_PROBE = 0.02  # of a logarithm, for the likelihood's curvature


@dataclass(frozen=True)
class AirFit:
    """Eq. 8, gain / (b1 s^2 + b2 s + 1), and the centroids' white noise."""

    gain_px: Interval
    b1_s2: Interval
    b2_s: Interval
    noise_px: Interval

    @property
    def model(self) -> AirPathModel:
        """The estimates as designs want them."""
        return AirPathModel(
            gain_px=self.gain_px.value, b1_s2=self.b1_s2.value, b2_s=self.b2_s.value
        )


def fit_air_path(series_px: Floats, period_s: float, start: AirPathModel) -> AirFit:
    """One air path and one noise floor for independent series, shape (frames, series).

    Maximum likelihood in the parameters' logarithms, which are nearer to normal than the parameters:
    the slow pole is seen few times in a minute, and its error is a factor, not a difference.

    Parameters
    ----------
    start : AirPathModel
        Where the search begins; only its shape matters, its size follows the series.

    Raises
    ------
    IdentifyError
        If the series do not determine the parameters.
    """
    begin = _begin(series_px, start)

    def cost(logs: Floats) -> float:
        gain_px, b1_s2, b2_s, noise_px = np.exp(logs).tolist()
        air = AirPathModel(gain_px=gain_px, b1_s2=b1_s2, b2_s=b2_s)
        return negative_log_likelihood(air, noise_px, series_px, period_s)

    found = minimize(
        lambda along: cost(begin + along @ _DIRECTIONS),
        np.zeros(4),
        method="L-BFGS-B",
        bounds=[(-_LARGEST_CHANGE, _LARGEST_CHANGE)] * 4,
        options={"eps": 1e-4},
    )
    logs = begin + found.x @ _DIRECTIONS
    curvature = _curvature(cost, logs)
    at_bound = np.any(np.abs(found.x) > 0.99 * _LARGEST_CHANGE)
    if at_bound or not np.all(np.linalg.eigvalsh(curvature) > 0):
        msg = (
            "air path: the centroids do not show Eq. 8 and a noise floor (no likeliest one within a factor "
            "of 20 of the rig file's); expected a minute or more with the stages at rest and "
            "no vibration; record longer, or look for vibrations with fitctl design learn"
        )
        raise IdentifyError(msg)
    spread = Z_95 * np.sqrt(np.diag(np.linalg.inv(curvature)))
    return AirFit(
        **{
            name: Interval(*np.exp([log, log - half, log + half]).tolist())
            for name, log, half in zip(_PARAMETERS, logs, spread, strict=True)
        }
    )


def _begin(series_px: Floats, start: AirPathModel) -> Floats:
    """Logarithms to begin with: the shape given, gain and noise as large as the series."""
    # Third differences leave of slow motion nothing and of white noise twenty times its variance.
    noise_px = float(np.sqrt(np.mean(np.diff(series_px, n=3, axis=0) ** 2) / 20))
    moving_px = float(np.std(series_px, axis=0).mean())
    if not (noise_px > 0 and moving_px > 0):
        msg = "air path: the centroids do not move at all; expected a star, take a new record"
        raise IdentifyError(msg)
    shape = start.model_copy(update={"gain_px": 1.0})
    return np.log([moving_px / rms_px(shape), start.b1_s2, start.b2_s, noise_px])


def _curvature(cost: Callable[[Floats], float], at: Floats) -> Floats:
    """Second derivatives by central differences, shape (n, n)."""
    n = len(at)
    steps = _PROBE * np.eye(n)
    curvature = np.empty((n, n))
    for i in range(n):
        for j in range(i, n):
            curvature[i, j] = curvature[j, i] = (
                cost(at + steps[i] + steps[j])
                - cost(at + steps[i] - steps[j])
                - cost(at - steps[i] + steps[j])
                + cost(at - steps[i] - steps[j])
            ) / (4 * _PROBE**2)
    return curvature
