"""The air path: white noise through a second-order filter (Eq. 8-9), discretized exactly.

Noise is drawn for nodes `NODE_S` apart, where the motion and its rate are exact; between nodes the motion
is the cubic through both, which is the mean of all motions that meet there. What those scatter about it
is :func:`bridge_rms_px`, 2e-5 px for Eq. 9: a thousandth of what is to be measured.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import expm, solve_continuous_lyapunov

from fitctl.config import AirPathModel
from fitctl.model.compiled import compilable

Floats = NDArray[np.float64]
NODE_S = 0.005  # choice


def state_space(air: AirPathModel) -> tuple[Floats, Floats, Floats]:
    """A, B, C of Eq. 8; the state is the motion in pixels and its rate."""
    a = np.array([[0.0, 1.0], [-1.0 / air.b1_s2, -air.b2_s / air.b1_s2]])
    b = np.array([[0.0], [air.gain_px / air.b1_s2]])
    return a, b, np.array([[1.0, 0.0]])


def stationary_covariance(air: AirPathModel) -> Floats:
    """Covariance of the state under continuous white noise of unit intensity, shape (2, 2)."""
    a, b, _ = state_space(air)
    return np.asarray(solve_continuous_lyapunov(a, -b @ b.T))


def rms_px(air: AirPathModel) -> float:
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
    # In exp(-A t) what decays grows, and of a long step no digit would be left: so by a short one, doubled.
    decay = float(np.abs(np.linalg.eigvals(a).real).max()) * step_s
    doublings = max(0, math.ceil(math.log2(decay))) if decay > 0 else 0
    exponential = expm(block * (step_s / 2**doublings))
    transition = exponential[n:, n:].T
    covariance = transition @ exponential[:n, n:]
    for _ in range(doublings):
        covariance = covariance + transition @ covariance @ transition.T
        transition = transition @ transition
    # Rounding leaves it so little symmetric that scipy may refuse it.
    return transition, (covariance + covariance.T) / 2


def step_matrices(air: AirPathModel, step_s: float) -> tuple[Floats, Floats]:
    """Transition matrix and noise gain of one step: x+ = T x + G n with n standard normal, shape (2,)."""
    a, b, _ = state_space(air)
    transition, covariance = discretize(a, b @ b.T, step_s)
    # The covariance of a short step is ill-conditioned; its eigenvalues may come out as -1e-20.
    values, vectors = np.linalg.eigh((covariance + covariance.T) / 2)
    return transition, vectors * np.sqrt(np.maximum(values, 0.0))


def steps_per_node(step_s: float) -> int:
    """How many steps of a grid lie between two nodes."""
    return max(1, round(NODE_S / step_s))


def bridge_weights(steps: int, step_s: float) -> Floats:
    """Cubic Hermite weights, shape (steps, 4): of motion and rate at a node, and at the next.

    Row k is for the time (k + 1) steps after the first node, the last row for the next node itself.
    """
    node_s = steps * step_s
    x = np.arange(1, steps + 1) / steps
    return np.column_stack(
        [
            (1 + 2 * x) * (1 - x) ** 2,
            x * (1 - x) ** 2 * node_s,
            x**2 * (3 - 2 * x),
            x**2 * (x - 1) * node_s,
        ]
    )


def bridge_rms_px(air: AirPathModel) -> float:
    """RMS, halfway between nodes, of what the cubic leaves out: q h^3 / 192 of an integrated random walk.

    So close together the filter's own poles do not matter; q is the intensity of the rate's noise.
    """
    return float(air.gain_px / air.b1_s2 * np.sqrt(NODE_S**3 / 192))


@compilable(inline=True, fused=True)
def air_motion(
    state: Floats,
    normals: Floats,
    transition: Floats,
    noise_gain: Floats,
    weights: Floats,
    motion_px: Floats,
) -> None:
    """Motion on the grid over some nodes; `state` goes on with it.

    Parameters
    ----------
    state : array, shape (2, 2)
        Of each axis: motion and rate at the last node.
    normals : array, shape (nodes, 2, 2)
    transition, noise_gain : arrays, shape (2, 2)
        From node to node, :func:`step_matrices`.
    weights : array, shape (steps, 4)
        :func:`bridge_weights`.
    motion_px : array, shape (nodes * steps, 2)
        Receives the motion.
    """
    nodes, steps = normals.shape[0], weights.shape[0]
    for axis in range(2):
        x0, v0 = state[axis, 0], state[axis, 1]
        for node in range(nodes):
            n0, n1 = normals[node, axis, 0], normals[node, axis, 1]
            x1 = transition[0, 0] * x0 + transition[0, 1] * v0
            x1 += noise_gain[0, 0] * n0 + noise_gain[0, 1] * n1
            v1 = transition[1, 0] * x0 + transition[1, 1] * v0
            v1 += noise_gain[1, 0] * n0 + noise_gain[1, 1] * n1
            for step in range(steps):
                motion_px[node * steps + step, axis] = (
                    weights[step, 0] * x0
                    + weights[step, 1] * v0
                    + weights[step, 2] * x1
                    + weights[step, 3] * v1
                )
            x0, v0 = x1, v1
        state[axis, 0], state[axis, 1] = x0, v0
