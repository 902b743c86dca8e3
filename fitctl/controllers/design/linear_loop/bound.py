"""How well a loop can do: the least residual of any causal controller, and the residual of a design."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.linear_loop.disturbance import blocks, disturbance, holds
from fitctl.controllers.design.linear_loop.sampled import sampled_loop, timing
from fitctl.controllers.pair import Design, mirror_outputs

Floats = NDArray[np.float64]


class Bound(NamedTuple):
    """The least RMS that any causal controller can leave of the air path and the lines beside it.

    Attributes
    ----------
    residual_px : float
        In continuous time, under a mirror that holds each write of the D/A until the next: 0.0130 on FIT.
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
    expects. What it leaves is the disturbance's variance less that of this prediction. Of several writes of the
    D/A in a frame, each acts for its part of the period.
    """
    moving = disturbance(basis)
    output = moving.seen
    transition, noise = moving.over(basis.period_s)
    after = filter_covariance(transition, noise, output, basis.noise_px**2)
    everything = moving.covariance
    open_loop = output @ everything @ output
    predicted = 0.0
    for acts in holds(moving, basis.writes, basis.period_s, basis.delay_s):
        expected = acts.weight @ acts.star
        predicted += float(expected @ (everything - after) @ expected)
    residual = open_loop - predicted / basis.writes
    frames = timing(basis.period_s, basis.delay_s).frames
    to_frame, new = moving.over(frames * basis.period_s)
    frame_residual = output @ (to_frame @ after @ to_frame.T + new) @ output
    return Bound(math.sqrt(residual), math.sqrt(frame_residual), math.sqrt(open_loop))


def linear_residual(design: Design, basis: Basis) -> float:
    """RMS that a design leaves of air path and lines in continuous time, px; infinite if unstable.

    Exact for the linear loop: the closed loop's covariance by a Lyapunov equation, and between frames
    by quadrature over the time for which each command acts. `basis` is the truth, which need not be
    what the design was made for.
    """
    loop = sampled_loop(design, basis)
    if not loop.stable:
        return math.inf
    moving = disturbance(basis)
    transition, noise = moving.over(basis.period_s)
    own = len(transition)
    closed = blocks(transition, loop.a + np.outer(loop.b, loop.star))
    closed[own:, :own] = np.outer(loop.b, moving.seen)
    measured = np.concatenate([moving.seen, loop.star])
    variance = basis.noise_px**2
    covariance = solve_discrete_lyapunov(closed, blocks(noise, np.outer(loop.b, loop.b) * variance))
    outputs = np.hstack([np.zeros((len(loop.command), own)), loop.command])
    stages = outputs + np.outer(loop.command_error, measured)
    writes = design.writes
    left_px2 = 0.0
    for write, acts in enumerate(holds(moving, writes, basis.period_s, basis.delay_s)):
        both = [mirror_outputs(writes)[write], 1]
        # Mirror, and siderostat on its straight way, at each node.
        part = (write + acts.part) / writes
        share = np.column_stack([np.full_like(part, basis.mirror_gain), part])
        left = share @ stages[both]
        left[:, :own] += acts.star
        left[:, own:] += loop.motor_held
        from_noise = (share @ loop.command_error[both]) ** 2 * variance
        at_nodes = ((left @ covariance) * left).sum(axis=1) + from_noise + moving.new_px2(acts.star)
        left_px2 += acts.weight @ at_nodes
    return math.sqrt(left_px2 / writes)
