"""How well a loop can do: the least residual of any causal controller, and the residual of a design."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_discrete_are, solve_discrete_lyapunov

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.sampled import hold, sampled_loop, timing
from fitctl.controllers.pair import Design
from fitctl.model.air_path import discretize, state_space, stationary_covariance

Floats = NDArray[np.float64]


class Bound(NamedTuple):
    """The least RMS that any causal controller can leave of the air path.

    Attributes
    ----------
    residual_px : float
        In continuous time, under a mirror that holds each command for one period: 0.0130 on FIT.
        The siderostat stands still; one that walked with the star within each hold, as no backlash
        lets it, would gain 0.3 %.
    frame_residual_px : float
        At the frame instants alone, by a controller that cares for nothing else: 0.0121 on FIT.
    open_loop_px : float
        Without control.
    """

    residual_px: float
    frame_residual_px: float
    open_loop_px: float


def filter_covariance(transition: Floats, noise: Floats, output: Floats, variance: float) -> Floats:
    """Covariance of a steady-state Kalman filter's error after each measurement, shape (n, n).

    Parameters
    ----------
    transition, noise : arrays, shape (n, n)
        Of one frame period.
    output : array, shape (n,)
        What the camera measures of the state,
    variance : float
        and its noise.
    """
    before = solve_discrete_are(transition.T, output[:, None], noise, np.array([[variance]]))
    gain = before @ output / (output @ before @ output + variance)
    return np.asarray(before - np.outer(gain, output @ before))


def bound(basis: Basis) -> Bound:
    """The bound of a loop: linear plant, stages that follow exactly, noise and delay as they are.

    The best command is the negative mean, over the time for which it acts, of what the Kalman filter
    expects. What it leaves is the air path's variance less that of this prediction.
    """
    a, b, c = state_space(basis.air_path)
    output = c[0]
    transition, noise = discretize(a, b @ b.T, basis.period_s)
    after = filter_covariance(transition, noise, output, basis.noise_px**2)
    everything = stationary_covariance(basis.air_path)
    acts = hold(basis.air_path, basis.period_s, basis.delay_s)
    expected = acts.weight @ acts.air
    residual = everything[0, 0] - expected @ (everything - after) @ expected
    frames = timing(basis.period_s, basis.delay_s).frames
    to_frame, new = discretize(a, b @ b.T, frames * basis.period_s)
    frame_residual = output @ (to_frame @ after @ to_frame.T + new) @ output
    return Bound(math.sqrt(residual), math.sqrt(frame_residual), math.sqrt(everything[0, 0]))


def linear_residual(design: Design, basis: Basis) -> float:
    """RMS that a design leaves of the air path in continuous time, px; infinite if unstable.

    Exact for the linear loop: the closed loop's covariance by a Lyapunov equation, and between frames
    by quadrature over the time for which each command acts. `basis` is the truth, which need not be
    what the design was made for.
    """
    loop = sampled_loop(design, basis)
    if not loop.stable:
        return math.inf
    air, b_air, c_air = state_space(basis.air_path)
    transition, noise = discretize(air, b_air @ b_air.T, basis.period_s)
    closed = block_diag(transition, loop.a + np.outer(loop.b, loop.star))
    closed[2:, :2] = np.outer(loop.b, c_air[0])
    measured = np.concatenate([c_air[0], loop.star])
    variance = basis.noise_px**2
    covariance = solve_discrete_lyapunov(
        closed, block_diag(noise, np.outer(loop.b, loop.b) * variance)
    )
    acts = hold(basis.air_path, basis.period_s, basis.delay_s)
    # Mirror, and siderostat on its straight way, at each node.
    share = np.column_stack([np.ones_like(acts.part), acts.part])
    stages = np.hstack([np.zeros((2, 2)), loop.command]) + np.outer(loop.command_error, measured)
    left = share @ stages
    left[:, :2] += acts.air
    left[:, 2:] += loop.motor_held
    from_noise = (share @ loop.command_error) ** 2 * variance
    at_nodes = np.einsum("ni,ij,nj->n", left, covariance, left) + from_noise + acts.air_variance_px2
    return math.sqrt(acts.weight @ at_nodes)
