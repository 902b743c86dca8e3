"""Least squares on a star that the air moves: what the air path explains is taken out first."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from fitctl.config import Rig
from fitctl.controllers.centroid import sensor_noise_px
from fitctl.identify.errors import require_times
from fitctl.model import air_path

Floats = NDArray[np.float64]
LEAST_NOISE_PX = 0.006
"""The models of mirror and siderostat are wrong by about this much (choice).

With less noise, whitening emphasizes their errors at high frequencies. With the fit's 0.0023 px, the identified
hysteresis is wrong by 0.28 % of the stroke instead of 0.11 %, and `delay` leaves 9.3 times the noise
unexplained instead of 4.1 times.
"""
_ANYWHERE_PX2 = 1e4  # variance of where the star stands before the first frame


def whitener(
    rig: Rig, loop_name: str, mid_exposure_s: Floats, least_noise_px: float = LEAST_NOISE_PX
) -> Callable[[Floats], Floats]:
    """A linear map that makes one axis of the star's noise white, with unit variance.

    It is the Kalman filter of the rig's own models (air path, drift as a random walk, noise of the loop's
    sensor): its innovations, over their standard deviation. Applied to star positions and regressors alike,
    ordinary least squares becomes the generalized one (Gauss-Markov). It also removes an unknown constant.

    Parameters
    ----------
    mid_exposure_s : array, shape (frames,)
        Of the frames that have a star, ascending; frames may be missing.
    least_noise_px : float, optional
        A sensor with less noise counts as having this much.

    Returns
    -------
    callable
        From columns, shape (frames, m) in px, to as many whitened ones.

    Raises
    ------
    IdentifyError
        If the times cannot be of one run.
    """
    settings = rig.stellar_loops[loop_name]
    period_s = rig.camera.period_s
    require_times(mid_exposure_s, period_s, f"frames of loop {loop_name}")
    sensor_px = sensor_noise_px(rig.camera, settings, settings.star_flux_dn)
    noise_px = max(sensor_px, least_noise_px)
    air = settings.vernier.air_path
    a_air, b_air, _ = air_path.state_space(air)
    a, intensity, covariance = np.zeros((3, 3, 3))
    a[:2, :2] = a_air
    intensity[:2, :2] = b_air @ b_air.T
    intensity[2, 2] = settings.vernier.minimum_variance.drift_px_per_sqrt_s**2
    covariance[:2, :2] = air_path.stationary_covariance(air)
    covariance[2, 2] = _ANYWHERE_PX2
    see = np.array([1.0, 0.0, 1.0])
    # A lost frame makes a longer step; times within one period are the clocks' noise.
    missed = np.maximum(1, np.rint(np.diff(mid_exposure_s) / period_s)).astype(int)
    one = air_path.discretize(a, intensity, period_s)
    steps = {n: _repeated(*one, n) for n in set(missed.tolist())}
    gains, deviations, transitions = [], [], []
    for n in [*missed.tolist(), 1]:
        variance = see @ covariance @ see + noise_px**2
        gain = covariance @ see / variance
        transition, noise = steps.get(n, (np.eye(3), np.zeros((3, 3))))
        covariance = covariance - np.outer(gain, see @ covariance)
        covariance = transition @ covariance @ transition.T + noise
        gains.append(gain[:, None])
        deviations.append(np.sqrt(variance))
        transitions.append(transition)

    def whiten(columns: Floats) -> Floats:
        state = np.zeros((3, columns.shape[1]))
        innovations = np.empty_like(columns)
        for row, (gain, transition) in enumerate(zip(gains, transitions, strict=True)):
            innovations[row] = columns[row] - state[0] - state[2]
            state = transition @ (state + gain * innovations[row])
        return innovations / np.array(deviations)[:, None]

    return whiten


def _repeated(transition: Floats, noise: Floats, times: int) -> tuple[Floats, Floats]:
    """Some steps as one, by squaring: discretized as a whole, a gap of seconds loses all digits of noise."""
    through, added = np.eye(len(transition)), np.zeros_like(noise)
    while times:
        if times % 2:
            through, added = transition @ through, transition @ added @ transition.T + noise
        transition, noise = transition @ transition, transition @ noise @ transition.T + noise
        times //= 2
    return through, added
