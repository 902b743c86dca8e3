"""The air path: white noise through a second-order filter (Eq. 8-9), discretized exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

from fitctl.config import AirPath

Floats = NDArray[np.float64]


def state_space(air: AirPath) -> tuple[Floats, Floats, Floats]:
    """A, B, C of Eq. 8; the state is the motion in pixels and its rate."""
    a = np.array([[0.0, 1.0], [-1.0 / air.b1_s2, -air.b2_s / air.b1_s2]])
    b = np.array([[0.0], [air.gain_px / air.b1_s2]])
    return a, b, np.array([[1.0, 0.0]])


def stationary_covariance(air: AirPath) -> Floats:
    """Covariance of the state under continuous white noise of unit intensity, shape (2, 2)."""
    a, b, _ = state_space(air)
    return np.asarray(solve_continuous_lyapunov(a, -b @ b.T))


def rms_px(air: AirPath) -> float:
    """Open-loop RMS motion: 0.201 px for Eq. 9."""
    return float(np.sqrt(stationary_covariance(air)[0, 0]))


def discretize(a: Floats, noise_intensity: Floats, step_s: float) -> tuple[Floats, Floats]:
    """Exact discretization of x' = A x + w by Van Loan's method.

    Parameters
    ----------
    a : array, shape (n, n)
    noise_intensity : array, shape (n, n)
        Intensity of the white noise w.
    step_s : float

    Returns
    -------
    transition, covariance : arrays, shape (n, n)
        Of one step of `step_s`.
    """
    n = a.shape[0]
    block = np.zeros((2 * n, 2 * n))
    block[:n, :n] = -a
    block[:n, n:] = noise_intensity
    block[n:, n:] = a.T
    exponential = expm(block * step_s)
    transition = exponential[n:, n:].T
    return transition, transition @ exponential[:n, n:]


def step_matrices(air: AirPath, step_s: float) -> tuple[Floats, Floats]:
    """Transition matrix and noise gain of one step: x+ = T x + G n with n standard normal, shape (2,)."""
    a, b, _ = state_space(air)
    transition, covariance = discretize(a, b @ b.T, step_s)
    # The covariance of a short step is ill-conditioned; its eigenvalues may come out as -1e-20.
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return transition, vectors * np.sqrt(np.maximum(values, 0.0))
