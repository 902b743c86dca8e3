"""What the star will do while the next command acts: the part that minimum-variance and fslq share.

What the camera shows is the star's own motion and what the stages did to it. The stages' part is known,
at the frame's own time, so it is subtracted, and a steady-state Kalman filter follows the rest: the air
path and a slow drift. Then a gain for each output makes commands of what is expected.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag, solve_discrete_are

from fitctl.controllers.design.basis import Basis
from fitctl.controllers.design.sampled import timing
from fitctl.controllers.pair import Design
from fitctl.model.air_path import discretize, state_space

Floats = NDArray[np.float64]
SEEN = np.array(
    [1.0, 0.0, 1.0]
)  # the star's own motion of the states: air path (px, px/s), drift (px)


class Filter(NamedTuple):
    """Steady-state Kalman filter of the star's own motion.

    Attributes
    ----------
    transition : array, shape (3, 3)
        Of air path and drift, over one period.
    gain : array, shape (3,)
        Of a measurement's innovation on the state at its own time.
    """

    transition: Floats
    gain: Floats


def star_filter(basis: Basis, drift_px_per_sqrt_s: float) -> Filter:
    """The filter for a loop's air path and noise, with a drift that walks at random."""
    a, b, _ = state_space(basis.air_path)
    air, air_noise = discretize(a, b @ b.T, basis.period_s)
    transition = block_diag(air, 1.0)
    noise = block_diag(air_noise, drift_px_per_sqrt_s**2 * basis.period_s)
    variance = basis.noise_px**2
    before = solve_discrete_are(transition.T, SEEN[:, None], noise, np.array([[variance]]))
    return Filter(transition, before @ SEEN / (SEEN @ before @ SEEN + variance))


class Gains(NamedTuple):
    """How commands follow from what is expected; rows are mirror and motor step.

    Attributes
    ----------
    star : array, shape (2, 3)
        On the star's own motion at mid-exposure, less target.
    motor : array, shape (2,)
        On where the siderostat will be when the command begins.
    memory : array, shape (2, n)
        On a memory of the law's own: m+ = keep m + drive @ (mirror, motor step).
    keep, drive : arrays, shapes (n, n), (n, 2)
    """

    star: Floats
    motor: Floats
    memory: Floats
    keep: Floats
    drive: Floats


def predicting_design(
    name: str, basis: Basis, found: Filter, gains: Gains, parameters: dict[str, object]
) -> Design:
    """A pair from a filter and a law.

    States: the star's own motion, expected for the next frame (3); the siderostat steps still under way
    at mid-exposure, newest first; the law's memory.
    """
    frames, walked = timing(basis.period_s, basis.delay_s)
    own, steps, memory = 3, frames, len(gains.keep)
    n = own + steps + memory
    # The star's own motion at mid-exposure, once this frame is known: (states, inputs).
    error, _, mirror, motor, target = range(5)
    frame = np.zeros(5)
    frame[[error, target]], frame[[mirror, motor]] = 1.0, -1.0
    now_state = np.zeros((own, n))
    now_state[:, :own] = np.eye(own) - np.outer(found.gain, SEEN)
    now_input = np.outer(found.gain, frame)
    # Where the siderostat will be: where it was at the frame, and the steps that it had not yet made.
    motor_state, motor_input = np.zeros(n), np.eye(5)[motor]
    motor_state[own : own + steps] = 1.0
    motor_state[own + steps - 1] = 1.0 - walked
    # The target counts as a star's own motion the other way, one that stays.
    less_target = now_input.copy()
    less_target[2, target] -= 1.0
    c = gains.star @ now_state + np.outer(gains.motor, motor_state)
    c[:, own + steps :] += gains.memory
    d = gains.star @ less_target + np.outer(gains.motor, motor_input)
    a, b = np.zeros((n, n)), np.zeros((n, 5))
    a[:own], b[:own] = found.transition @ now_state, found.transition @ now_input
    a[own], b[own] = c[1], d[1]
    a[own + 1 : own + steps, own : own + steps - 1] = np.eye(steps - 1)
    a[own + steps :, own + steps :] = gains.keep
    a[own + steps :] += gains.drive @ c
    b[own + steps :] = gains.drive @ d
    return Design(
        name=name,
        period_s=basis.period_s,
        delay_s=basis.delay_s,
        a=a,
        b=b,
        c=c,
        d=d,
        hysteresis_inverse=True,
        parameters=parameters,
    )
